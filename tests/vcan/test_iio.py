"""A node on three real kernel ADCs (Linux Industrial I/O) whose registers follow a recorded load.

Times are counted in SYNCs: in User-mode Linux nothing keeps real time. A SYNC and its answers take 1 to 3 ms there.

A SYNC gives what the node read in the same conversion period (6114h), if it did: for the SYNC before, or because it
looks after its converters every 40 ms. So a period passes between new registers and their SYNC, and no test depends on
how fast the machine is, or on what ran before it."""

import csv
import math
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fingertip.finger import FAULT, HUSHED, SATURATED, STALE, Pdos, forces, pdos_of
from host.bus_with_nodes import beam_calibration
from tipforce.host.network.bus import Bus
from tipforce.sensor.contact import scalar_uncertainty
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from vcan.adc import ADDRESSES, COUNTS, Adcs, load_modules
from vcan.support import NODE_ID, SYNC, Command, Frame, RawBus, running_node

LAYOUT = """\
points = ["K_H", "S_H", "U"]
[bridge]
kind = "quarter"
gauge_factor = 2.0
excitation_volts = 3.3
gain = 976.5625
zero_volts = 1.65
volts_per_count = 0.0008056640625
"""
PER_MICROSTRAIN = 2.0  # counts: 1.65e-6 V * gain / volts_per_count
ZERO = COUNTS // 2
NOISE_COUNTS = 1.5
EMCY = 0x080 + NODE_ID
CONTACT = 0x280 + NODE_ID
CONVERSION_S = 500e-6  # the default of 6114h
NO_DATA = 8
Z = 6.0  # bound of an error in standard uncertainties
STRAIN = strain_matrix(FABRICATED, "I")
SIGMA_STRAIN = 1e-6 * math.hypot(NOISE_COUNTS, math.sqrt(1 / 12)) / PER_MICROSTRAIN  # noise and rounding to counts
CALIBRATION = beam_calibration(covariance_strain2=np.eye(3) * SIGMA_STRAIN**2, serial=8)
RECORDING = Path(__file__).with_name("recorded_load.csv")


def recorded_load() -> list[tuple[float, float, float]]:
    """P newtons, phi and theta degrees: 4.4 N around the tip, then growing and turning."""
    with RECORDING.open() as file:
        return [(float(row["P_N"]), float(row["phi_deg"]), float(row["theta_deg"])) for row in csv.DictReader(file)]


class Rig:
    """The ADCs, the bus, and what is wrong with the gauges."""

    def __init__(self, adcs: Adcs, bus: RawBus) -> None:
        self.adcs, self.bus = adcs, bus
        self._chance = np.random.default_rng(8)
        self.still: set[int] = set()
        self.load = (0.0, 0.0, 0.0)
        self.frames: list[Frame] = []

    def move(self) -> None:
        force = forces(self.load)
        exact = ZERO + PER_MICROSTRAIN * 1e6 * STRAIN @ force + self._chance.normal(0.0, NOISE_COUNTS, 3)
        for k, address in enumerate(ADDRESSES):
            if k not in self.still:
                self.adcs.set(address, round(exact[k]))

    def sample(self) -> Pdos:
        """New registers, a SYNC, and what the node sends to it; ``frames``: all up to its last PDO."""
        self.move()
        time.sleep(CONVERSION_S)
        self.bus.send(SYNC)
        self.frames = self.bus.until(lambda frame: frame[0] == CONTACT)
        return pdos_of(self.frames)

    def until(self, code: int, cured: bool, detail: int) -> tuple[Pdos, int]:
        """Samples until this EMCY came; the last sample, and how many SYNCs it took."""
        for syncs in range(1, 1001):
            found = self.sample()
            if tells(self.frames, code, cured, detail):
                return found, syncs
        raise AssertionError(f"no EMCY {code:04X}h, detail {detail}, cured: {cured}")


def tells(frames: list[Frame], code: int, cured: bool, detail: int) -> bool:
    """Is there an EMCY of this error, or of its end?"""
    wanted = struct.pack("<H", 0) if cured else struct.pack("<H", code)
    tail = struct.pack("<HH", code, detail) if cured else struct.pack("<HH", detail, 0)
    return any(can_id == EMCY and data[:2] == wanted and data[3:7] == tail for can_id, data in frames)


