"""The demo: calibrate and store three simulated nodes over SDO, load them as in the paper, read them by PDO. Input from
the paper: the fabricated geometry, the three gauge cases, the grooves and the 4.4 N weight."""

import contextlib
import datetime
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import can
import numpy as np

from canopen_device.core import codes
from canopen_device.core.node import Device
from canopen_device.running import loop
from canopen_device.running.loop import MemoryStore
from canopen_device.running.open_bus import PythonCanPort
from tipforce.arrays import FloatArray
from tipforce.dictionary import objects as od
from tipforce.dictionary.table import UNKNOWN_I16
from tipforce.errors import RefusedError
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.network.bus import Bus
from tipforce.sensor.contact import estimate as contact_model
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.layouts import CASES, GROOVES_DEG, layout_code
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix
from tipforce.sources.simulated import SimulatedSource

WEIGHT_NEWTONS = 4.4
NOISE_MICROSTRAIN = 0.5
OFFSETS_MICROSTRAIN = (12.0, -8.5, 5.3)
COUNT_MICROSTRAIN = 0.1
HALF_STEP = np.array([0.0005, 0.005, 0.005])  # of P (N), phi and theta (degree) in TPDO2
FAMILY_WISE_ERROR = 1e-6
QUANTITIES = ("P_N", "phi_deg", "theta_deg")
SPOILED_FACTOR = 1.1


@dataclass(frozen=True)
class Result:
    """One load on one node; triples are P in newtons, phi and theta in degrees."""

    case: str
    sense: str
    applied: FloatArray
    estimated: FloatArray
    host: FloatArray
    u: FloatArray
    bound: FloatArray
    host_bound: FloatArray

    @property
    def error(self) -> FloatArray:
        """Estimate minus applied load, angles wrapped."""
        return _difference(self.estimated, self.applied)

    @property
    def inside(self) -> bool:
        """Whether every error is inside its bound (a missing value is outside)."""
        return bool(np.all(np.abs(self.error) <= self.bound))

    @property
    def host_agrees(self) -> bool:
        """Whether the host's estimate from the gauge PDO equals the node's within the resolution of both PDOs."""
        return bool(np.all(np.abs(_difference(self.host, self.estimated)) <= self.host_bound))


def case_calibration(case: str, pull: bool) -> Calibration:
    """Return the calibration of one gauge case by beam theory, with the simulated gauges' offset and noise."""
    variance = NOISE_MICROSTRAIN**2 + COUNT_MICROSTRAIN**2 / 12.0  # rounding to counts is noise
    return Calibration(
        calibration_matrix(FABRICATED, case), 1e-6 * np.array(OFFSETS_MICROSTRAIN), 1e-12 * variance * np.eye(3),
        serial=CASES.index(case) + 1, date=int(f"{datetime.date.today():%Y%m%d}"), layout_code=layout_code(case),
        tip_radius_m=FABRICATED.r_m, pull=pull,
    )  # fmt: skip


def coverage_factor(comparisons: int) -> float:
    """Return z such that ``comparisons`` two-sided normal checks all hold with probability 1 - FAMILY_WISE_ERROR."""
    return statistics.NormalDist().inv_cdf(1.0 - FAMILY_WISE_ERROR / (2 * comparisons))


