"""The calibration of a simulated finger by beam theory, as ideal weights would yield it, and how a node gets it."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from canopen_device.core import codes, communication
from canopen_device.core.node import Device
from canopen_device.running.loop import MemoryStore
from tipforce.dictionary import indices, table
from tipforce.errors import InputError
from tipforce.fingertip.calibration import CALIBRATION_GROUP
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource

if TYPE_CHECKING:
    from tipforce.host.configuration.calibration import Calibration
    from tipforce.sensor.structure.strain import Gauge, Geometry

CALIBRATION = "calibration"
"""The name of its group in a store."""
LARGEST_NEWTONS = 15.0
"""Of those weights: the slit of the fabricated body closes at 15.2 N, it yields at 25 N (design table materials)."""
COUNT_MICROSTRAIN = 0.1
"""Of a converter of 16 bits; rounding to it counts as noise."""


def check_noise(noise_microstrain: float) -> float:
    """Return the noise. Raises InputError for one that is not 0 to 1e6 microstrain."""
    from tipforce.arrays import real
    from tipforce.host.configuration.measurements import LARGEST_MICROSTRAIN

    if not 0.0 <= real(noise_microstrain) <= LARGEST_MICROSTRAIN:
        raise InputError(f"noise_microstrain = {noise_microstrain!r}: allowed is 0 to {LARGEST_MICROSTRAIN:g}")
    return real(noise_microstrain)


def beam_calibration(layout: str = "I", pull: bool = False, noise_microstrain: float = 0.5) -> Calibration:
    """Return the calibration of a finger by beam theory, as ideal weights would yield it. Raises InputError."""
    from tipforce.sensor.structure.layouts import layout as points_of
    from tipforce.sensor.structure.strain import FABRICATED

    check_noise(noise_microstrain)
    return structure_calibration(
        FABRICATED, points_of(layout), noise_microstrain, pull=pull, calibrated_force_newtons=LARGEST_NEWTONS
    )


def structure_calibration(
    geometry: Geometry, gauges: Sequence[Gauge], noise_microstrain: float,
    count_microstrain: float = COUNT_MICROSTRAIN, offset_microstrain: Sequence[float] = (), **stated: Any,
) -> Calibration:  # fmt: skip
    """The calibration by beam theory; ``stated``: its other fields. Raises InputError for gauges without rank 3."""
    import numpy as np

    from tipforce.host.configuration.calibration import Calibration
    from tipforce.sensor.structure.layouts import layout_code
    from tipforce.sensor.structure.strain import gauge_matrix, gauge_name, pseudo_inverse

    n = len(gauges)
    return Calibration(
        C=pseudo_inverse(gauge_matrix(geometry, gauges), map(gauge_name, gauges)),
        offset_strain=1e-6 * np.array(offset_microstrain or [0.0] * n),
        covariance_strain2=1e-12 * (noise_microstrain**2 + count_microstrain**2 / 12.0) * np.eye(n),
        layout_code=layout_code(gauges),
        tip_radius_m=geometry.r_m,
        **stated,
    )


def pulls(load: tuple[float, float, float]) -> bool:
    """Return whether a load pulls: of the two points where its line meets the tip, it acts at cos(phi - theta) > 0."""
    P, phi_deg, theta_deg = load
    return P != 0.0 and math.cos(math.radians(phi_deg - theta_deg)) > 0.0


def stored_calibration(calibration: Calibration) -> bytes:
    """Return what a node that has it keeps under CALIBRATION. Raises InputError if the node rejects it."""
    store, gauges = MemoryStore(), calibration.gauges
    device = fingertip_node(1, SimulatedSource([(0.0, 0.0, 0.0)] * gauges), gauges, save=store.save, load=store.load)
    device.step(0)
    commit_calibration(device, calibration)
    download(device, communication.STORE_PARAMETERS, CALIBRATION_GROUP, struct.pack("<I", codes.SIGNATURE_SAVE))
    return store.groups[CALIBRATION]


def commit_calibration(device: Device, calibration: Calibration) -> None:
    """Stage, check and commit a calibration without a bus. Raises InputError if the node rejects it."""
    download(device, indices.CALIBRATION_STAGED_RECORD, 0, calibration.record())
    download(device, indices.CALIBRATION_CHECK, 1, struct.pack("<I", calibration.crc32()))
    download(device, indices.CALIBRATION_COMMIT, 0, struct.pack("<I", table.SIGNATURE_COMMIT))


def download(device: Device, index: int, sub: int, data: bytes) -> None:
    """Write an object of a simulated node without a bus. Raises InputError if the node rejects it."""
    abort = device.od.download(index, sub, data)
    if abort:
        raise InputError(f"node {device.node_id} rejects 0x{index:04X}:{sub:02X}: abort 0x{abort:08X}")
