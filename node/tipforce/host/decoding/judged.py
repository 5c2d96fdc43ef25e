"""Recorded strains judged as the node judges its samples (fingertip.judgement): faults of 2124h, gauges left out. Numpy
does, operation by operation, what the node does: one array for each gauge, force and element of a covariance."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray
from tipforce.dictionary import table
from tipforce.fingertip.calibration import Active
from tipforce.fingertip.judgement import RELEASE, difference
from tipforce.fingertip.node import FROZEN_READINGS
from tipforce.host.configuration.calibration import Calibration
from tipforce.samples import reasons
from tipforce.samples.reasons import BEYOND_CALIBRATED, CONTRADICTION, OVERLOAD, TEMPERATURE
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.scalar_condition import dot
from tipforce.sensor.contact.scalar_redundancy import LEAST_SHARE, NO_FAULT, explained
from tipforce.sensor.contact.validity import held

GAUGES = (1 << table.FAULT_NO_DATA) - 1
LARGEST_STRAIN = 0.03
"""Of a gauge where 2112h:2 is not known: foil gauges break at 0.03 to 0.05. A larger strain is an overload."""
_END_MICROSTRAIN = 3276.65  # a gauge at the end of its converter reads 32767 x 0.1 microstrain
_SOME = FROZEN_READINGS // 2
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
Column = Any  # a number, or an array (m,) of samples
Rows = Any  # indices (k,) of samples, or a slice


class Readings(NamedTuple):
    """m readings of n gauges in time order, and what else is known of each; None: nothing."""

    strain: FloatArray
    """(m, n); NaN makes a sample unknown."""
    temperature_degC: FloatArray | None = None
    """(m,), NaN where it is unknown."""
    lost: IntArray | None = None
    """(m,), bits of gauges that have failed."""
    frozen: IntArray | None = None
    """(m,), bits of those that stand still."""
    unloaded: BoolArray | None = None
    """(m,): a tare, of which no contact is estimated."""
    offset_strain: FloatArray | None = None
    """(m, n), in place of the calibration's."""
    variance_factor: FloatArray | None = None
    """(m,), by how much readings vary more than one reading's noise (averaged rows, tares)."""
    age_s: FloatArray | None = None
    """(m,), of the tare."""
    pull: BoolArray | None = None
    """(m,) load sense, in place of the calibration's."""

    def part(self, rows: Rows) -> Readings:
        """Some rows."""
        columns: list[Any] = [None if column is None else column[rows] for column in self]
        return Readings(*columns)


class Judged(NamedTuple):
    """m samples judged, and what their judgement takes."""

    F_newtons: list[FloatArray]
    """Three columns; NaN where the gauges left have no rank 3, or contradict each other."""
    covariance: list[Column]
    """Elements 11, 12, 13, 22, 23, 33, N^2, each (m,) or one number: gauge noise, model, temperature, what a fault
    below the limit can do, the calibration's own and the age of the tare."""
    faults: IntArray
    """(m,): as 2124h: the gauges left out, and bits 12 to 15."""
    V: FloatArray
    """(n, m), offsets and temperature taken off."""
    kelvin: Column
    """That are compensated."""
    unknown_kelvin: Column
    noise: Column
    """Of a reading, in variance, over that of one reading."""
    drifted: FloatArray | None
    """(m,), strain^2 of each gauge since the tare."""
    left: IntArray
    """(m,), bits of the gauges left out."""


