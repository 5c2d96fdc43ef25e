"""Build the nodes of a scene, each with a simulated source, its calibration, and only what ``parts`` decides."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from canopen_device.core import codes, communication
from canopen_device.core.node import Device
from canopen_device.paths_below import below
from tipforce.dictionary import indices, table
from tipforce.errors import InputError
from tipforce.fingertip.node import fingertip_node
from tipforce.scene import schema
from tipforce.scene.delivered import commit_calibration, download, structure_calibration
from tipforce.scene.registry import Pdo, chosen_parts, node_pdos
from tipforce.scene.schema import Triple
from tipforce.sensor.structure.layouts import CUSTOM_LAYOUT_CODE, layout, layout_code
from tipforce.sources.simulated import DRIFT, OPEN, SATURATED, SILENT, STUCK, SimulatedSource

if TYPE_CHECKING:
    from tipforce.host.configuration.calibration import Calibration
    from tipforce.sources.dynamic_load import Coefficients
    from tipforce.sources.front_end import FrontEnd

    Frame = tuple[int, bytes]

FAULTS: dict[schema.FaultKind, int] = {
    "stuck": STUCK, "open": OPEN, "saturate": SATURATED, "silent": SILENT, "drift": DRIFT,
}  # fmt: skip
_FRONT_END = {
    "bits": "bits", "gain": "gain", "reference_volts": "reference_volts", "temperature": "temperature_degC",
    "apparent_strain": "apparent_microstrain_per_degC", "gain_drift_ppm": "gain_drift_ppm_per_degC",
}  # fmt: skip
"""By argument of FrontEnd: the key of [front_end]."""
FILTERS = {"moving_average": 1, "repeating_average": 2, "first_order": 100}  # 61A0h


@dataclass(slots=True)
class Clock:
    """Start of the scene in the node's microseconds. Simulated time begins at 0."""

    start_us: int = 0


@dataclass(slots=True)
class Finger:
    """One node of the scene."""

    node_id: int
    gauges: int
    device: Device
    source: SimulatedSource
    load: schema.LoadHistory | None
    pdos: tuple[Pdo, ...]
    calibration: Calibration | None
    group: schema.Nodes
    clock: Clock

    def boot(self, now_us: int) -> list[Frame]:
        """Power on with this finger's stored settings; return its boot-up message."""
        sent, _ = self.device.step(now_us)
        self.clock.start_us = now_us
        self._write(communication.PRODUCER_HEARTBEAT, 0, "<H", self.group.heartbeat_ms)
        self._write(indices.SAMPLE_PERIOD_US, 1, "<I", self.group.sample_period_us)
        if self.group.filter is not None:
            for gauge in range(1, self.gauges + 1):
                self._write(indices.FILTER_CONSTANT, gauge, "<H", self.group.filter_constant)
                self._write(indices.FILTER_TYPE, gauge, "<B", FILTERS[self.group.filter])
        if self.calibration is not None:
            commit_calibration(self.device, self.calibration)
        for number, _, base, *_ in table.tpdos(self.gauges):
            cob_id = (base + self.node_id if base else 0) | codes.NO_RTR
            self._write(communication.TPDO + number - 1, 1, "<I", cob_id | codes.COB_ID_INVALID)
        for pdo in self.pdos:
            if pdo.remapped:  # by the procedure of CiA 301, 7.5.2.36: the PDO is invalid before
                index = communication.TPDO_MAPPING + pdo.number - 1
                self._write(index, 0, "<B", 0)
                for k, (mapped, sub, bits) in enumerate(pdo.mapping, 1):
                    self._write(index, k, "<I", mapped << 16 | sub << 8 | bits)
                self._write(index, 0, "<B", len(pdo.mapping))
            self._write(communication.TPDO + pdo.number - 1, 1, "<I", pdo.can_id | codes.NO_RTR)
        return sent

    def _write(self, index: int, sub: int, packing: str, value: int) -> None:
        download(self.device, index, sub, struct.pack(packing, value))


def build(scene: schema.Scene, folder: Path) -> list[Finger]:
    """Return the fingers of a scene, not booted; calibration files are relative to ``folder``. Raises InputError for
    one that is invalid or has another number of gauges, and for a layout whose gauges cannot separate the forces."""
    return [_finger(scene, group, node_id, folder) for group in scene.nodes for node_id in group.ids]


def _finger(scene: schema.Scene, group: schema.Nodes, node_id: int, folder: Path) -> Finger:
    chosen = chosen_parts(scene, node_id)
    gauges = len(layout(group.layout))
    load, clock = scene.load(node_id), Clock()
    source = _source(scene, group, node_id, load, clock, chosen)
    calibration = None
    if "calibration file" in chosen:
        from tipforce.host.configuration.calibration import read_calibration

        calibration = read_calibration(below(folder, group.calibration, "nodes.calibration"))
        if calibration.gauges != gauges:
            differs = f"it is for {calibration.gauges} gauges, the layout has {gauges}"
            raise InputError(f"calibration {group.calibration}: {differs}")
        if len({calibration.layout_code, layout_code(group.layout)} - {CUSTOM_LAYOUT_CODE}) > 1:
            raise InputError(f"calibration {group.calibration}: it is for another layout, the node has {group.layout}")
    elif "calibration" in chosen:
        from tipforce.sensor.structure.strain import FABRICATED

        white = scene.noise.gauge_microstrain or 0.0 if scene.noise is not None else 0.0
        calibration = structure_calibration(
            FABRICATED, layout(group.layout), white, 1.0 / source.converter[1], group.offset_microstrain or (),
            serial=group.ids[0], pull=group.sense == "pull",
        )  # fmt: skip
    device = fingertip_node(node_id, source, gauges, serial=node_id)
    return Finger(node_id, gauges, device, source, load, node_pdos(group, node_id), calibration, group, clock)


