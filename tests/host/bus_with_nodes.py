"""Real nodes on python-can's in-process bus, run by the product's own loop, and a host whose ears can be made bad."""

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
from can.interfaces.virtual import VirtualBus

from canopen_device.core.node import Device
from canopen_device.running import loop
from canopen_device.running.open_bus import PythonCanPort
from canopen_device.running.store import FileStore
from tipforce.dictionary import objects as od
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.hand.polled import HandSample, PolledHand
from tipforce.host.network.bus import Bus
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix
from tipforce.sources.simulated import SimulatedSource

ROUNDING_STRAIN2 = 0.1e-6**2 / 12
"""Variance of rounding to counts: all the noise that a noiseless finger has. With more than a count of noise in the
calibration the node would, rightly, take its equal readings for a frozen converter."""

_CHANNELS = itertools.count()
_WAKE = 0x7FF  # nobody's identifier: only ends the loop's wait


class FaultyBus(VirtualBus):
    """The host's end of the bus. ``fault`` sees each frame that arrives and says what the host gets: it, another one,
    or nothing. ``sent`` keeps what the host sent."""

    def __init__(self, channel: str, **options: Any) -> None:
        self.fault: Callable[[can.Message], can.Message | None] = lambda message: message
        self.sent: list[tuple[int, bytes]] = []
        super().__init__(channel, **options)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.sent.append((msg.arbitration_id, bytes(msg.data)))
        super().send(msg, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        message, filtered = super()._recv_internal(timeout)
        return (None if message is None else self.fault(message)), filtered


def new_channel() -> str:
    """The name of a bus that no other test uses."""
    return f"tipforce-test-{next(_CHANNELS)}"


@contextlib.contextmanager
def running(devices: Sequence[Device], channel: str) -> Iterator[None]:
    """Nodes that one thread runs on ``channel``; an exception in their loop fails the test."""
    with can.Bus(interface="virtual", channel=channel) as bus, can.Bus(interface="virtual", channel=channel) as waker:
        wake = can.Message(arbitration_id=_WAKE, is_extended_id=False)
        with loop.running(devices, PythonCanPort(bus), lambda: waker.send(wake)):
            yield


@contextlib.contextmanager
def connected(
    *devices: Device, timeout_s: float = 0.5, retries: int = 2, channel: str = ""
) -> Iterator[tuple[Bus, FaultyBus]]:
    """Running nodes that have booted, and a host on their bus."""
    channel = channel or new_channel()
    # The host listens before the nodes start: it must not miss their boot-up.
    bus = FaultyBus(channel)
    with Bus(bus, timeout_s, retries) as connection, running(devices, channel):
        if devices:
            connection.wait_for({0x700 + device.node_id for device in devices}, 10.0)
        yield connection, bus


def finger(
    node_id: int = 5, case: str = "I", store: Path | None = None, noise_microstrain: float = 0.0, seed: int = 1, *,
    serial: int = 0,
) -> Device:  # fmt: skip
    """A simulated fingertip; without noise, unless asked for. Its serial number is 1000 + node-id, unless given."""
    source = SimulatedSource(strain_matrix(FABRICATED, case).tolist(), noise_microstrain, seed=seed)
    files = None if store is None else FileStore(store)
    hooks: dict[str, Any] = {} if files is None else {"save": files.save, "load": files.load}
    return fingertip_node(node_id, source, serial=serial or 1000 + node_id, **hooks)


def beam_calibration(case: str = "I", /, **changes: Any) -> Calibration:
    """What beam theory gives for a case; pull, as in a groove."""
    fields: dict[str, Any] = {
        "C": calibration_matrix(FABRICATED, case), "offset_strain": np.zeros(3),
        "covariance_strain2": np.eye(3) * ROUNDING_STRAIN2, "serial": 7, "date": 20260102,
        "layout_code": {"I": 1, "II": 2, "III": 3}[case], "pull": True,
    }  # fmt: skip
    return Calibration(**(fields | changes))


def apply_load(connection: Bus, node_id: int, P: float, phi_deg: float, theta_deg: float) -> None:
    sdo = connection.sdo(node_id)
    for entry, value in ((od.SIMULATION_P, P), (od.SIMULATION_PHI, phi_deg), (od.SIMULATION_THETA, theta_deg)):
        sdo.write(entry, value)


def fresh_sample(hand: PolledHand, timeout_s: float = 2.0) -> HandSample:
    """The next row in which every finger that answers has a reading of its own: no SYNC within a conversion."""
    for _ in range(1000):
        row = hand.sample(timeout_s)
        contacts = [samples for (_, name), samples in row.messages.items() if name == "Contact"]
        if not any(samples.columns["stale"][-1] for samples in contacts):
            return row
    raise AssertionError("every sample is stale")