class Judge:
    """Judges samples by one calibration; what it worked out for gauges left out it keeps."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.active = Active(b"", calibration.numbers(), calibration.gauges)
        self._parameters: dict[int, list[list[float]]] = {}

    def compensated(self, strain: FloatArray, temperature_degC: FloatArray | None) -> FloatArray:
        """Strain (m, n) without what temperature (m,) adds to the offsets where it is known (2114h)."""
        kelvin = np.atleast_1d(self._differences(temperature_degC)[0])
        added: FloatArray = kelvin[:, np.newaxis] * self.calibration.offset_temperature_strain_per_K
        return strain - added

    def judge(self, reading: Readings, was_overloaded: bool) -> Judged:
        """Judge samples without the gauges ``lost`` and ``frozen``; ``was_overloaded``: the one before."""
        active, (m, n) = self.active, reading.strain.shape
        kelvin, unknown_kelvin, outside = self._differences(reading.temperature_degC)
        V = reading.strain.T.copy()
        V -= self.calibration.offset_strain[:, np.newaxis] if reading.offset_strain is None else reading.offset_strain.T
        if active.per_kelvin is not None:
            V -= kelvin * self.calibration.offset_temperature_strain_per_K[:, np.newaxis]
        lost = np.zeros(m, dtype=np.int64)
        for bits in (reading.lost, reading.frozen):
            if bits is not None:
                lost |= bits
        drift, age_s = self.calibration.tare_drift_strain_per_s, reading.age_s
        work = Judged(
            [np.full(m, np.nan) for _ in range(3)], [np.full(m, np.nan) for _ in range(6)],
            np.broadcast_to(np.where(outside, TEMPERATURE, 0), m).copy(), V, kelvin, unknown_kelvin,
            1.0 if reading.variance_factor is None else reading.variance_factor,
            np.square(drift * age_s) if age_s is not None and drift > 0.0 else None, lost.copy(),
        )  # fmt: skip
        if lost.any():
            for mask in np.unique(lost).tolist():
                self._judge_gauges(mask, np.flatnonzero(lost == mask), work)
        else:
            self._judge_gauges(0, slice(None), work)
        faults = work.faults
        faults |= np.where(is_finite(work.F_newtons), work.left, 0)
        if active.forces[1] > 0.0:
            P = magnitude(work.F_newtons)
            overloaded = held(active.forces[1] < P, ~(RELEASE * active.forces[1] < P), was_overloaded)
            faults |= np.where(overloaded, OVERLOAD, 0)
        elif V.size and not np.abs(V).max() <= LARGEST_STRAIN:
            kept = (work.left >> np.arange(n)[:, np.newaxis] & 1) == 0
            faults |= np.where((kept & (np.abs(V) > LARGEST_STRAIN)).any(axis=0), OVERLOAD, 0)
        return work

    def _judge_gauges(self, mask: int, rows: Rows, work: Judged, alone: bool = False) -> None:
        """Bit 12, force and covariance of rows with the same gauges; ``alone``: one is left out for it already."""
        active = self.active
        solver, check = active.without(mask)
        if solver is None or (alone and check is None):
            return
        V, noise = work.V[:, rows], _part(work.noise, rows)
        if mask:  # a gauge left out may read anything
            V = np.where((mask >> np.arange(len(V)) & 1)[:, np.newaxis] == 0, V, 0.0)
        faults: list[tuple[Column, Column]] = []
        if check is not None:
            W, shown, alarm, exclusion = check
            plain = active.model == 0.0 and np.ndim(noise) == 0
            with np.errstate(invalid="ignore", over="ignore"):
                extra = None if plain else list(np.square(active.model * V))
                # The limit has the calibration's own doubt in it, which a mean of readings does not reduce.
                chi_square, faults = explained(W, shown, list(V), extra, np.maximum(noise, 1.0), np.sqrt)
                agree = chi_square <= alarm
                explains = [
                    c is not None and chi_square - f[0] <= exclusion for c, f in zip(shown, faults, strict=True)
                ]
            if not agree.all():
                rows = np.arange(work.V.shape[1])[rows]
                if not alone:
                    work.faults[rows[~agree]] |= CONTRADICTION
                    if len(W) > 1:  # of four gauges the three that would be left cannot be checked
                        self._leave_out(mask, explains, rows, ~agree & np.isfinite(chi_square), work)
                rows, V, noise = rows[agree], V[:, agree], _part(noise, agree)
                faults = [(_part(by_fault, agree), _part(visible, agree)) for by_fault, visible in faults]
        work.left[rows] = mask
        gain = 1.0 + active.gain_per_kelvin * _part(work.kelvin, rows)
        F = [dot(row, list(V)) / gain for row in solver[0]]
        if active.forces[0] > 0.0:
            work.faults[rows] |= np.where(active.forces[0] < magnitude(F), BEYOND_CALIBRATED, 0)
        K = self._covariance(mask, F, V, noise, faults, rows, work)
        if isinstance(rows, slice):  # all of them
            work.F_newtons[:], work.covariance[:] = F, K
            return
        for column, element in zip(work.F_newtons + work.covariance, F + K, strict=True):
            column[rows] = element

    def _leave_out(
        self, mask: int, explains: list[BoolArray | bool], rows: Rows, contradict: BoolArray, work: Judged
    ) -> None:
        """Judge those rows again that one gauge alone explains, without it."""
        alone = contradict & (sum(np.asarray(of_fault, dtype=np.int64) for of_fault in explains) == 1)
        for gauge, of_fault in enumerate(explains):
            if len(of_gauge := rows[alone & of_fault]):
                self._judge_gauges(mask | 1 << gauge, of_gauge, work, alone=True)

    def _covariance(
        self, mask: int, F: list[FloatArray], V: FloatArray, noise: Column, faults: list[tuple[Column, Column]],
        rows: Rows, work: Judged,
    ) -> list[Column]:  # fmt: skip
        active, solver = self.active, self.active.without(mask)[0]
        assert solver is not None
        matrix = solver[0]
        K: list[Column] = [element * noise for element in solver[1]]
        if active.model > 0.0:
            model: Column = active.model
            beyond = (work.faults[rows] & BEYOND_CALIBRATED) != 0
            if beyond.any():  # what is not linear grows with the force, relative to it
                model = np.where(beyond, model * (magnitude(F) / active.forces[0]), model)
            for k, strain in enumerate(V):
                size = model * strain
                K = _with(K, [size * row[k] for row in matrix])
        if np.any(work.unknown_kelvin):
            kelvin = _part(work.unknown_kelvin, rows)
            moved: list[Column] = [active.gain_per_kelvin * f for f in F]
            if active.per_kelvin is not None:
                moved = [m + dot(row, active.per_kelvin) for m, row in zip(moved, matrix, strict=True)]
            K = _with(K, [kelvin * m for m in moved])
        if faults:
            K = [k + d for k, d in zip(K, self._doubt(matrix, faults, np.maximum(noise, 1.0)), strict=True)]
        if self.calibration.parameter_covariance is not None:
            K = [k + p for k, p in zip(K, self.of_parameters(mask, *F), strict=True)]
        if work.drifted is not None:
            drifted = work.drifted[rows]
            K = [k + drifted * dot(matrix[i], matrix[j]) for k, (i, j) in zip(K, _PAIRS, strict=True)]
        return K

    def _doubt(self, matrix: list[list[float]], faults: list[tuple[Column, Column]], noise: Column) -> list[Column]:
        """scalar_redundancy.doubt() of samples: six columns, N^2."""
        variances = np.diagonal(self.calibration.covariance_strain2).tolist()
        shown = [visible * var * noise >= LEAST_SHARE for (_, visible), var in zip(faults, variances, strict=True)]
        sizes = [np.where(seen, by_fault, -np.inf) for seen, (by_fault, _) in zip(shown, faults, strict=True)]
        most: Column = 0.0
        for size in sizes:
            most = np.maximum(most, size)
        likelihoods = [np.exp(0.5 * (size - most)) for size in sizes]
        total = NO_FAULT * np.exp(-0.5 * most) + sum(likelihoods)
        added: list[Column] = [0.0] * 6
        for k, (seen, (by_fault, visible)) in enumerate(zip(shown, faults, strict=True)):
            if np.any(seen):
                squared = np.where(seen, likelihoods[k] / total * by_fault / visible, 0.0)
                added = [a + squared * matrix[i][k] * matrix[j][k] for a, (i, j) in zip(added, _PAIRS, strict=True)]
        return added

    def of_parameters(self, mask: int, F1: Column, F2: Column, F3: Column) -> list[Column]:
        """The calibration's own part of the covariance of F, six elements, N^2: covariance_of_estimate()."""
        if mask not in self._parameters:  # what each product of two of (F1, F2, F3, 1) adds to the six elements
            solver, blocks = self.active.without(mask)[0], self.calibration.parameter_covariance
            assert solver is not None
            assert blocks is not None
            kernel = np.einsum("ak,kilj,bl->abij", solver[0], blocks, solver[0])
            kernel = kernel + np.swapaxes(kernel, 2, 3)
            kernel = 0.5 * (kernel + np.swapaxes(kernel, 0, 1))
            kernel[:, :, range(4), range(4)] *= 0.5
            order = (*_PAIRS, (0, 3), (1, 3), (2, 3), (3, 3))
            self._parameters[mask] = [[float(kernel[a, b, i, j]) for i, j in order] for a, b in _PAIRS]
        products = (F1 * F1, F1 * F2, F1 * F3, F2 * F2, F2 * F3, F3 * F3, F1, F2, F3, 1.0)
        return [dot(row, products) for row in self._parameters[mask]]

    def _differences(self, temperature_degC: FloatArray | None) -> tuple[Column, Column, Column]:
        """judgement.difference() of each sample."""
        active = self.active
        unknown = difference(active, float("nan"))
        if temperature_degC is None:
            return unknown
        low, high = active.range_degC
        kelvin = temperature_degC - active.reference_degC
        known = np.isfinite(kelvin) & (1.0 + active.gain_per_kelvin * np.nan_to_num(kelvin) > 0.0)
        beyond = np.zeros(len(kelvin))
        if low != 0.0 or high != 0.0:
            beyond = np.maximum(np.maximum(low - temperature_degC, temperature_degC - high), 0.0)
        of_known = kelvin if active.compensated else 0.0, beyond, beyond > 0.0
        compensated, doubted, outside = (np.where(known, *pair) for pair in zip(of_known, unknown, strict=True))
        return compensated, doubted, outside