@pytest.fixture(scope="module")
def adcs(own_kernel: None) -> Iterator[Adcs]:  # noqa: ARG001 (it must be one)
    load_modules()
    found = Adcs()
    yield found
    found.close()


@pytest.fixture(scope="module")
def iio_node(
    adcs: Adcs,  # noqa: ARG001 (they must be there first)
    tmp_path_factory: pytest.TempPathFactory,
    host: Bus,
) -> Iterator[Command]:
    """Node 5 on the three ADCs, calibrated and operational, with fast heartbeats."""
    folder = tmp_path_factory.mktemp("iio")
    (folder / "finger.toml").write_text(LAYOUT)
    flags = ("--layout", str(folder / "finger.toml"), "--source", "iio:0-0050,iio:device1,device2/voltage")
    with running_node(folder, *flags) as node:
        host.finger(NODE_ID).apply_calibration(CALIBRATION, store=False)
        yield node
        assert "Traceback" not in node.stderr


@pytest.fixture
def rig(adcs: Adcs, iio_node: Command, bus: RawBus) -> Rig:
    assert iio_node.stdout == ""
    bus.start_node()
    return Rig(adcs, bus)


def test_the_host_sees_the_recorded_contact_within_the_bound(rig: Rig) -> None:
    # The covariance of F, its upper triangle by rows.
    covariance = (CALIBRATION.C @ CALIBRATION.covariance_strain2 @ CALIBRATION.C.T)[np.triu_indices(3)].tolist()
    worst = np.zeros(3)
    loads = recorded_load()
    assert len(loads) >= 50
    for rig.load in loads:
        found = rig.sample()
        assert not found.status & (STALE | FAULT | SATURATED), hex(found.status)
        P, phi, theta = found.contact[0] * 1e-3, found.contact[1] * 0.01, found.contact[2] * 0.01
        truth_P, truth_phi, truth_theta = rig.load
        u = scalar_uncertainty.uncertainty(*forces(rig.load), covariance, True)
        errors = (P - truth_P, turned(phi - truth_phi), turned(theta - truth_theta))
        bounds = (Z * u[0] + 5e-4, math.degrees(Z * u[1]) + 5e-3, math.degrees(Z * u[2]) + 5e-3)
        assert all(abs(error) <= bound for error, bound in zip(errors, bounds, strict=True)), (rig.load, errors, bounds)
        worst = np.maximum(worst, np.abs(errors) / bounds)
    assert worst.max() > 0.1, "a bound that wide would say nothing"


def turned(degrees: float) -> float:
    return (degrees + 180.0) % 360.0 - 180.0


@pytest.mark.parametrize("gauge", [0, 2])
def test_a_device_that_is_pulled_out_is_no_data_and_comes_back_by_itself(rig: Rig, gauge: int) -> None:
    rig.load = (3.0, 90.0, 30.0)
    rig.sample()
    rig.adcs.pull_out(ADDRESSES[gauge])
    rig.still = {gauge}
    found, syncs = rig.until(0x5030, False, NO_DATA)
    assert syncs <= 2
    assert found.status & STALE
    assert found.status & FAULT
    assert found.gauges == found.contact == HUSHED
    for _ in range(5):
        assert rig.sample().contact == HUSHED
    rig.adcs.plug_in(ADDRESSES[gauge])
    rig.still = set()
    rig.until(0x5030, True, NO_DATA)
    assert not rig.sample().status & (STALE | FAULT)


def test_devices_that_come_back_under_other_numbers_are_still_their_gauges(rig: Rig) -> None:
    rig.load = (4.0, 60.0, 20.0)
    for address in ADDRESSES[:2]:
        rig.adcs.pull_out(address)
    rig.still = {0, 1}
    rig.until(0x5030, False, NO_DATA)
    for address in reversed(ADDRESSES[:2]):  # the second becomes iio:device0
        rig.adcs.plug_in(address)
    assert Path("/sys/bus/iio/devices/iio:device0").resolve().parent.name == f"0-{ADDRESSES[1]:04x}"
    rig.still = set()
    rig.until(0x5030, True, NO_DATA)
    found = [rig.sample() for _ in range(20)]
    assert abs(np.mean([one.contact[0] for one in found]) - 4000) < 100
    assert abs(np.mean([one.contact[1] for one in found]) - 6000) < 200
