"""What a hand of simulated nodes says, as candump's text: real nodes with a clock of the test's own."""

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from canopen_device.testing import Conversation
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources.simulated import OPEN, SATURATED, SILENT, SimulatedSource
from tipforce_tools.demo.job import NOISE_MICROSTRAIN, OFFSETS_MICROSTRAIN, case_calibration

START_S = 1_700_000_000
FAULTS = {"open": OPEN, "saturated": SATURATED, "silent": SILENT}

Load = Callable[[int, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Fault:
    """A fault of one node from ``begin_s`` to ``end_s``: open, saturated, silent, or lost (frames do not arrive)."""

    node_id: int
    kind: str
    begin_s: float
    end_s: float


def touch(node_id: int, t_s: float) -> tuple[float, float, float]:
    """A press every second that grows and fades; its direction turns round through 180 degrees."""
    P = max(0.0, 3.0 * math.sin(2.0 * math.pi * (t_s + 0.13 * node_id)))
    phi = (150.0 + 60.0 * t_s + 20.0 * node_id + 180.0) % 360.0 - 180.0
    return P, phi, (phi + 180.0) % 360.0 - 180.0 + 15.0 * math.sin(7.0 * t_s)


def calibration() -> Calibration:
    """What the nodes are calibrated with: case I, contact that pushes, the whole circle as pad."""
    found = case_calibration("I", pull=False)
    return Calibration(
        found.C, found.offset_strain, found.covariance_strain2, 1, found.date, layout_code=1,
        tip_radius_m=found.tip_radius_m, theta_min_deg=-180.0, theta_max_deg=180.0,
    )  # fmt: skip


def _node(node_id: int, *, health: bool) -> tuple[Conversation, SimulatedSource]:
    source = SimulatedSource(
        strain_matrix(FABRICATED, "I").tolist(), NOISE_MICROSTRAIN, OFFSETS_MICROSTRAIN, seed=node_id
    )
    talk = Conversation(fingertip_node(node_id, source, serial=node_id), now_us=1_000_000, emcy=True)
    given = calibration()
    assert talk.download(0x2141, 0, given.record()) == 0
    assert talk.put("I", 0x2103, 1, given.crc32()) == 0
    assert talk.put("I", 0x2104, 0, 0x74696D63) == 0
    assert talk.put("H", 0x1017, 0, 500) == 0
    if health:
        assert talk.put("H", 0x1803, 5, 200) == 0
        assert talk.put("I", 0x1803, 1, 0x40000480 + node_id) == 0
    talk.take()
    talk.step([(0, bytes((1, node_id)))])
    return talk, source


def hand_frames(
    node_ids: tuple[int, ...] = (5,), seconds: float = 2.0, rate_hz: int = 100, load: Load = touch,
    faults: tuple[Fault, ...] = (), health: bool = True,
) -> Iterator[tuple[int, int, bytes]]:  # fmt: skip
    """(microseconds since the start, identifier, data): SYNC and what the nodes answer, their heartbeats and EMCY."""
    nodes = [_node(node_id, health=health) for node_id in node_ids]
    for k in range(round(seconds * rate_hz)):
        t_s = k / rate_hz
        t_us = round(t_s * 1e6)
        yield t_us, 0x80, b""
        delay_us = 0
        for talk, source in nodes:
            node_id = talk.device.node_id
            now = {fault.kind for fault in faults if fault.node_id == node_id and fault.begin_s <= t_s < fault.end_s}
            source.load = load(node_id, t_s)
            source.fault = next((FAULTS[kind] for kind in FAULTS if kind in now), 0)
            talk.advance(1_000_000 + t_us - talk.now_us)
            talk.step([(0x80, b"")])
            for can_id, data in talk.take():
                delay_us += 120
                if "lost" not in now:
                    yield t_us + delay_us, can_id, data


def hand_log(*args: object, channel: str = "vcan0", **options: object) -> str:
    return "".join(
        f"({START_S + t_us // 1_000_000}.{t_us % 1_000_000:06d}) {channel} {can_id:03X}#{data.hex().upper()}\n"
        for t_us, can_id, data in hand_frames(*args, **options)  # type: ignore[arg-type]
    )


def contact_pdo(
    node_id: int, P: float, phi: float, theta: float, status: int = 3, counter: int = 0
) -> tuple[int, bytes]:
    """One TPDO2 (None: NaN is unknown)."""
    raw = [
        -0x8000 if math.isnan(value) else round(value * scale) for value, scale in ((P, 1000), (phi, 100), (theta, 100))
    ]
    return 0x280 + node_id, struct.pack("<hhhBB", *raw, status, counter & 0xFF)
