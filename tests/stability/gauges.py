"""Gauges that are saturated, stuck, open, silent, swapped, or lost: detection by the node and the host."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from fingertip import finger as rig
from stability.case import Observed
from tipforce.dictionary import indices, table
from tipforce.fingertip.source import Reading, Source
from tipforce.sensor.calibration.simulation import paper_grooves
from tipforce.sensor.contact import redundancy, scalar
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix
from tipforce.sources import simulated

_NOISE = 1e-13  # strain^2: three counts


class Fixed(Source):
    """A source that returns the same counts as a new sample at every call."""

    def __init__(self, counts: Sequence[int]) -> None:
        self.counts = tuple(counts)

    def read(self, now_us: int) -> Reading:
        del now_us
        return Reading(self.counts, 0, 2300)


def _noisy(load: rig.Load = rig.PUSH) -> rig.Finger:
    variance = [_NOISE if i == k else 0.0 for i in range(3) for k in range(i, 3)]
    finger = rig.finger(3, rig.record(variance=variance), load, noise_microstrain=0.3, emcy=True)
    finger.sync()
    return finger


def gauge_saturated() -> Observed:
    """3 gauges, SG1 at either end of its converter -> flagged: SG1 reads +-3276.7 with 6150h 03h or 05h, P and the
    angles are unknown, bit 2, EMCY 5010h"""
    figures, held = [], True
    for sign, six in ((1, 3), (-1, 5)):
        finger = rig.finger(emcy=True)
        finger.source.forces = lambda _now, sign=sign: (sign * 40.0, 0.1, -0.9)
        found = finger.sync()
        status, codes = finger.get("B", indices.CHANNEL_STATUS, 1), finger.emcy()
        held &= found.contact == rig.HUSHED and found.gauges == (sign * 32767, 100, -900) and status == six
        held &= bool(found.status & scalar.SATURATED) and finger.get("H", indices.FAULTS) == 1
        held &= codes == [table.EMCY_GAUGE_SATURATED]
        figures.append(f"SG1 {found.gauges[0] / 10:g}, 6150h {status:02.0f}h, status {found.status:02X}h")
    return held, "; ".join(figures)


def gauge_open() -> Observed:
    """3 gauges, the wire of SG2 is broken -> flagged: everything is unknown, bit 7, 2124h bit 10, EMCY 5030h"""
    finger = rig.finger(load=rig.PUSH, emcy=True)
    finger.sync()
    finger.break_gauge(simulated.OPEN, 2)
    found = finger.sync()
    faults, codes = int(finger.get("H", indices.FAULTS)), finger.emcy()
    held = found.contact == rig.HUSHED and found.gauges == rig.HUSHED and bool(found.status & scalar.FRONT_END_FAULT)
    held &= bool(faults >> table.FAULT_WIRE_BREAK & 1) and table.EMCY_FRONT_END in codes
    told = ", ".join(f"{code:04X}h" for code in codes)
    return held, f"status {found.status:02X}h, 2124h {faults:04X}h, EMCY {told}"


def gauge_stuck() -> Observed:
    """SG1 reads a constant while the load doubles; noise 3 counts -> flagged: from the 33rd reading all values are
    unknown: bit 7, 2124h bit 9, EMCY 5030h"""
    finger = _noisy()
    finger.break_gauge(simulated.STUCK, 1)
    finger.source.load = (2.0, *rig.PUSH[1:])
    known = [finger.sync(rig.PERIOD_US).contact != rig.HUSHED for _ in range(60)]
    last, faults, codes = finger.sync(), int(finger.get("H", indices.FAULTS)), finger.emcy()
    count = sum(known)
    held = count < 33 and known == [True] * count + [False] * (60 - count)
    held &= bool(last.status & scalar.FRONT_END_FAULT)
    held &= faults == 1 << table.FAULT_FROZEN and codes == [table.EMCY_FRONT_END]
    return held, f"shown for {count} readings, then status {last.status:02X}h, 2124h {faults:04X}h"


def gauge_stuck_without_noise() -> Observed:
    """SG1 reads a constant; its calibrated noise is below one count -> bounded: NOT detected by the node; F is off by
    SG1's column of C times the strain it misses, no more"""
    finger = rig.finger(load=rig.PUSH)
    finger.sync()
    finger.break_gauge(simulated.STUCK, 1)
    finger.source.load = (3.0, *rig.PUSH[1:])
    for _ in range(100):
        found = finger.sync()
    F = [finger.get("f", indices.PROCESS_VALUE, sub) for sub in (4, 5, 6)]
    off = np.subtract(F, rig.forces(finger.source.load))
    missed = 1e-6 * (finger.get("f", indices.PROCESS_VALUE, 1) - 100.0 * rig.forces(finger.source.load)[0])
    most = np.abs(np.array(rig.matrix())[:, 0] * missed) + 0.5e-3 * math.sqrt(3.0)
    held = found.contact != rig.HUSHED and bool((np.abs(off) <= most).all()) and abs(off[0]) > 0.1
    return held, f"no flag in 100 readings; F off by {off[0]:+.3f}, {off[1]:+.3f}, {off[2]:+.3f} N"


