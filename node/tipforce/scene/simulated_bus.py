"""Simulated fingers on a bus, for users' tests: the real node code, dictionary and loop, run by one thread."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from canopen_device.core import codes
from canopen_device.core.node import Device
from canopen_device.running import loop
from canopen_device.running.loop import MemoryStore
from canopen_device.running.open_bus import PythonCanPort
from tipforce.arrays import floats, real, whole
from tipforce.errors import InputError
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.measurements import LARGEST_MICROSTRAIN, MOST_LOAD_NEWTONS
from tipforce.host.network.bus import Bus
from tipforce.host.network.interfaces import open_bus
from tipforce.scene.delivered import CALIBRATION, beam_calibration, check_noise, pulls, stored_calibration
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources.simulated import DRIFT, OPEN, SATURATED, SILENT, STUCK, SimulatedSource

Load = tuple[float, float, float]
"""P in newtons, phi and theta in degrees."""

NO_LOAD: Load = (0.0, 0.0, 0.0)
FAULTS = {"none": 0, "stuck": STUCK, "open": OPEN, "saturated": SATURATED, "silent": SILENT, "drift": DRIFT}
_WAKE_COB_ID = codes.STANDARD_MASK
_numbers = itertools.count()


class SimulatedBus(Bus):
    """A bus with simulated fingers; a context manager that stops them. ``bus_options``: the keywords of ``can.Bus`` by
    which other programs of the process (on a virtual bus) or of the machine (on vcan) reach the same fingers."""

    def __init__(self, devices: Mapping[int, Device], sources: Mapping[int, SimulatedSource], **bus: str) -> None:
        channel = f"tipforce-{os.getpid()}-{next(_numbers)}"
        self.bus_options: dict[str, Any] = bus or {"interface": "virtual", "channel": channel}
        self._sources = dict(sources)
        super().__init__(open_bus(**self.bus_options))
        nodes_bus = open_bus(**self.bus_options)
        self._closing = contextlib.ExitStack()
        self._closing.callback(nodes_bus.shutdown)
        self._closing.callback(super().close)
        self._closing.enter_context(loop.running(list(devices.values()), PythonCanPort(nodes_bus), self._wake))
        self.wait_for({codes.HEARTBEAT_BASE + node_id for node_id in devices}, timeout_s=5.0)

    @property
    def node_ids(self) -> tuple[int, ...]:
        """Of the simulated fingers."""
        return tuple(self._sources)

    def apply_load(self, node_id: int, P_newtons: float, phi_deg: float, theta_deg: float) -> None:
        """Load a finger from now on. Raises InputError for a node-id that is not simulated here, or no such load."""
        self._source(node_id).load = _checked_load(node_id, (P_newtons, phi_deg, theta_deg))

    def inject_fault(self, node_id: int, fault: str, gauge: int = 1, magnitude: float = 0.0) -> None:
        """Inject a fault into a gauge (from 1) of a finger from now on: stuck, open, saturated, silent, drift, or none.
        ``magnitude``: microstrain per second, for a drift. Raises InputError for another fault, gauge or node-id."""
        source = self._source(node_id)
        if fault not in FAULTS:
            raise InputError(f"fault {fault!r}: allowed are {', '.join(FAULTS)}")
        gauge = whole("gauge", gauge, range(1, len(source.rows) + 1))
        if not abs(real(magnitude)) <= LARGEST_MICROSTRAIN:
            raise InputError(f"magnitude {magnitude!r}: allowed is up to {LARGEST_MICROSTRAIN:g} microstrain a second")
        source.set_fault(FAULTS[fault], gauge, real(magnitude), loop.now_us())

    def close(self) -> None:
        """Stop the fingers and close the bus. Raises the error that ended their loop, if any."""
        self._closing.close()

    def _wake(self) -> None:
        if self.bus_options.get("interface") == "virtual":
            self.send(_WAKE_COB_ID, b"")  # not an identifier of a node

    def _source(self, node_id: int) -> SimulatedSource:
        if node_id not in self._sources:
            raise InputError(f"node-id {node_id}: allowed: {', '.join(map(str, self._sources))}")
        return self._sources[node_id]


def simulated_finger(
    node_id: int = 5, load: Load = NO_LOAD, *, layout: str = "I", calibrated: bool = True, pull: bool | None = None,
    noise_microstrain: float = 0.5, seed: int = 0, **bus: str,
) -> SimulatedBus:  # fmt: skip
    """Return a bus with one finger under ``load``: P in newtons, phi, theta in degrees. ``layout``: I, II, III or a
    mirror; ``pull``: load sense, default that of ``load``. Raises InputError, EnvironmentLackError."""
    return simulated_hand(
        [node_id], {node_id: load}, layout=layout, calibrated=calibrated, pull=pull,
        noise_microstrain=noise_microstrain, seed=seed, **bus,
    )  # fmt: skip


def simulated_hand(
    node_ids: int | Sequence[int] = 5, loads: Mapping[int, Load] | None = None, *, layout: str = "I",
    calibrated: bool = True, pull: bool | None = None, noise_microstrain: float = 0.5, seed: int = 0, **bus: str,
) -> SimulatedBus:  # fmt: skip
    """Return a bus with fingers (number, or node-ids), ``loads`` by node-id. Otherwise as ``simulated_finger``."""
    chosen = tuple(range(1, node_ids + 1)) if isinstance(node_ids, int | np.integer) else tuple(node_ids)
    loads = loads or {}
    if not chosen or len(set(chosen)) != len(chosen) or not all(node_id in range(1, 128) for node_id in chosen):
        raise InputError(f"node-ids {list(chosen)}: allowed are different ones from 1 to 127")
    if not set(loads) <= set(chosen):
        raise InputError(f"loads of nodes {sorted(set(loads) - set(chosen))}: the hand has {list(chosen)}")
    loads = {node_id: _checked_load(node_id, load) for node_id, load in loads.items()}
    noise_microstrain, seed = check_noise(noise_microstrain), whole("seed", seed)
    devices: dict[int, Device] = {}
    sources: dict[int, SimulatedSource] = {}
    A = strain_matrix(FABRICATED, layout)
    for node_id in map(int, chosen):  # of any integer type
        store = MemoryStore()
        source = SimulatedSource(A.tolist(), noise_microstrain, seed=seed + node_id)
        source.load = loads.get(node_id, NO_LOAD)
        sources[node_id] = source
        if calibrated:
            sense = pulls(source.load) if pull is None else pull
            store.groups[CALIBRATION] = stored_calibration(beam_calibration(layout, sense, noise_microstrain))
        devices[node_id] = fingertip_node(node_id, source, len(A), 1000 + node_id, store.save, store.load)
    return SimulatedBus(devices, sources, **bus)


def _checked_load(node_id: int, load: Load) -> Load:
    numbers = floats(f"load of node {node_id}", load)
    if numbers.shape != (3,) or not (np.abs(numbers) <= MOST_LOAD_NEWTONS).all():
        raise InputError(f"load {load!r} of node {node_id}: allowed is (P newtons, phi degrees, theta degrees), finite")
    return (float(numbers[0]), float(numbers[1]), float(numbers[2]))