def at_end(microstrain: FloatArray) -> IntArray:
    """Bits of the gauges that read an end of their converter: microstrain (k, n) as decoded."""
    with np.errstate(invalid="ignore"):
        return (np.abs(microstrain) >= _END_MICROSTRAIN) @ (1 << np.arange(microstrain.shape[1]))


def frozen_gauges(calibration: Calibration, strain: FloatArray, weight: FloatArray | None = None) -> IntArray | None:
    """Bits of gauges that repeat a reading more often than their noise allows, (m,), or None. strain: (m, n) in time
    order; weight: (m,), readings per row. The smallest step is the resolution; all rows of a run are marked."""
    if len(strain) <= FROZEN_READINGS:
        return None
    still = strain[1:] == strain[:-1]
    repeating = np.flatnonzero(np.count_nonzero(still, axis=0) >= FROZEN_READINGS)
    if not len(repeating):
        return None
    steps = np.abs(np.diff(strain, axis=0))
    resolution = steps.min(where=steps > 0.0, initial=np.inf)
    noise = np.sqrt(np.diagonal(calibration.covariance_strain2) / (1.0 if weight is None else weight.max()))
    bits = np.zeros(len(strain), dtype=np.int64)
    for gauge in repeating[noise[repeating] >= resolution * (1.0 - 1e-6)].tolist():
        run = np.concatenate(([0], np.cumsum(~still[:, gauge])))
        bits |= np.where(np.bincount(run)[run] > FROZEN_READINGS, 1 << gauge, 0)
    return bits & ~at_end(1e6 * strain) if bits.any() else None


