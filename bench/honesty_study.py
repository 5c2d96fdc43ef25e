"""Simulated fingers with one fault each, calibrated as the command does it: how often a row says ok and is wrong."""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import NormalDist

import numpy as np

import tipforce
from tipforce.arrays import BoolArray, FloatArray
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.measurements import Measurements
from tipforce.host.decoding.contacts import Status
from tipforce.sensor.calibration.fit import covariance_of_estimate
from tipforce.sensor.calibration.grooves import paper_grooves
from tipforce.sensor.calibration.simulation import true_matrix
from tipforce.sensor.contact.force import force_vector
from tipforce.sensor.contact.redundancy import parity
from tipforce.sensor.contact.scalar_parity import LEAST_SHARE
from tipforce_tools.calibrate import fit as fit_command

GAUGES = ("K_H", "S_H", "U", "L", "T", "R", "K_V", "S_V")
NOISE, OFFSET = 1e-6, 30e-6
CONVERTER_LIMIT = 2000e-6
ROWS = 200
"""Readings of each finger and fault, 100 a second."""
DRIFT_STRAIN = 0.5e-6
"""Of each reading: 50 microstrain/s."""
CHUNK = 20_000
FACTOR_95 = 1.959964
WEIGHTS_NEWTONS = (4.4, 2.2, 1.1)
WARM_K = 20.0
SI_EVERY = 10
QUADRATIC = 100.0
"""10 % per 1000 microstrain."""
GROOVE_ERROR_RAD = float(np.radians(0.5))

AFTER = ("clean", "drift", "stuck", "open", "rail", "gain", "overload", "warm, calibrated cold")
"""Faults of readings, on a calibration that is good."""
IN_CALIBRATION = ("warm, coefficients known", "nonlinear", "SI units")
OF_ONE_GAUGE = ("drift", "stuck", "gain")
SPEAKS = 3.5
"""Chi-square (1.9 sigma): residuals that a fault explains less of do not speak for it."""
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
    calibrations: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    rows: int = 0
    ok: int = 0
    wrong: int = 0
    """Rows that say ok and whose P is off by more than five of their own standard uncertainties."""
    covered: int = 0
    """Rows that say ok and whose 95 % interval of P holds the truth."""
    alarms: int = 0
    """Rows in which the gauges contradict each other."""
    shares: dict[str, float] = field(default_factory=dict)
    """Of the faulty gauges' own noise, the least that showed in the residuals of a finger."""
    passes_5u: float = 0.0
    """Sum over the rows: the chance that the residuals do not speak for a fault that moves P by five u(P)."""
    passes_2u: float = 0.0
    error2: float = 0.0
    u2: float = 0.0

    def add(self, other: Cell) -> None:
        """Add the counts of another finger."""
        for name in (
            "calibrations",
            "rows",
            "ok",
            "wrong",
            "covered",
            "error2",
            "u2",
            "alarms",
            "passes_5u",
            "passes_2u",
        ):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.refused += other.refused
        for name, share in other.shares.items():
            self.shares[name] = min(share, self.shares.get(name, 1.0))

    @property
    def ok_share(self) -> float:
        """Of all rows."""
        return self.ok / self.rows if self.rows else float("nan")

    @property
    def wrong_per_10000(self) -> float:
        """Of the rows that say ok."""
        return 1e4 * self.wrong / self.ok if self.ok else 0.0

    @property
    def covered_share(self) -> float:
        """Of the rows that say ok."""
        return self.covered / self.ok if self.ok else float("nan")

    @property
    def u_over_error(self) -> float:
        """Root mean square u(P) over root mean square error, of the rows that say ok."""
        return (self.u2 / self.error2) ** 0.5 if self.error2 else float("nan")


def cells(gauges: int, rig: Rig, faults: tuple[str, ...], calibrations: int, jobs: int = 1) -> list[Cell]:
    """The cells of all faults, each over so many fingers; finger k has the seed k."""
    task = partial(_finger, gauges, rig, faults)
    totals = {fault: Cell(gauges, fault, rig) for fault in _split(faults)}
    if jobs > 1:
        with ProcessPoolExecutor(jobs) as pool:
            found = list(pool.map(task, range(calibrations), chunksize=8))
    else:
        found = [task(seed) for seed in range(calibrations)]
    for one in found:
        for cell in one:
            totals[cell.fault].add(cell)
    return [cell for cell in totals.values() if cell.calibrations]


def _split(faults: tuple[str, ...]) -> list[str]:
    return [name for fault in faults for name in (fault, fault + INVISIBLE) if name == fault or fault in OF_ONE_GAUGE]


