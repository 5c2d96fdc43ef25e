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
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.status_words import BEYOND_CALIBRATED, CONTRADICTION, OVERLOAD, TEMPERATURE
from tipforce.sensor.contact import scalar_parity, scalar_redundancy

GAUGES = (1 << table.FAULT_NO_DATA) - 1
RELEASE = 0.95
"""Of the overload force: an overload ends below."""
_END_MICROSTRAIN = 3276.65  # a gauge at the end of its converter reads 32767 x 0.1 microstrain
UNSTATED_KELVIN = 10.0
"""Standard uncertainty of a temperature that nothing tells."""


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


Check = tuple[FloatArray, BoolArray, float, float]
"""Directions, gauges whose fault shows, what chi-square must exceed for an alarm, what excludes a gauge."""


class _Faults(NamedTuple):
    chi_square: FloatArray  # (m,)
    explained: FloatArray  # (m, n): of chi-square, by the best-fitting fault of each gauge
    visible: FloatArray  # (m, n): chi-square per strain^2 of such a fault


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
        left = lost.astype(np.int64).copy()
        doubts = np.zeros((m, 3))
        known = np.zeros(m, dtype=np.bool_)
        for mask in np.unique(lost).tolist():
            rows = np.flatnonzero(lost == mask)
            known[rows] = self._solver(mask) is not None
            self._judge_gauges(mask, rows, V, extra, factor, left, doubts, known, faults)
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
        covariance += self._added(F, V, matrix, kelvin, doubts, faults)
        return Judged(F, matrix, covariance, faults)

    # --- gauges ---------------------------------------------------------------------------------------------

    def _judge_gauges(
        self,
        mask: int,
        rows: npt.NDArray[np.intp],
        V: FloatArray,
        extra: FloatArray,
        factor: FloatArray,
        left: IntArray,
        doubts: FloatArray,
        known: BoolArray,
        faults: IntArray,
    ) -> None:
        """Bit 12, the gauge left out and what it costs, of rows that have the same gauges."""
        check, solver = self._check(mask), self._solver(mask)
        if check is None or solver is None:
            return
        W, shown, alarm, exclusion = check
        V = np.where(np.isfinite(V), V, 0.0) if mask else V
        found = _faults(W, shown, V[rows], extra[rows], factor[rows])
        with np.errstate(invalid="ignore"):
            contradict = ~(found.chi_square <= alarm)
            explains = found.visible > 0.0
            if len(W) > 1:
                explains &= found.chi_square[:, np.newaxis] - found.explained <= exclusion
        agree = rows[~contradict]
        doubts[agree] = _doubt(solver[0], self._variance, found, ~contradict, factor[agree])
        faults[rows[contradict]] |= CONTRADICTION
        known[rows[contradict]] = False
        alone = contradict & (explains.sum(axis=1) == 1) & np.isfinite(found.chi_square)
        for gauge in np.unique(explains[alone].argmax(axis=1)).tolist():
            of_gauge = alone & (explains.argmax(axis=1) == gauge)
            self._leave_out(mask | 1 << gauge, rows[of_gauge], V, extra, factor, left, doubts, known)

    def _leave_out(
        self,
        mask: int,
        rows: npt.NDArray[np.intp],
        V: FloatArray,
        extra: FloatArray,
        factor: FloatArray,
        left: IntArray,
        doubts: FloatArray,
        known: BoolArray,
    ) -> None:
        solver, check = self._solver(mask), self._check(mask)
        if solver is None:
            return
        agree = np.ones(len(rows), dtype=np.bool_)
        if check is not None:
            found = _faults(check[0], check[1], V[rows], extra[rows], factor[rows])
            agree = found.chi_square <= check[2]
            doubts[rows[agree]] = _doubt(solver[0], self._variance, found, agree, factor[rows[agree]])
        left[rows[agree]] = mask
        known[rows[agree]] = True

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
        W = scalar_parity.directions(self._C, self._noise, kept)
        if W is None:
            return None
        shown = np.array([column is not None for column in scalar_parity.columns(W, self._noise)])
        alarm = limit if len(kept) == n else scalar_redundancy.same_rate(limit, n - 3, len(W))
        exclusion = scalar_redundancy.same_rate(limit, n - 3, len(W) - 1)
        return np.array(W), shown, alarm, exclusion

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
        found = doubts[:, :, np.newaxis] * doubts[:, np.newaxis, :]
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
    """scalar_parity.judge() for m samples."""
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
    """scalar_parity.doubt() for m samples: (m, 3), newtons."""
    explained, visible = found.explained[rows], found.visible[rows]
    open_ = (explained > scalar_parity.DOUBT) & (
        visible * variance * factor[:, np.newaxis] >= scalar_parity.LEAST_SHARE
    )
    squared = np.divide(explained, visible, out=np.zeros_like(visible), where=open_)
    moved = squared * np.square(matrix).sum(axis=0)
    worst = (scalar_parity.TIE * moved >= moved.max(axis=1, keepdims=True)).argmax(axis=1)
    size = np.sqrt(np.take_along_axis(squared, worst[:, np.newaxis], axis=1)[:, 0])
    found_newtons: FloatArray = size[:, np.newaxis] * matrix[:, worst].T
    return found_newtons


def _square(upper: tuple[float, float, float, float, float, float]) -> FloatArray:
    k11, k12, k13, k22, k23, k33 = upper
    return np.array([[k11, k12, k13], [k12, k22, k23], [k13, k23, k33]])