class Still:
    """How often each gauge of a node has repeated its reading, table after table: frozen as a node finds it."""

    def __init__(self, calibration: Calibration) -> None:
        self._noise = np.sqrt(np.diagonal(calibration.covariance_strain2))
        self._last: FloatArray | None = None
        self._repeats = np.full(len(self._noise), -1)
        self._resolution = np.inf  # the smallest step so far

    def frozen(self, strain: FloatArray) -> IntArray | None:
        """Bits of the gauges that stand still, (m,), in the readings (m, n) that follow; None: none does."""
        if not len(strain):
            return None
        k = len(strain) - _SOME
        if k > 0 and self._resolution <= self._noise.min() and self._repeats.max() < _SOME and not _repeats(strain):
            self._last, strain = strain[k - 1 : k], strain[k:]  # no gauge can stand still: the rest does not count
        before = strain[:1] if self._last is None else self._last
        steps = np.abs(np.diff(strain.T, prepend=before.T))  # (n, m)
        moved, place = steps > 0.0, np.arange(len(strain))
        changed = np.maximum.accumulate(np.where(moved, place, -1), axis=1)
        repeats = place - np.where(changed < 0, -1 - self._repeats[:, np.newaxis], changed)
        least = np.where(moved, steps, np.inf).min(axis=0)
        least[0] = min(least[0], self._resolution)
        resolution = np.minimum.accumulate(least)
        self._last, self._repeats, self._resolution = strain[-1:], repeats[:, -1], float(resolution[-1])
        still = repeats >= FROZEN_READINGS
        if not still.any():
            return None
        still &= self._noise[:, np.newaxis] >= resolution * (1.0 - 1e-6)
        bits: IntArray = (1 << np.arange(len(still))) @ still
        return bits & ~at_end(1e6 * strain)


