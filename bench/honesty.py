"""Does "ok" mean ok? Simulated fingers with one fault each; rows that say ok and are wrong, against the bounds.

python -m bench.honesty    1000 calibrations a cell (two hours); --calibrations 20, --part grid: fewer, one table

A row is wrong where its P is off by more than five of its own standard uncertainties. Exit code 1 where the data can
tell and more than 1 in 10,000 of the rows that say ok are wrong, or where good fingers are not as good as they must be.
"""

from __future__ import annotations

import datetime
import math
import os
from collections import Counter, defaultdict
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from statistics import NormalDist

import numpy as np
from bench.measure import arguments, in_processes, table

import tipforce
from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.fitting import FitRequest, fitted
from tipforce.host.configuration.measurements import Measurements
from tipforce.samples.reasons import Status
from tipforce.sensor import covariance_of_estimate
from tipforce.sensor.calibration.simulation import paper_grooves, true_matrix
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.contact.redundancy import parity
from tipforce.sensor.contact.scalar_redundancy import LEAST_SHARE
from tipforce_lab.report.studies.honesty import GAUGES, says_ok

FULL = 1000
ALLOWED_WRONG_PER_10000 = 1.0
ALLOWED_ALARMS_PER_100000 = 1.0
ALARM_ROWS = 10_000  # of each calibration
LEAST_OK, LARGEST_U_RATIO = 0.99, 1.2
CLEAN_COVERAGE, LEAST_COVERAGE = (0.93, 0.97), 0.93
GRID = tuple(product((5, 8, 12, 19), (1, 2, 3), (1, 2, 3)))  # grooves, weights, repeats
PARTS = ("faults", "grid", "alarms", "drift")
_HEADER = ["gauges", "rig", "fault", "refused", "says ok, %", "wrong in 10,000", "95 % holds, %", "u / error",
           "verdict"]  # fmt: skip
HEADERS = {
    "faults": _HEADER,
    "grid": _HEADER,
    "alarms": ["gauges", "good samples", "false alarms", "verdict"],
    "drift": ["drifting gauge", "samples", "wrong in 10,000", "P known after the find, %", "verdict"],
}
NOISE, OFFSET = 1e-6, 30e-6
CONVERTER_LIMIT = 2000e-6
ROWS = 200  # readings of each finger and fault, 100 a second
DRIFT_STRAIN = 0.5e-6  # of each reading: 50 microstrain/s
CHUNK = 20_000
FACTOR_95 = 1.959964
WEIGHTS_NEWTONS = (4.4, 2.2, 1.1)
WARM_K = 20.0
SI_EVERY = 10
QUADRATIC = 100.0  # 10 % per 1000 microstrain
GROOVE_ERROR_RAD = float(np.radians(0.5))

AFTER = ("clean", "drift", "stuck", "open", "rail", "gain", "overload", "warm, calibrated cold")
"""Faults of readings, on a calibration that is good."""
IN_CALIBRATION = ("warm, coefficients known", "nonlinear", "SI units")
OF_ONE_GAUGE = ("drift", "stuck", "gain")
SPEAKS = 3.5  # chi-square (1.9 sigma): residuals that a fault explains less of do not speak for it
INVISIBLE = " of an invisible gauge"
"""Cells of their own: the product counts such a gauge as one whose fault no residual shows (LEAST_SHARE)."""


@dataclass(frozen=True, slots=True)
class Rig:
    """Which loads a calibration hangs."""

    grooves: int = 19
    weights: int = 3
    repeats: int = 1
    groove_error_rad: float = 0.0