def gauge_silent() -> Observed:
    """the converter delivers no more samples -> flagged: the first SYNC has bit 3 and all unknown; after 100 ms bit 7,
    2124h bit 8, EMCY 5030h"""
    finger = rig.finger(load=rig.PUSH, emcy=True)
    counter = finger.sync().counter
    finger.break_gauge(simulated.SILENT)
    found = [finger.sync() for _ in range(121)]  # one each millisecond
    first, last = found[0], found[-1]
    faults, codes = int(finger.get("H", indices.FAULTS)), finger.emcy()
    stale = scalar.CALIBRATED | scalar.STALE
    held = [one.status for one in found] == [stale] * 100 + [stale | scalar.FRONT_END_FAULT] * 21
    held &= {one.counter for one in found} == {counter} and faults == 1 << table.FAULT_NO_DATA
    held &= first.contact == first.gauges == last.contact == rig.HUSHED and codes == [table.EMCY_FRONT_END]
    finger.break_gauge(0)
    again = finger.sync()
    held &= again.contact[0] == 1000 and again.counter == counter + 1 and finger.get("H", indices.FAULTS) == 0
    return held, f"status {first.status:02X}h at once, {last.status:02X}h after 121 ms, 2124h {faults:04X}h"


def _counts(load: rig.Load, n: int, lost: Sequence[int]) -> list[int]:
    F = rig.forces(load)
    exact = [1e7 * sum(c * f for c, f in zip(row, F, strict=True)) for row in rig.strain_per_newton(n)]
    return [32767 if k in lost else round(value) for k, value in enumerate(exact)]


def _eight(lost: Sequence[int]) -> tuple[rig.Finger, rig.Pdos]:
    finger = rig.finger(8, source=Fixed(_counts(rig.PUSH, 8, lost)))
    return finger, finger.sync()


def gauge_eight_five_lost() -> Observed:
    """8 gauges, 5 of them saturated, the other 3 respond to F1, F2, F3 -> pass: the force from the remaining 3 is
    right; bit 2 and 2124h name the lost ones"""
    worst, held = 0.0, True
    for lost in ((0, 1, 2, 3, 4), (0, 3, 4, 5, 7), (1, 2, 3, 6, 7)):
        finger, found = _eight(lost)
        F = [finger.get("f", indices.PROCESS_VALUE, sub) for sub in (9, 10, 11)]
        worst = max(worst, float(np.abs(np.subtract(F, rig.forces(rig.PUSH))).max()))
        faults = int(finger.get("H", indices.FAULTS))
        held &= bool(found.status & scalar.SATURATED) and faults == sum(1 << k for k in lost)
        held &= found.contact != rig.HUSHED and rig.UNKNOWN not in found.contact
    return held and worst <= 0.6e-3, f"3 sets of 5 lost: F off by at most {1e3 * worst:.2f} mN, one count is 1 mN"


def gauge_eight_no_rank() -> Observed:
    """8 gauges, 5 saturated, the other 3 respond to F1 twice and F2 -> flagged: P and both angles are unknown: the rank
    is below 3"""
    _, found = _eight((1, 2, 3, 4, 5))  # left: SG1 and SG7 see F1, SG8 sees F2
    return found.contact == rig.HUSHED and bool(found.status & scalar.SATURATED), f"status {found.status:02X}h"


def gauge_eight_all_lost() -> Observed:
    """all 8 gauges saturated -> flagged: P is unknown, no exception"""
    finger, found = _eight(range(8))
    shown = {finger.get("h", indices.PROCESS_VALUE + table.INT16_FORM, sub) for sub in range(1, 9)}
    held = found.contact == rig.HUSHED and shown == {32767} and finger.get("H", indices.FAULTS) == 0xFF
    return held, f"status {found.status:02X}h, gauges at {shown}, 2124h 00FFh"


def _pairs(n: int) -> list[list[int]]:
    """Return the order of the gauges with two of them swapped, for each pair."""
    found = [list(range(n)) for _ in itertools.combinations(range(n), 2)]
    for order, (i, k) in zip(found, itertools.combinations(range(n), 2), strict=True):
        order[i], order[k] = k, i
    return found