def _finger(gauges: int, rig: Rig, faults: tuple[str, ...], seed: int) -> list[Cell]:
    """One finger through every fault; those of readings share its good calibration."""
    rng = np.random.default_rng([seed, gauges, rig.grooves, rig.weights, rig.repeats])
    finger = _Sensor.of(gauges, rng)
    found, good = [], None
    for fault in faults:
        if fault == "SI units" and seed % SI_EVERY:
            continue  # refused by its size alone: a tenth of the fits shows it
        cell = Cell(gauges, fault, rig, calibrations=1)
        sensor = replace(finger, quadratic=QUADRATIC) if fault == "nonlinear" else finger
        try:
            if fault in AFTER and good is None:
                good = sensor.calibrated(rig, rng, fault)
            calibration = good if fault in AFTER and good is not None else sensor.calibrated(rig, rng, fault)
        except InputError as error:
            cell.refused[str(error)[:60]] += 1
        else:
            _judge(cell, calibration, sensor, rng)
        found.append(cell)
    return found


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
        fit, _, _ = fit_command.fit_of(_ARGUMENTS, data)
        return fit_command.calibration_of(_ARGUMENTS, data, fit)


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
    calibration, found = sensor.calibrated(Rig(), rng, "clean"), 0
    for _ in range(0, rows, CHUNK):
        V = sensor.read(_touches(rng, CHUNK, max(WEIGHTS_NEWTONS))[1], rng)
        found += int(tipforce.estimate(calibration, V * 1e6, temperature_degC=20.0).has(Status.CONTRADICTION).sum())
    return found


def drifting(gauge: int, seed: int) -> tuple[int, int, float]:
    """(samples, samples that show a P off by more than five u(P), share of those after the find that have a P).

    Five gauges under one steady load at 1 kHz for ten seconds, of which one drifts by 50 microstrain/s.
    """
    rng = np.random.default_rng([seed, gauge])
    sensor = _Sensor.of(5, rng)
    calibration = sensor.calibrated(Rig(), rng, "clean")
    P, F = (np.repeat(one, 10_000, axis=0) for one in _touches(rng, 1, max(WEIGHTS_NEWTONS)))
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
    V = _broken(cell.fault, sensor.read(F, rng, warmer), gauge, rng)
    V = np.clip(V, -CONVERTER_LIMIT, CONVERTER_LIMIT)
    shown = tipforce.estimate(calibration, V * 1e6, temperature_degC=20.0 + warmer)
    ok = says_ok(shown)
    error, u = np.abs(shown.P_newtons - P)[ok], shown.u_P_newtons[ok]
    cell.rows += ROWS
    cell.ok += int(ok.sum())
    cell.wrong += int((error > 5.0 * u).sum())
    cell.covered += int((error <= FACTOR_95 * u).sum())
    cell.error2 += float(np.square(error).sum())
    cell.u2 += float(np.square(u).sum())
    cell.alarms += int(shown.has(Status.CONTRADICTION).sum())
    if cell.fault in OF_ONE_GAUGE:
        _tell(cell, calibration, gauge, F)


def _tell(cell: Cell, calibration: Calibration, gauge: int, F: FloatArray) -> None:
    """What the residuals of good readings under F (m, 3) can tell of a fault of the gauge."""
    Sigma, C, name = calibration.covariance_strain2, calibration.C, GAUGES[gauge]
    visible = parity(C, Sigma).visible[gauge] if len(Sigma) > 3 else 0.0
    cell.shares[name] = float(visible * Sigma[gauge, gauge])
    if cell.shares[name] < LEAST_SHARE:
        cell.fault += INVISIBLE
    assert calibration.parameter_covariance is not None
    covariance = covariance_of_estimate(C, Sigma, calibration.parameter_covariance, F)
    along = F / np.linalg.norm(F, axis=1, keepdims=True)
    u = np.sqrt(np.einsum("mi,mij,mj->m", along, covariance, along))
    # A fault of u(P) shows by so many standard deviations of the residuals.
    shown = np.sqrt(visible) * u / np.abs(along @ C[:, gauge])
    for size, attribute in ((5.0, "passes_5u"), (FACTOR_95, "passes_2u")):
        passes = sum(_NORMAL.cdf(SPEAKS**0.5 - size * one) for one in shown.tolist())
        setattr(cell, attribute, passes)


def says_ok(shown: tipforce.Contacts) -> BoolArray:
    """Rows whose P is known and of which nothing is flagged but the contact itself."""
    flagged = shown.status & ~np.uint16(Status.CONTACT | Status.CALIBRATED)
    ok: BoolArray = np.isfinite(shown.P_newtons) & (flagged == 0) & shown.has(Status.CONTACT)
    return ok


def _broken(fault: str, V: FloatArray, k: int, rng: np.random.Generator) -> FloatArray:
    """The readings with gauge k at fault."""
    found = V.copy()
    if fault == "drift":
        found[:, k] += rng.choice([-1.0, 1.0]) * DRIFT_STRAIN * np.arange(len(V))
    elif fault == "stuck":
        found[:, k] = V[0, k]
    elif fault == "open":
        found[:, k] = CONVERTER_LIMIT
    elif fault == "rail":
        found[:, k] = rng.choice([-1.0, 1.0]) * CONVERTER_LIMIT
    elif fault == "gain":
        found[:, k] = V[:, k] * 1.1
    return found


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    fit_command.add_arguments(parser)
    return parser.parse_args(
        ["simulated.csv", "--saturation", f"{CONVERTER_LIMIT * 1e6:g}", "--sense", "push", "--date", "2025-12-31"]
    )


_ARGUMENTS, _NORMAL = _arguments(), NormalDist()
