"""Build the nodes of a scene: each with a simulated source, its calibration and only the PDOs that the scene names.

``built`` collects the names of the parts (parts.py) where each is built, so that a test can compare the output of
`tipforce scene explain` with a run.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.device import codes, communication
from tipforce.device.node import Device
from tipforce.dictionary import indices, table
from tipforce.errors import InputError
from tipforce.fingertip.node import fingertip_node
from tipforce.paths_below import below
from tipforce.scene import schema
from tipforce.scene.loads import LoadHistory, load_of
from tipforce.scene.sources import Clock, source_of
from tipforce.sensor.structure.layouts import layout
from tipforce.sources.simulated import SimulatedSource

if TYPE_CHECKING:
    from tipforce.host.configuration.calibration import Calibration

    Frame = tuple[int, bytes]

PDO_NAMES = {"gauges": "Gauges", "contact": "Contact", "force": "Force", "health": "Health"}
FAULTS = {"stuck": 1, "open": 2, "saturate": 3, "silent": 4, "drift": 5}  # 2200h:1
FILTERS = {"moving_average": 1, "repeating_average": 2, "first_order": 100}  # 61A0h
_STATUS = (indices.STATUS, 0)

Mapping = tuple[tuple[int, int, int], ...]  # (index, sub, bits)


@dataclass(frozen=True, slots=True)
class Pdo:
    """A TPDO that a node sends: ``mapping`` is set only if it is not the default one."""

    name: str
    number: int
    can_id: int
    mapping: Mapping
    remapped: bool
    transmission: int
    event_ms: int

    @property
    def length(self) -> int:
        """Data bytes."""
        return sum(bits for _, _, bits in self.mapping) // 8


@dataclass(slots=True)
class Finger:
    """One node of the scene."""

    node_id: int
    gauges: int
    device: Device
    source: SimulatedSource
    load: LoadHistory | None
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
            record = self.calibration.record()
            self._download(indices.CALIBRATION_STAGED_RECORD, 0, record)
            self._write(indices.CALIBRATION_CHECK, 1, "<I", self.calibration.crc32())
            self._write(indices.CALIBRATION_COMMIT, 0, "<I", table.SIGNATURE_COMMIT)
        for number, _, base, *_ in table.tpdos(self.gauges):
            cob_id = (base + self.node_id if base else 0) | codes.NO_RTR
            self._write(communication.TPDO + number - 1, 1, "<I", cob_id | codes.COB_ID_INVALID)
        for pdo in self.pdos:
            self._enable(pdo)
        return sent

    def _enable(self, pdo: Pdo) -> None:
        """Write a PDO mapping by the procedure of CiA 301, 7.5.2.36; the PDO is invalid before."""
        if pdo.remapped:
            index = communication.TPDO_MAPPING + pdo.number - 1
            self._write(index, 0, "<B", 0)
            for k, (mapped, sub, bits) in enumerate(pdo.mapping, 1):
                self._write(index, k, "<I", mapped << 16 | sub << 8 | bits)
            self._write(index, 0, "<B", len(pdo.mapping))
        self._write(communication.TPDO + pdo.number - 1, 1, "<I", pdo.can_id | codes.NO_RTR)

    def _write(self, index: int, sub: int, packing: str, value: int) -> None:
        self._download(index, sub, struct.pack(packing, value))

    def _download(self, index: int, sub: int, data: bytes) -> None:
        abort = self.device.od.download(index, sub, data)
        if abort:
            raise InputError(f"node {self.node_id} rejects 0x{index:04X}:{sub:02X}: abort 0x{abort:08X}")


def node_pdos(group: schema.Nodes, node_id: int) -> tuple[Pdo, ...]:
    """Return the TPDOs that a node sends, in order."""
    wanted = {PDO_NAMES[name] for name in group.pdos}
    found = []
    for number, name, base, _enabled, transmission, event_ms, mapped in table.tpdos(len(layout(group.layout))):
        if name in wanted:
            default = tuple((index, sub, table.mapped_bits(index)) for index, sub in mapped)
            mapping = default if group.status else tuple(one for one in default if one[:2] != _STATUS)
            found.append(Pdo(name, number, base + node_id, mapping, mapping != default, transmission, event_ms))
    return tuple(found)


def build(scene: schema.Scene, folder: Path, built: list[str]) -> list[Finger]:
    """Return the fingers of a scene, not booted. ``folder``: the directory of relative calibration files.

    The name of each part that is built is appended to ``built``. Raises InputError for an invalid calibration file, for
    one with another number of gauges, and for a layout whose gauges cannot separate the forces.
    """
    return [_finger(scene, group, node_id, folder, built) for group in scene.nodes for node_id in group.ids]


def _finger(scene: schema.Scene, group: schema.Nodes, node_id: int, folder: Path, built: list[str]) -> Finger:
    gauges = len(layout(group.layout))
    load = load_of(scene, node_id)
    if group.filter is not None:
        built.append("filter")
    clock = Clock()
    source = source_of(scene, group, node_id, load, clock, built)
    calibration = _calibration(scene, group, source, folder, built)
    device = fingertip_node(node_id, source, gauges, serial=node_id)
    return Finger(node_id, gauges, device, source, load, node_pdos(group, node_id), calibration, group, clock)


def _calibration(
    scene: schema.Scene, group: schema.Nodes, source: SimulatedSource, folder: Path, built: list[str]
) -> Calibration | None:
    if group.calibration == "none":
        return None
    built.append("calibration")
    if group.calibration == "model":
        return _model_calibration(scene, group, source)
    from tipforce.host.configuration.calibration_file import read_calibration

    built.append("calibration file")
    found = read_calibration(below(folder, group.calibration, "nodes.calibration"))
    gauges = len(layout(group.layout))
    if found.gauges != gauges:
        raise InputError(f"calibration {group.calibration}: it is for {found.gauges} gauges, the layout has {gauges}")
    return found


def _model_calibration(scene: schema.Scene, group: schema.Nodes, source: SimulatedSource) -> Calibration:
    """Return the inverse of the structure's strain matrix, with the offsets and the noise that the scene names."""
    import numpy as np

    from tipforce.host.configuration.calibration import Calibration
    from tipforce.sensor.structure.geometry import FABRICATED
    from tipforce.sensor.structure.layouts import layout_code
    from tipforce.sensor.structure.strain import calibration_matrix

    gauges = len(layout(group.layout))
    count = 1.0 / source.converter[1]  # microstrain; rounding to it counts as noise
    white = scene.noise.gauge_microstrain or 0.0 if scene.noise is not None else 0.0
    return Calibration(
        C=calibration_matrix(FABRICATED, group.layout),
        offset_strain=1e-6 * np.array(group.offset_microstrain or [0.0] * gauges),
        covariance_strain2=1e-12 * (white**2 + count**2 / 12.0) * np.eye(gauges),
        serial=group.ids[0],
        layout_code=layout_code(group.layout),
        tip_radius_m=FABRICATED.r_m,
        pull=group.sense == "pull",
    )