@dataclass(slots=True)
class Cell:
    """Counts over the fingers of one case."""

    gauges: int
    fault: str
    rig: Rig
    counts: defaultdict[str, float] = field(default_factory=lambda: defaultdict(int))
    """calibrations, rows, ok: rows that say ok; of those wrong: P is off by more than five of their own standard
    uncertainties, and covered: their 95 % interval of P holds the truth, with the sums error2 and u2 of squares.
    Sums over the rows of a faulty gauge, passes_5u and passes_2u: the chance that the residuals do not speak for a
    fault that moves P by so many u(P)."""
    refused: Counter[str] = field(default_factory=Counter)
    shares: dict[str, float] = field(default_factory=dict)
    """Of the faulty gauges' own noise, the least that showed in the residuals of a finger."""

    def add(self, other: Cell) -> None:
        for name, count in other.counts.items():
            self.counts[name] += count
        self.refused += other.refused
        for name, share in other.shares.items():
            self.shares[name] = min(share, self.shares.get(name, 1.0))

    def ratio(self, part: str, whole: str) -> float:
        """One count over another, NaN where there is none."""
        return self.counts[part] / self.counts[whole] if self.counts[whole] else float("nan")

    @property
    def wrong_per_10000(self) -> float:
        return 1e4 * self.ratio("wrong", "ok") if self.counts["ok"] else 0.0

    @property
    def u_over_error(self) -> float:
        """Root mean square u(P) over root mean square error, of the rows that say ok."""
        return math.sqrt(self.ratio("u2", "error2"))


def cells(gauges: int, rig: Rig, faults: tuple[str, ...], calibrations: int, jobs: int = 1) -> list[Cell]:
    """The cells of all faults, each over so many fingers; finger k has the seed k."""
    task = partial(_finger, gauges, rig, faults)
    names = (name for fault in faults for name in (fault, fault + INVISIBLE))
    totals = {name: Cell(gauges, name, rig) for name in names}
    for of_finger in in_processes(task, range(calibrations), jobs):
        for cell in of_finger:
            totals[cell.fault].add(cell)
    return [cell for cell in totals.values() if cell.counts]


def _finger(gauges: int, rig: Rig, faults: tuple[str, ...], seed: int) -> list[Cell]:
    """One finger through every fault; those of readings share its good calibration."""
    rng = np.random.default_rng([seed, gauges, rig.grooves, rig.weights, rig.repeats])
    finger = _Sensor.of(gauges, rng)
    counted, good = [], None
    for fault in faults:
        if fault == "SI units" and seed % SI_EVERY:
            continue  # refused by its size alone: a tenth of the fits shows it
        cell = Cell(gauges, fault, rig)
        cell.counts["calibrations"] = 1
        sensor = replace(finger, quadratic=QUADRATIC) if fault == "nonlinear" else finger
        try:
            if fault in AFTER and good is None:
                good = sensor.calibrated(rig, rng, fault)
            calibration = good if fault in AFTER and good is not None else sensor.calibrated(rig, rng, fault)
        except InputError as error:
            cell.refused[str(error)[:60]] += 1
        else:
            _judge(cell, calibration, sensor, rng)
        counted.append(cell)
    return counted


@dataclass(frozen=True, slots=True, eq=False)
class _Sensor:
    A: FloatArray
    offset: FloatArray
    per_K: FloatArray
    gain_per_K: float
    quadratic: float = 0.0

    @classmethod
    def of(cls, gauges: int, rng: np.random.Generator) -> _Sensor:
        A = true_matrix(GAUGES[:gauges], rng)
        return cls(A, OFFSET * rng.normal(size=gauges), 3e-6 * rng.normal(size=gauges), 5e-4 * rng.normal())

    def read(self, F: FloatArray, rng: np.random.Generator, warmer_K: FloatArray | float = 0.0) -> FloatArray:
        """Readings under F (m, 3), before the converter."""
        change = np.broadcast_to(np.asarray(warmer_K, dtype=np.float64), len(F))[:, np.newaxis]
        elastic = F @ self.A.T * (1.0 + self.gain_per_K * change)
        elastic = elastic * (1.0 + self.quadratic * elastic)
        noise = NOISE * rng.normal(size=elastic.shape)
        strain: FloatArray = elastic + self.offset + self.per_K * change + noise
        return strain

    def calibrated(self, rig: Rig, rng: np.random.Generator, fault: str) -> Calibration:
        """What `tipforce calibrate fit` makes of its rows. Raises InputError where it refuses."""
        P, phi, theta, groove = _loads(rig, rng)
        wrong = rig.groove_error_rad * rng.normal(size=(2, int(groove.max()) + 1))[:, groove]
        warmer = rng.uniform(-25.0, 25.0, P.size) if fault == "warm, coefficients known" else np.zeros(P.size)
        strain = self.read(force_vector(P, phi + wrong[0], theta + wrong[1]), rng, warmer)
        strain = strain * (1e-6 if fault == "SI units" else 1.0)
        lines = np.arange(P.size) + 2
        data = Measurements(lines, strain, P, phi, theta, None, 20.0 + warmer, None, None, (), ())
        return fitted(_REQUEST, data).calibration