def gauge_swapped_six() -> Observed:
    """6 gauges, each pair of them swapped, load 1 N -> flagged: host parity.detect() reports a fault in most contacts
    where a swap costs 5 % of the force or more, for every pair; not in all: the difference of two readings may look
    like a force"""
    A, Sigma = strain_matrix(FABRICATED, ("L", "R", "K_H", "S_H", "T", "U")), 9e-14 * np.eye(6)
    C = redundancy.weighted_inverse(A, Sigma)
    model = redundancy.parity(C, Sigma)
    rng = np.random.default_rng(10)
    F = np.array([rig.forces((1.0, theta + 180.0 + tilt, theta)) for theta in range(15, 180, 15) for tilt in (-20, 5)])
    V = F @ A.T + 3e-7 * rng.standard_normal((len(F), 6))
    harmful = caught = 0
    shares = []
    for order in _pairs(6):
        swapped = V[:, order]
        off = np.linalg.norm(swapped @ C.T - F, axis=1) > 0.05
        fault = redundancy.detect(model, swapped).fault
        harmful, caught = harmful + int(off.sum()), caught + int((off & fault).sum())
        shares.append(float(fault[off].mean()))
    alarms = int(redundancy.detect(model, V).fault.sum())
    held = harmful > 100 and min(shares) > 0.5 and alarms == 0
    told = f"{caught} of {harmful} harmful contacts, {min(shares):.0%} or more of each pair"
    return held, f"{told}; {alarms} alarms of {len(F)} unswapped"


def gauge_swapped_three() -> Observed:
    """3 gauges, each pair of them swapped after the calibration -> bounded: NOT detectable by node or host: every
    reading of 3 gauges fits some force; F is off by at most sqrt(2) |C| times the difference of the two readings"""
    A = strain_matrix(FABRICATED, "III")
    C = calibration_matrix(FABRICATED, "III")
    F = np.array(rig.forces(rig.PUSH))
    V, worst, least = A @ F, 0.0, math.inf
    for order in _pairs(3):
        off = float(np.linalg.norm(C @ V[order] - F))
        moved = float(np.abs(V[order] - V).max())
        worst, least = max(worst, off / (math.sqrt(2.0) * float(np.linalg.norm(C, 2)) * moved)), min(least, off)
        # Any reading of three gauges corresponds to a force: there is no residual.
        if np.abs(A @ (C @ V[order]) - V[order]).max() > 1e-12 * np.abs(V).max():
            return False, "a residual shows"
    held = worst <= 1.0 and least > 0.01
    return held, f"no residual in any of 3 swaps; F of 1 N off by {least:.2f} N or more, {worst:.0%} of the bound"


def gauge_swapped_control_load() -> Observed:
    """3 gauges swapped, the paper's 10 grooves as control loads of 4.4 N -> flagged: every swap is detected: a control
    load is wrong by more than 10 standard uncertainties"""
    A, C = strain_matrix(FABRICATED, "III"), calibration_matrix(FABRICATED, "III")
    Sigma_F = 9e-14 * C @ C.T
    grooves = paper_grooves()
    F = force_vector(4.4, grooves.phi_rad, grooves.theta_rad)
    largest = []
    for order in _pairs(3):
        off = (F @ A.T)[:, order] @ C.T - F
        largest.append(float(np.sqrt(np.einsum("ij,jk,ik->i", off, np.linalg.inv(Sigma_F), off)).max()))
    return min(largest) > 10.0, f"deviations of {', '.join(f'{d:.0f}' for d in largest)} standard uncertainties"


def gauge_drift() -> Observed:
    """SG3 drifts by 1 microstrain/s for 20 s under no load, noise 3 counts -> bounded: F is off by 0.01 N per second,
    as C predicts, not more; a tare removes it"""
    finger = _noisy((0.0, 0.0, 0.0))
    finger.break_gauge(simulated.DRIFT, 3, 1.0)
    worst = 0.0
    for second in range(1, 21):
        finger.sync(1_000_000)
        worst = max(worst, abs(finger.get("f", indices.PROCESS_VALUE, 6) - 0.01 * second))
    before = finger.get("f", indices.PROCESS_VALUE, 6)
    finger.put("H", indices.COMMAND, 0, table.COMMAND_TARE)
    finger.sync()
    after = finger.get("f", indices.PROCESS_VALUE, 6)
    held = worst <= 0.015 and before > 0.15 and abs(after) < 0.02
    return held, f"F3 follows within {1e3 * worst:.0f} mN (noise 3 mN), {before:.3f} N, after the tare {after:.3f} N"