def _repeats(strain: FloatArray) -> bool:
    """Whether a gauge has _SOME equal readings in a row."""
    equal = strain[1:] == strain[:-1]
    for shift in (1, 2, 4, 7):
        equal = equal[:-shift] & equal[shift:]
    return bool(equal.any())


def status_before_contact(verdict: Judged, given: Readings) -> IntArray:
    """The bits that are known before any contact is."""
    faults, known = verdict.faults, is_finite(verdict.F_newtons)
    status = faults & (BEYOND_CALIBRATED | TEMPERATURE | OVERLOAD)
    if not known.all():
        contradict = ~known & ((faults & CONTRADICTION) != 0)
        status |= np.where(contradict, CONTRADICTION, 0)
        lost = ~known & ~contradict
        if given.frozen is not None:
            status |= np.where(lost & (given.frozen != 0), reasons.FROZEN, 0)
        if given.lost is not None:
            of_lost = lost & (given.lost != 0)
            status = np.where(of_lost, status & ~reasons.FROZEN | scalar.SATURATED, status)
    status |= np.where(known & ((faults & GAUGES) != 0), reasons.LEFT_OUT, 0)
    return status if given.unloaded is None else np.where(given.unloaded, reasons.TARE, status)


def last_known(values: FloatArray, before: float = float("nan")) -> FloatArray:
    """Each value, or where it is NaN the last one that was not; ``before`` the first."""
    known = np.isfinite(values)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.where(last >= 0, values[last], before)


def is_finite(F: list[FloatArray]) -> BoolArray:
    """Which forces are, (m,)."""
    return np.isfinite(F[0]) & np.isfinite(F[1]) & np.isfinite(F[2])


def magnitude(F: list[FloatArray]) -> FloatArray:
    """P as contacts() gives it, without the angles: F1, F2, F3."""
    hypotenuse = np.sqrt(F[0] * F[0] + F[2] * F[2])
    return np.maximum(hypotenuse, 0.5 * (hypotenuse + np.abs(F[1])))


def _part(column: Column, rows: npt.NDArray[Any]) -> Column:
    return column[rows] if np.ndim(column) else column


def _with(K: list[Column], f: list[Column]) -> list[Column]:
    """The covariance with f f^T added."""
    return [k + f[i] * f[j] for k, (i, j) in zip(K, _PAIRS, strict=True)]