def _loads(rig: Rig, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """P, phi, theta and groove of each row, a tare after every groove."""
    paper = paper_grooves()
    chosen = rng.choice(len(paper.phi_rad), rig.grooves, replace=False)
    rows = []
    for number, k in enumerate(chosen):
        phi, theta = float(paper.phi_rad[k]), float(paper.theta_rad[k])
        rows += [(weight, phi, theta, number) for weight in WEIGHTS_NEWTONS[: rig.weights]] * rig.repeats
        rows.append((0.0, 0.0, 0.0, number))
    P, phi, theta, groove = np.array(rows).T
    return P, phi, theta, groove.astype(np.int64)


def _touches(rng: np.random.Generator, rows: int, largest: float) -> tuple[FloatArray, FloatArray]:
    """P and F of pushes over the pad, newtons."""
    P, theta = rng.uniform(0.3, largest, rows), rng.uniform(0.2, np.pi - 0.2, rows)
    return P, force_vector(P, theta + np.radians(rng.uniform(-45.0, 45.0, rows)) + np.pi, theta)


def false_alarms(gauges: int, rows: int, seed: int) -> int:
    """Of so many good samples of a calibrated finger, those in which the gauges contradict each other."""
    rng = np.random.default_rng([seed, gauges])
    sensor = _Sensor.of(gauges, rng)
    calibration, alarms = sensor.calibrated(Rig(), rng, "clean"), 0
    for _ in range(0, rows, CHUNK):
        V = sensor.read(_touches(rng, CHUNK, max(WEIGHTS_NEWTONS))[1], rng)
        alarms += int(tipforce.estimate(calibration, V * 1e6, temperature_degC=20.0).has(Status.CONTRADICTION).sum())
    return alarms


def drifting(gauge: int, seed: int) -> tuple[int, int, float]:
    """(samples, samples that show a P off by more than five u(P), share of those after the find that have a P).

    Five gauges under one steady load at 1 kHz for ten seconds, of which one drifts by 50 microstrain/s."""
    rng = np.random.default_rng([seed, gauge])
    sensor = _Sensor.of(5, rng)
    calibration = sensor.calibrated(Rig(), rng, "clean")
    P, F = (np.repeat(touch, 10_000, axis=0) for touch in _touches(rng, 1, max(WEIGHTS_NEWTONS)))
    V = sensor.read(F, rng)
    V[:, gauge] += rng.choice([-1.0, 1.0]) * 0.05e-6 * np.arange(len(V))
    shown = tipforce.estimate(calibration, V * 1e6, temperature_degC=20.0)
    known, contradict = np.isfinite(shown.P_newtons), shown.has(Status.CONTRADICTION)
    wrong = np.abs(shown.P_newtons - P) > 5.0 * shown.u_P_newtons
    after = known[int(contradict.argmax()) :] if contradict.any() else known[:0]
    return len(V), int((wrong & known).sum()), float(after.mean()) if after.size else float("nan")


def _judge(cell: Cell, calibration: Calibration, sensor: _Sensor, rng: np.random.Generator) -> None:
    """Readings of a finger that touches things, what the product shows of them, and the truth."""
    largest = 3.0 * max(WEIGHTS_NEWTONS) if cell.fault == "overload" else max(WEIGHTS_NEWTONS)
    P, F = _touches(rng, ROWS, largest)
    warmer = WARM_K if cell.fault.startswith("warm") else 0.0
    gauge = int(rng.integers(calibration.gauges))
    V = sensor.read(F, rng, warmer)
    if cell.fault == "drift":
        V[:, gauge] += rng.choice([-1.0, 1.0]) * DRIFT_STRAIN * np.arange(len(V))
    elif cell.fault == "stuck":
        V[:, gauge] = V[0, gauge]
    elif cell.fault in ("open", "rail"):
        V[:, gauge] = CONVERTER_LIMIT * (1.0 if cell.fault == "open" else rng.choice([-1.0, 1.0]))
    elif cell.fault == "gain":
        V[:, gauge] *= 1.1
    V = np.clip(V, -CONVERTER_LIMIT, CONVERTER_LIMIT)
    shown = tipforce.estimate(calibration, V * 1e6, temperature_degC=20.0 + warmer)
    ok = says_ok(shown)
    error, u = np.abs(shown.P_newtons - P)[ok], shown.u_P_newtons[ok]
    cell.counts.update(rows=ROWS, ok=int(ok.sum()), wrong=int((error > 5.0 * u).sum()),
                       covered=int((error <= FACTOR_95 * u).sum()))  # fmt: skip
    cell.counts["error2"], cell.counts["u2"] = float(error @ error), float(u @ u)
    if cell.fault in OF_ONE_GAUGE:
        _tell(cell, calibration, gauge, F)


def _tell(cell: Cell, calibration: Calibration, gauge: int, F: FloatArray) -> None:
    """What the residuals of good readings under F (m, 3) can tell of a fault of the gauge."""
    Sigma, C, point = calibration.covariance_strain2, calibration.C, GAUGES[gauge]
    visible = parity(C, Sigma).visible[gauge] if len(Sigma) > 3 else 0.0
    cell.shares[point] = float(visible * Sigma[gauge, gauge])
    if cell.shares[point] < LEAST_SHARE:
        cell.fault += INVISIBLE
    assert calibration.parameter_covariance is not None
    covariance = covariance_of_estimate(C, Sigma, calibration.parameter_covariance, F)
    along = F / np.linalg.norm(F, axis=1, keepdims=True)
    u = np.sqrt(np.einsum("mi,mij,mj->m", along, covariance, along))
    # A fault of u(P) shows by so many standard deviations of the residuals.
    shown = np.sqrt(visible) * u / np.abs(along @ C[:, gauge])
    for size, name in ((5.0, "passes_5u"), (FACTOR_95, "passes_2u")):
        cell.counts[name] = sum(NormalDist().cdf(SPEAKS**0.5 - size * sigmas) for sigmas in shown.tolist())


_REQUEST = FitRequest(saturation=CONVERTER_LIMIT * 1e6, sense="push", date=datetime.date(2025, 12, 31))


def verdict(cell: Cell) -> str:
    """What the bounds say of a cell: good, why the data cannot tell, or what is out."""
    if not cell.counts["ok"]:
        return "good: refused" if cell.refused else "good: never ok"
    out = []
    if cell.wrong_per_10000 > ALLOWED_WRONG_PER_10000:
        out.append("wrong rows")
    low, high = CLEAN_COVERAGE if cell.fault == "clean" else (LEAST_COVERAGE, 1.0)
    if not low <= cell.ratio("covered", "ok") <= high:
        out.append("coverage")
    if cell.fault == "clean" and not cell.rig.groove_error_rad:
        out += ["ok share"] * (cell.ratio("ok", "rows") < LEAST_OK) + ["u(P)"] * (cell.u_over_error > LARGEST_U_RATIO)
    if not out:
        return "good"
    reason = cannot_tell(cell, out)
    return f"cannot tell: {reason}" if reason else "out: " + ", ".join(out)


def cannot_tell(cell: Cell, out: list[str]) -> str | None:
    """Why the residuals cannot tell such a fault, from the matrix and the noise; None where they can."""
    if cell.fault.endswith(INVISIBLE):
        shares = ", ".join(f"{name} {100.0 * share:.2g} %" for name, share in sorted(cell.shares.items()))
        least = 100.0 * LEAST_SHARE
        return f"of its own noise the residuals show, at least, {shares} ({least:.0f} % needed)"
    if cell.fault not in OF_ONE_GAUGE:
        return None
    passes_5u, passes_2u = 1e4 * cell.ratio("passes_5u", "rows"), 100.0 * cell.ratio("passes_2u", "rows")
    if ("wrong rows" in out and passes_5u <= ALLOWED_WRONG_PER_10000) or (
        "coverage" in out and passes_2u <= 100.0 * (1.0 - LEAST_COVERAGE)
    ):
        return None
    return f"a fault of 5 u(P) passes in {passes_5u:.0f} of 10,000 readings, one of 2 u(P) in {passes_2u:.0f} %"


def row_of(cell: Cell) -> list[str]:
    rig = f"{cell.rig.grooves} x {cell.rig.weights} x {cell.rig.repeats}"
    rig += " off by 0.5" if cell.rig.groove_error_rad else ""
    return [
        str(cell.gauges), rig, cell.fault, f"{cell.refused.total()} of {cell.counts['calibrations']}",
        f"{100.0 * cell.ratio('ok', 'rows'):.1f}", f"{cell.wrong_per_10000:.1f}",
        f"{100.0 * cell.ratio('covered', 'ok'):.1f}", f"{cell.u_over_error:.2f}", verdict(cell),
    ]  # fmt: skip


def alarms(calibrations: int, jobs: int) -> list[list[str]]:
    """False alarms of good samples, a row for each number of gauges."""
    samples, rows = calibrations * ALARM_ROWS, []
    for gauges in range(4, 9):
        count = sum(in_processes(partial(false_alarms, gauges, ALARM_ROWS), range(calibrations), jobs))
        good = count <= ALLOWED_ALARMS_PER_100000 * 1e-5 * samples
        rows.append([str(gauges), f"{samples}", str(count), "good" if good else "out"])
    return rows


def drifts(calibrations: int, jobs: int) -> list[list[str]]:
    """A row for each of five gauges that drifts by 50 microstrain/s."""
    rows = []
    for gauge in range(5):
        samples, wrong, known = zip(*in_processes(partial(drifting, gauge), range(calibrations), jobs), strict=True)
        share = sum(wrong) / sum(samples)
        good = "good" if share <= ALLOWED_WRONG_PER_10000 * 1e-4 else "out"
        rows.append([GAUGES[gauge], str(sum(samples)), f"{1e4 * share:.2f}", f"{100 * np.nanmean(known):.0f}", good])
    return rows


def main() -> int:
    parser = arguments(__doc__)
    parser.add_argument("--calibrations", type=int, default=FULL, metavar="N")
    parser.add_argument("--part", choices=PARTS, help="one table only")
    args = parser.parse_args()
    out, jobs = 0, os.cpu_count() or 1
    every = [(n, Rig(), AFTER + IN_CALIBRATION) for n in range(3, 9)]
    rigs = [(n, Rig(*loads, GROOVE_ERROR_RAD), ("clean",)) for n in (3, 5) for loads in GRID]
    for part in (args.part,) if args.part else PARTS:
        calibrations = max(1, args.calibrations // 10) if part == "drift" else args.calibrations
        if part in ("faults", "grid"):
            cases = every if part == "faults" else rigs
            cells_of_part = [
                cell for gauges, rig, faults in cases for cell in cells(gauges, rig, faults, calibrations, jobs)
            ]
            rows = [row_of(cell) for cell in cells_of_part]
            for reason in sorted({reason for cell in cells_of_part for reason in cell.refused}):
                print(f"refused: {reason}...")
        else:
            rows = (alarms if part == "alarms" else drifts)(calibrations, jobs)
        bad = sum(row[-1].startswith("out") for row in rows)
        print(table(HEADERS[part], rows))
        print(f"\n{calibrations} calibrations, seeds 0 to {calibrations - 1}: {bad} of {len(rows)} out of bounds\n")
        out += bad
    return 1 if out else 0


if __name__ == "__main__":
    raise SystemExit(main())
