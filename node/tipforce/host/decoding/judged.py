"""Recorded strains judged as the node judges its samples (fingertip.judgement): faults of 2124h, gauges left out.

What is worked out once for each set of gauges is the node's own code; what is done for each sample is numpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray
from tipforce.dictionary import table
from tipforce.fingertip.judgement import RELEASE, UNSTATED_KELVIN
from tipforce.host.configuration.calibration import Calibration
from tipforce.samples.reasons import BEYOND_CALIBRATED, CONTRADICTION, OVERLOAD, TEMPERATURE
from tipforce.sensor.contact import scalar_redundancy

GAUGES = (1 << table.FAULT_NO_DATA) - 1
LARGEST_STRAIN = 0.03
"""Largest strain of a gauge where 2112h:2 is not known: foil gauges break at 0.03 to 0.05, and each material of
``tipforce_lab.design.other_bodies`` has yielded before. A larger one is an overload. On the wire 0.0033 is the end."""
_END_MICROSTRAIN = 3276.65  # a gauge at the end of its converter reads 32767 x 0.1 microstrain


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """m samples judged."""

    F_newtons: FloatArray
    """(m, 3); NaN where the gauges left have no rank 3, or contradict each other."""
    matrix: FloatArray
    """(m, 3, n): C without the gauges left out."""
    covariance: FloatArray
    """(m, 3, 3), N^2: gauge noise, model, temperature, and what a fault below the limit can do."""
    faults: IntArray
    """(m,): as 2124h: the gauges left out, and bits 12 to 15."""


class Check(NamedTuple):
    """What the gauges kept are checked by."""

    W: FloatArray
    """(d, n): directions in which no force moves the gauges, of variance 1."""
    shown: BoolArray
    """(n,): gauges whose fault shows."""
    alarm: float
    """Chi-square of a contradiction."""
    exclusion: float
    """Chi-square that a gauge at fault may leave."""


class _Faults(NamedTuple):
    chi_square: FloatArray  # (m,)
    explained: FloatArray  # (m, n): of chi-square, by the best-fitting fault of each gauge
    visible: FloatArray  # (m, n): chi-square per strain^2 of such a fault


class _Work(NamedTuple):
    """m samples while they are judged: what is given, and what is found in place."""

    V: FloatArray  # (m, n)
    extra: FloatArray  # (m, n), strain^2 beside the noise
    factor: FloatArray  # (m,), of the noise's variance
    left: IntArray  # (m,), bits of the gauges left out
    doubts: FloatArray  # (m, 3, 3), N^2
    known: BoolArray  # (m,), the force
    faults: IntArray  # (m,)

    def found(self, check: Check, rows: npt.NDArray[np.intp]) -> _Faults:
        """Chi-square of some rows; what a gauge that is not kept reads has no weight, as long as it is finite."""
        V = np.where(check.W.any(axis=0), self.V[rows], 0.0)
        return _faults(check.W, check.shown, V, self.extra[rows], self.factor[rows])


class Judge:
    """Judges samples by one calibration; what it worked out for gauges left out it keeps."""

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        n = calibration.gauges
        self._C = calibration.C.tolist()
        self._noise = calibration.covariance_strain2[np.triu_indices(n)].tolist()
        self._variance = np.diagonal(calibration.covariance_strain2)
        self._solvers: dict[int, tuple[FloatArray, FloatArray] | None] = {0: (calibration.C, calibration.covariance_F)}
        self._checks: dict[int, Check | None] = {}

    def compensated(self, strain: FloatArray, temperature_degC: FloatArray | None) -> FloatArray:
        """Strain (m, n) without what temperature (m,) adds to the offsets where it is known (2114h)."""
        kelvin, _, _ = self._difference(temperature_degC, len(strain))
        found: FloatArray = strain - kelvin[:, np.newaxis] * self._calibration.offset_temperature_strain_per_K
        return found

    def judge(
        self,
        V: FloatArray,
        temperature_degC: FloatArray | None,
        lost: IntArray,
        was_overloaded: bool,
        variance_factor: FloatArray | float = 1.0,
    ) -> Judged:
        """Judge strain without offsets and ``compensated``, (m, n), in time order.

        lost: (m,), bits of the gauges that are left out already; variance_factor: (m,), by how much readings vary
        more than one reading's noise (averaged rows, tares). NaN in a gauge makes its sample unknown.
        """
        m, n = V.shape
        _, kelvin, outside = self._difference(temperature_degC, m)
        factor = np.broadcast_to(np.asarray(variance_factor, dtype=np.float64), (m,))
        faults = np.where(outside, TEMPERATURE, 0).astype(np.int64)
        extra = np.square(self._calibration.model_uncertainty * V)
        known = np.zeros(m, dtype=np.bool_)
        work = _Work(V, extra, factor, lost.astype(np.int64), np.zeros((m, 3, 3)), known, faults)
        for mask in np.unique(lost).tolist():
            rows = np.flatnonzero(lost == mask)
            known[rows] = self._solver(mask) is not None
            self._judge_gauges(mask, rows, work)
        left = work.left
        matrix, covariance = np.full((m, 3, n), np.nan), np.full((m, 3, 3), np.nan)
        for mask in np.unique(left[known]).tolist():
            rows = np.flatnonzero(known & (left == mask))
            solver = self._solver(mask)
            assert solver is not None
            matrix[rows], covariance[rows] = solver[0], solver[1] * factor[rows, np.newaxis, np.newaxis]
        gain = 1.0 + self._calibration.gain_temperature_per_K * self._difference(temperature_degC, m)[0]
        with np.errstate(invalid="ignore"):
            used = np.where(matrix == 0.0, 0.0, matrix * V[:, np.newaxis, :])  # a gauge left out may read anything
        F = used.sum(axis=2) / gain[:, np.newaxis]
        faults |= np.where(known, left, 0)
        faults |= self._forces(F, was_overloaded)
        if not self._calibration.overload_force_newtons > 0.0:
            kept = (left[:, np.newaxis] >> np.arange(n) & 1) == 0
            faults |= np.where((kept & (np.abs(V) > LARGEST_STRAIN)).any(axis=1), OVERLOAD, 0)
        covariance += self._added(F, V, matrix, kelvin, work.doubts, faults)
        return Judged(F, matrix, covariance, faults)

    # --- gauges ---------------------------------------------------------------------------------------------

    def _judge_gauges(self, mask: int, rows: npt.NDArray[np.intp], work: _Work) -> None:
        """Bit 12, the gauge left out and what it costs, of rows that have the same gauges."""
        check, solver = self._check(mask), self._solver(mask)
        if check is None or solver is None:
            return
        found = work.found(check, rows)
        with np.errstate(invalid="ignore"):
            contradict = ~(found.chi_square <= check.alarm)
            explains = found.visible > 0.0
            explains &= found.chi_square[:, np.newaxis] - found.explained <= check.exclusion
        self._doubt(solver[0], work, found, rows, ~contradict)
        work.faults[rows[contradict]] |= CONTRADICTION
        work.known[rows[contradict]] = False
        if len(check.W) == 1:
            return  # of four gauges the three that would be left cannot be checked
        alone = contradict & (explains.sum(axis=1) == 1) & np.isfinite(found.chi_square)
        for gauge in np.unique(explains[alone].argmax(axis=1)).tolist():
            self._leave_out(mask | 1 << gauge, rows[alone & (explains.argmax(axis=1) == gauge)], work)

    def _leave_out(self, mask: int, rows: npt.NDArray[np.intp], work: _Work) -> None:
        solver, check = self._solver(mask), self._check(mask)
        if solver is None or check is None:
            return
        found = work.found(check, rows)
        agree = found.chi_square <= check.alarm
        self._doubt(solver[0], work, found, rows, agree)
        work.left[rows[agree]] = mask
        work.known[rows[agree]] = True

    def _doubt(
        self, matrix: FloatArray, work: _Work, found: _Faults, rows: npt.NDArray[np.intp], agree: BoolArray
    ) -> None:
        """What a fault below the limit can do to the force of the rows that agree."""
        work.doubts[rows[agree]] = _doubt(matrix, self._variance, found, agree, work.factor[rows[agree]])

    def _solver(self, mask: int) -> tuple[FloatArray, FloatArray] | None:
        if mask not in self._solvers:
            gauges = [k for k in range(self._calibration.gauges) if mask >> k & 1]
            found = None
            if self._calibration.gauges > 3:
                found = scalar_redundancy.leave_out(self._C, self._noise, gauges)
            self._solvers[mask] = None if found is None else (np.array(found[0]), _square(found[1]))
        return self._solvers[mask]

    def _check(self, mask: int) -> Check | None:
        if mask not in self._checks:
            self._checks[mask] = self._find_check(mask)
        return self._checks[mask]

    def _find_check(self, mask: int) -> Check | None:
        limit, n = self._calibration.redundancy_limit, self._calibration.gauges
        kept = [k for k in range(n) if not mask >> k & 1]
        if not limit > 0.0 or len(kept) < 4:
            return None
        W = scalar_redundancy.directions(self._C, self._noise, kept)
        if W is None:
            return None
        shown = np.array([column is not None for column in scalar_redundancy.columns(W, self._noise)])
        alarm = limit if len(kept) == n else scalar_redundancy.same_rate(limit, n - 3, len(W))
        exclusion = scalar_redundancy.same_rate(limit, n - 3, len(W) - 1)
        return Check(np.array(W), shown, alarm, exclusion)

    # --- force and temperature ------------------------------------------------------------------------------

    def _forces(self, F: FloatArray, was_overloaded: bool) -> IntArray:
        """Bits 13 and 15; an overload ends below RELEASE of the overload force."""
        P = magnitude(F)
        calibrated, overload = self._calibration.calibrated_force_newtons, self._calibration.overload_force_newtons
        bits = np.zeros(len(F), dtype=np.int64)
        with np.errstate(invalid="ignore"):
            if calibrated > 0.0:
                bits |= np.where(calibrated < P, BEYOND_CALIBRATED, 0)
            if overload > 0.0:
                on, off = overload < P, ~(RELEASE * overload < P)
                last = np.maximum.accumulate(np.where(on | off, np.arange(len(P)), -1))
                bits |= np.where(np.where(last >= 0, on[last], was_overloaded), OVERLOAD, 0)
        return bits

    def _difference(self, temperature_degC: FloatArray | None, m: int) -> tuple[FloatArray, FloatArray, BoolArray]:
        """(kelvin compensated, kelvin of uncertainty left, bit 14) of each sample, as judgement.difference()."""
        one = self._calibration
        needed = bool(one.offset_temperature_strain_per_K.any()) or one.gain_temperature_per_K != 0.0
        low, high = one.temperature_min_degC, one.temperature_max_degC
        ranged, T = low != 0.0 or high != 0.0, np.full(m, np.nan)
        if temperature_degC is not None:
            T = temperature_degC
        kelvin = T - one.reference_temperature_degC
        told = np.isfinite(T) & (1.0 + one.gain_temperature_per_K * np.where(np.isfinite(T), kelvin, 0.0) > 0.0)
        beyond = np.where(told, np.maximum(np.maximum(low - T, T - high), 0.0), 0.0) if ranged else np.zeros(m)
        a, b = low - one.reference_temperature_degC, high - one.reference_temperature_degC
        rms = float(np.sqrt((a * a + a * b + b * b) / 3.0)) if ranged else UNSTATED_KELVIN
        left = np.where(told, beyond, rms if needed else 0.0)
        return np.where(told & needed, kelvin, 0.0), left, np.where(told, beyond > 0.0, needed)

    def _added(
        self,
        F: FloatArray,
        V: FloatArray,
        matrix: FloatArray,
        kelvin: FloatArray,
        doubts: FloatArray,
        faults: IntArray,
    ) -> FloatArray:
        """What model, temperature and a possible fault add to the covariance of F, (m, 3, 3)."""
        one = self._calibration
        found = doubts
        if one.model_uncertainty > 0.0:
            model = np.full(len(F), one.model_uncertainty)
            beyond = (faults & BEYOND_CALIBRATED) != 0
            model[beyond] *= magnitude(F[beyond]) / (one.calibrated_force_newtons or 1.0)
            moved = matrix * np.where(np.isfinite(V), V, 0.0)[:, np.newaxis, :] * model[:, np.newaxis, np.newaxis]
            found = found + moved @ moved.transpose(0, 2, 1)
        if kelvin.any():
            per_kelvin = one.gain_temperature_per_K * F + matrix @ one.offset_temperature_strain_per_K
            warm = kelvin[:, np.newaxis] * per_kelvin
            found = found + warm[:, :, np.newaxis] * warm[:, np.newaxis, :]
        return found


def at_end(microstrain: FloatArray) -> IntArray:
    """Bits of the gauges that read an end of their converter: microstrain (k, n) as decoded."""
    with np.errstate(invalid="ignore"):
        bits: IntArray = (np.abs(microstrain) >= _END_MICROSTRAIN) @ (1 << np.arange(microstrain.shape[1]))
    return bits


def last_known(values: FloatArray, before: float = float("nan")) -> FloatArray:
    """Each value, or where it is NaN the last one that was not; ``before`` the first."""
    known = np.isfinite(values)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    found: FloatArray = np.where(last >= 0, values[last], before)
    return found


def magnitude(F: FloatArray) -> FloatArray:
    """P as contacts() gives it, without the angles: F (..., 3)."""
    hypotenuse = np.sqrt(F[..., 0] * F[..., 0] + F[..., 2] * F[..., 2])
    larger: FloatArray = np.maximum(hypotenuse, 0.5 * (hypotenuse + np.abs(F[..., 1])))
    return larger


def _faults(W: FloatArray, shown: BoolArray, V: FloatArray, extra: FloatArray, factor: FloatArray) -> _Faults:
    """scalar_redundancy.judge() for m samples."""
    p = V @ W.T
    m, n = V.shape
    columns = np.broadcast_to(W, (m, *W.shape))
    M = factor[:, np.newaxis, np.newaxis] * np.eye(len(W))
    if extra.any():
        M = M + np.einsum("ak,mk,bk->mab", W, np.where(np.isfinite(extra), extra, 0.0), W)
    root = np.linalg.cholesky(M)
    q = np.linalg.solve(root, p[:, :, np.newaxis])[:, :, 0]
    s = np.linalg.solve(root, columns)
    chi_square = np.square(q).sum(axis=1)
    visible = np.where(shown, np.square(s).sum(axis=1), 0.0)
    along = np.einsum("mak,ma->mk", s, q)
    explained = np.divide(along * along, visible, out=np.zeros((m, n)), where=visible > 0.0)
    return _Faults(chi_square, explained, visible)


def _doubt(matrix: FloatArray, variance: FloatArray, found: _Faults, rows: BoolArray, factor: FloatArray) -> FloatArray:
    """scalar_redundancy.doubt() for m samples: (m, 3, 3), N^2."""
    explained, visible = found.explained[rows], found.visible[rows]
    shown = visible * variance * factor[:, np.newaxis] >= scalar_redundancy.LEAST_SHARE
    most = np.where(shown, explained, 0.0).max(axis=1, keepdims=True)
    likelihood = np.exp(0.5 * np.where(shown, explained - most, -np.inf))
    total = scalar_redundancy.NO_FAULT * np.exp(-0.5 * most) + likelihood.sum(axis=1, keepdims=True)
    squared = np.divide(likelihood / total * explained, visible, out=np.zeros_like(visible), where=shown)
    added: FloatArray = (matrix * squared[:, np.newaxis, :]) @ matrix.T
    return added


def _square(upper: tuple[float, float, float, float, float, float]) -> FloatArray:
    k11, k12, k13, k22, k23, k33 = upper
    return np.array([[k11, k12, k13], [k12, k22, k23], [k13, k23, k33]])