def _source(
    scene: schema.Scene, group: schema.Nodes, node_id: int, load: schema.LoadHistory | None, clock: Clock,
    chosen: frozenset[str],
) -> SimulatedSource:  # fmt: skip
    options: dict[str, Any] = {}
    seed = 256 * scene.seed + 2 * node_id
    noise = scene.noise or schema.Noise()
    if group.offset_microstrain:
        options["offset_microstrain"] = group.offset_microstrain
    if "noise" in chosen:
        options |= {"noise_microstrain": noise.gauge_microstrain, "seed": seed}
    if "front end" in chosen:
        options["front_end"] = _front_end(scene.front_end, noise.one_over_f_microstrain, seed + 1)
    if load is None:
        return SimulatedSource([(0.0, 0.0, 0.0)] * len(layout(group.layout)), **options)
    from tipforce.sensor.structure.strain import FABRICATED, strain_matrix

    def following(now_us: int) -> Triple:
        return load.force(1e-6 * (now_us - clock.start_us))

    if "dynamics" in chosen:
        options["forces"] = _swinging(scene.dynamics or schema.Dynamics(), following, clock)
    elif "load history" in chosen:
        options["forces"] = following
    source = SimulatedSource(strain_matrix(FABRICATED, group.layout).tolist(), **options)
    if load.constant:
        source.load = load.at(0.0)
    return source


def _swinging(dynamics: schema.Dynamics, following: Callable[[int], Triple], clock: Clock) -> Callable[[int], Triple]:
    """Return the elastic force at a conversion, that of the last of steps of ``step_us``; starts in equilibrium."""
    from tipforce.sensor.dynamics.first_order_hold import node_coefficients
    from tipforce.sensor.dynamics.model import modes
    from tipforce.sensor.structure.strain import FABRICATED
    from tipforce.sources.dynamic_load import DynamicForces, DynamicLoad

    coefficients = node_coefficients(modes(FABRICATED, dynamics.damping_ratio), 1e-6 * dynamics.step_us)
    forces = DynamicForces(DynamicLoad(cast("Coefficients", coefficients)), following, dynamics.step_us)

    def force(now_us: int) -> Triple:
        forces(clock.start_us)  # the first call settles the tip there
        return forces(now_us)

    return force


def _front_end(given: schema.FrontEnd | None, one_over_f: float | None, seed: int) -> FrontEnd:
    from tipforce.sources.front_end import Bridge, FrontEnd

    options: dict[str, Any] = {"one_over_f": one_over_f, "seed": seed}
    try:
        if given is not None:
            options |= {name: getattr(given, key) for name, key in _FRONT_END.items()}
            if given.bridge is not None:
                options["bridge"] = Bridge(given.bridge, given.gauge_factor, given.excitation_volts)
        return FrontEnd(**options)
    except ValueError as error:
        name, _, why = str(error).partition(": ")
        raise InputError(f"[front_end] {_FRONT_END.get(name, name)}: {why}") from None


class Fault(NamedTuple):
    """What is written to object 2200h of a finger; kind 0 ends a fault."""

    finger: Finger
    kind: int
    gauge: int
    magnitude: float

    def inject(self, now_us: int) -> None:
        """Begin it, or end it, in the finger's source."""
        self.finger.source.set_fault(self.kind, self.gauge, self.magnitude, now_us)


def actions(scene: schema.Scene, fingers: Sequence[Finger], duration_s: float) -> list[tuple[int, Fault | None]]:
    """Return (t_us, fault; None: SYNC, first after one period) in order; faults precede a SYNC, ends a beginning."""
    by_id = {finger.node_id: finger for finger in fingers}
    faults = []
    for fault in scene.faults:
        for finger in (by_id[node_id] for node_id in fault.nodes):
            begun = Fault(finger, FAULTS[fault.kind], fault.gauge, fault.microstrain_per_s)
            faults.append((round(1e6 * fault.at_s), begun))
            if fault.until_s is not None:
                faults.append((round(1e6 * fault.until_s), Fault(finger, 0, fault.gauge, 0.0)))
    faults.sort(key=lambda event: (event[0], event[1].kind != 0))
    sync_hz = scene.sync_hz or 1.0
    count = int(duration_s * sync_hz + 1e-9) if scene.sync_hz else 0
    events: list[tuple[int, Fault | None]] = [event for event in faults if event[0] <= round(1e6 * duration_s)]
    events += [(round(1e6 * k / sync_hz), None) for k in range(1, count + 1)]
    return sorted(events, key=lambda event: event[0])