def bounds(calibration: Calibration, applied: FloatArray, z: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (standard uncertainty, bound of the node's error, bound of host minus node), each for P, phi, theta.

    ``applied`` is (P newtons, phi degree, theta degree). The bound is z standard uncertainties from gauge noise, plus
    half a count of every gauge propagated to the quantity, plus half a step of the PDO's resolution."""
    P, phi, theta = applied[0], *np.radians(applied[1:])
    F = force_vector(P, phi, theta)[np.newaxis]
    u = contact_model.standard_uncertainties(F, calibration.covariance_F, pull=calibration.pull)[0]
    half_count = 0.5e-6 * COUNT_MICROSTRAIN
    steps = np.zeros(3)
    for gauge in calibration.C.T:
        # The effect of half a count in this gauge: the standard uncertainty if it were the only noise.
        alone = np.outer(gauge, gauge) * half_count**2
        steps += contact_model.standard_uncertainties(F, alone, pull=calibration.pull)[0]
    in_units = np.array([1.0, 180.0 / np.pi, 180.0 / np.pi])
    u, steps = u * in_units, steps * in_units
    return u, z * u + steps + HALF_STEP, steps + HALF_STEP


def run_demo(seed: int, spoil: bool, say: Callable[[str], None], advance: Callable[[], None]) -> Iterator[Result]:
    """Run the demo on an in-process bus; yield one Result per load and node.

    ``say`` gets a line per step, ``advance`` is called once per load. ``spoil`` corrupts one element of each matrix.
    Raises RefusedError if a node has lost its stored calibration after the reset."""
    comparisons = len(CASES) * 2 * len(GROOVES_DEG) * len(QUANTITIES)
    z = coverage_factor(comparisons)
    with _nodes(seed) as connection:
        for pull in (True, False):
            calibrations = {k + 1: case_calibration(case, pull) for k, case in enumerate(CASES)}
            for node_id, calibration in calibrations.items():
                C = calibration.C.copy()
                C[0, 0] *= SPOILED_FACTOR if spoil else 1.0
                _calibrate(connection, node_id, replace(calibration, C=C), say)
            connection.nmt("start")
            for phi, theta in GROOVES_DEG:
                opposite = phi + 180.0 if phi <= 0.0 else phi - 180.0
                applied = np.array([WEIGHT_NEWTONS, phi if pull else opposite, theta])
                yield from _one_load(connection, calibrations, applied, z)
                advance()
            connection.nmt("preop")


@contextlib.contextmanager
def _nodes(seed: int) -> Iterator[Bus]:
    """Run nodes 1, 2, 3 with cases I, II, III in one thread on python-can's virtual bus, and yield a host on it."""
    devices: list[Device] = []
    channel = f"tipforce-demo-{id(devices)}"
    for k, case in enumerate(CASES):
        rows, store = strain_matrix(FABRICATED, case).tolist(), MemoryStore()
        source = SimulatedSource(rows, NOISE_MICROSTRAIN, OFFSETS_MICROSTRAIN, seed + k)
        devices.append(fingertip_node(k + 1, source, serial=k + 1, save=store.save, load=store.load))
    with (
        can.Bus(interface="virtual", channel=channel) as node_bus,
        Bus(can.Bus(interface="virtual", channel=channel)) as connection,
        loop.running(devices, PythonCanPort(node_bus)),
    ):
        connection.wait_for({codes.HEARTBEAT_BASE + device.node_id for device in devices})
        yield connection


def _calibrate(connection: Bus, node_id: int, calibration: Calibration, say: Callable[[str], None]) -> None:
    finger = connection.finger(node_id)
    prefix = f"node {node_id}, case {CASES[node_id - 1]}, {'pull' if calibration.pull else 'push'}: "
    finger.apply_calibration(calibration, on_step=lambda step: say(prefix + step))
    connection.buffer.clear()
    connection.nmt("reset-node", node_id)
    connection.wait_for({codes.HEARTBEAT_BASE + node_id})
    differences = finger.verify_calibration(calibration)
    if differences:
        raise RefusedError(f"node {node_id} lost its calibration in a reset: {differences[0]}")
    say(prefix + f"after a reset the stored calibration is active (CRC-32 0x{calibration.crc32():08X})")


def _one_load(connection: Bus, calibrations: dict[int, Calibration], applied: FloatArray, z: float) -> Iterator[Result]:
    for node_id in calibrations:
        for entry, value in zip((od.SIMULATION_P, od.SIMULATION_PHI, od.SIMULATION_THETA), applied, strict=True):
            connection.sdo(node_id).write(entry, float(value))
    time.sleep(0.002)  # a conversion under the new load
    connection.buffer.clear()
    connection.sync()
    gauges, contact = codes.TPDO_BASES[:2]
    frames = connection.wait_for({base + node_id for base in (gauges, contact) for node_id in calibrations})
    data = {int(frame["can_id"]): bytes(frame["data"]) for frame in frames}
    for node_id, calibration in calibrations.items():
        strain = 1e-6 * _quantities(data[gauges + node_id], COUNT_MICROSTRAIN)
        estimated = _quantities(data[contact + node_id], 2.0 * HALF_STEP)
        F = contact_model.force_from_strain(calibration.C, strain, calibration.offset_strain)
        own = contact_model.contacts(F, pull=calibration.pull)
        host = np.array([own.P_newtons, np.degrees(own.phi_rad), np.degrees(own.theta_rad)], dtype=np.float64)
        u, bound, host_bound = bounds(calibration, applied, z)
        sense = "pull" if calibration.pull else "push"
        yield Result(CASES[node_id - 1], sense, applied, estimated, host.ravel(), u, bound, host_bound)


def _quantities(data: bytes, step: float | FloatArray) -> FloatArray:
    raw = np.frombuffer(data, "<i2", 3)
    return np.where(raw == UNKNOWN_I16, np.nan, raw * step)


def _difference(a: FloatArray, b: FloatArray) -> FloatArray:
    difference = a - b
    difference[1:] = (difference[1:] + 180.0) % 360.0 - 180.0
    return difference
