"""Fault detection with more than three gauges: gauges that contradict the others, and the force from the rest.

V = A F + e with the covariance Sigma of e; C = (A^T Q A)^-1 A^T Q, Q = Sigma^-1, is the weighted inverse. n - 3
combinations of the gauges do not depend on the force (parity directions); their chi-square is r Q r with the residual
r = V - A C V. A fault f in gauge k adds f P e_k to r, P = I - A C, so its effect is confined to one direction
of parity space. Two gauges with parallel directions cannot be distinguished; that is so exactly if the other
n - 2 gauges have no rank 3, whatever their noise. With four gauges there is one direction and no fault
can be isolated, unless only one gauge is visible: it then responds to no force at all. A gauge is invisible if the
others have no rank 3: its fault looks like a force.

scalar_redundancy.py has the same formulas for one sample on a microcontroller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray, floats
from tipforce.errors import InputError
from tipforce.sensor.contact import scalar_redundancy
from tipforce.sensor.contact.scalar_redundancy import CONDITION_LIMIT, EXCLUSION_RATE, FALSE_ALARM_RATE

NONE, UNCLEAR = -1, -2
"""Values of Faults.isolated: no fault; a fault that no single gauge, or more than one, explains."""


@dataclass(frozen=True, slots=True, eq=False)
class Subset:
    """Force from some of the gauges."""

    C: FloatArray
    """(3, n), newtons per unit strain; zero columns for the gauges left out."""
    covariance_F: FloatArray
    """(3, 3), N^2, from the noise of the gauges used."""


@dataclass(frozen=True, slots=True, eq=False)
class Parity:
    """Information in the residuals of n > 3 gauges."""

    A: FloatArray
    """(n, 3), strain per newton."""
    C: FloatArray
    """(3, n), newtons per unit strain."""
    Q: FloatArray
    """(n, n), inverse of the gauges' covariance."""
    P: FloatArray
    """(n, n), I - A C: column k is the residual of a unit fault of gauge k."""
    visible: FloatArray
    """(n,), chi-square per squared unit fault of each gauge; zero: its fault is invisible."""

    @property
    def degrees(self) -> int:
        """Parity directions, n - 3."""
        return int(self.A.shape[0]) - 3


@dataclass(frozen=True, slots=True, eq=False)
class Faults:
    """Fault decisions for readings of shape (..., n)."""

    chi_square: FloatArray
    """(...), chi-square of n - 3 degrees of freedom without a fault; NaN for strains that are not finite."""
    fault: BoolArray
    """(...), a fault is present (or a strain is not finite)."""
    candidates: BoolArray
    """(..., n), where fault: the gauges each of which alone explains the residuals."""
    isolated: IntArray
    """(...), the gauge at fault, from 0; NONE; or UNCLEAR."""


def weighted_inverse(A: npt.ArrayLike, covariance_strain2: npt.ArrayLike) -> FloatArray:
    """Return C = (A^T Q A)^-1 A^T Q, (3, n), for A (n, 3), strain per newton, and the gauges' covariance (n, n).

    Of all C with C A = I it has the smallest noise. Raises InputError where the shapes do not fit, A has no rank
    3, or the covariance is not positive definite.
    """
    matrix = np.asarray(A, dtype=np.float64)
    if matrix.ndim != 2 or matrix.shape[1] != 3 or matrix.shape[0] < 3:
        raise InputError(f"A has the shape {matrix.shape}: allowed is (n, 3) with n gauges, at least 3")
    root = _root(covariance_strain2, matrix.shape[0])
    whitened = np.linalg.solve(root, matrix)
    if np.linalg.matrix_rank(whitened) < 3:
        raise InputError("the gauges cannot separate the three forces: allowed is A of rank 3")
    return np.asarray(np.linalg.solve(root.T, np.linalg.pinv(whitened).T).T, dtype=np.float64)


def structure_matrix(C: npt.ArrayLike, covariance_strain2: npt.ArrayLike) -> FloatArray:
    """Return A = Sigma C^T (C Sigma C^T)^-1, (n, 3), strain per newton: the structure as a calibration describes it.

    It inverts weighted_inverse() exactly; for a C that was not weighted by this covariance, as a plain
    pseudo-inverse with unequal gauges, it gives some A with C A = I but not the true one. C: (3, n). Raises
    InputError where the shapes do not fit, C has no rank 3, or the covariance is not positive definite.
    """
    matrix, covariance = _matrix(C), floats("covariance_strain2", covariance_strain2)
    _root(covariance, matrix.shape[1])
    if np.linalg.matrix_rank(matrix) < 3:
        raise InputError("the calibration cannot separate the three forces: allowed is C of rank 3")
    A = np.linalg.solve(matrix @ covariance @ matrix.T, matrix @ covariance).T
    return np.asarray(A, dtype=np.float64)


def without(
    C: npt.ArrayLike,
    covariance_strain2: npt.ArrayLike,
    left_out: Sequence[int],
    condition_limit: float = CONDITION_LIMIT,
) -> Subset | None:
    """Return the force from all but some gauges (from 0), or None if the rest has no rank 3.

    C: (3, n), weighted by covariance_strain2 (n, n). No rank 3: fewer than three gauges left, or the condition
    number (2-norm) of their matrix over the limit. Raises InputError as structure_matrix() does, and for gauges
    that do not exist.
    """
    A, covariance = structure_matrix(C, covariance_strain2), floats("covariance_strain2", covariance_strain2)
    n = len(A)
    if any(not 0 <= gauge < n for gauge in left_out):
        raise InputError(f"left_out = {list(left_out)}: allowed are gauges 0 to {n - 1}")
    kept = [k for k in range(n) if k not in left_out]
    rows, part = A[kept], covariance[np.ix_(kept, kept)]
    if len(kept) < 3 or np.linalg.matrix_rank(rows / np.linalg.norm(rows)) < 3:
        return None
    inverse = weighted_inverse(rows, part)
    if not np.linalg.cond(inverse) <= condition_limit:
        return None
    full = np.zeros((3, n))
    full[:, kept] = inverse
    return Subset(full, inverse @ part @ inverse.T)


def parity(C: npt.ArrayLike, covariance_strain2: npt.ArrayLike) -> Parity:
    """Return the information in the residuals of n > 3 gauges. C: (3, n), weighted by covariance_strain2 (n, n).

    Raises InputError as structure_matrix() does, and for n = 3, where every reading fits some force.
    """
    matrix, covariance = _matrix(C), floats("covariance_strain2", covariance_strain2)
    n = matrix.shape[1]
    if n < 4:
        raise InputError("three gauges have no parity direction: fault detection needs at least four")
    A = structure_matrix(matrix, covariance)
    Q, P = np.linalg.inv(covariance), np.eye(n) - A @ matrix
    visible = np.einsum("ki,ik->k", Q, P)
    visible = np.where(visible * np.diag(covariance) < scalar_redundancy.SMALLEST_VARIANCE, 0.0, visible)
    return Parity(A, matrix, np.asarray(Q, dtype=np.float64), P, visible)


def separation(model: Parity) -> FloatArray:
    """Return the sine of the angle between the parity directions of each two gauges: (n, n), 0 to 1.

    0: the two cannot be distinguished. Small: only by a fault that is larger by 1 / sine than the smallest visible
    one. NaN for gauges whose faults are invisible.
    """
    R = model.Q @ model.P
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.sqrt(np.where(model.visible > 0.0, model.visible, np.nan))
        cosine = R / np.outer(length, length)
    sine: FloatArray = np.sqrt(np.clip((1.0 - cosine) * (1.0 + cosine), 0.0, None))
    return sine


def alike(model: Parity, smallest_sine: float = 1e-6) -> list[tuple[int, int]]:
    """Return the pairs of gauges that no fault up to 1 / smallest_sine of the smallest visible one distinguishes."""
    sine = separation(model)
    n = len(sine)
    return [(i, k) for i in range(n) for k in range(i + 1, n) if sine[i, k] < smallest_sine]


def detectable_strain(
    model: Parity, false_alarm_rate: float = FALSE_ALARM_RATE, *, limit: float | None = None
) -> FloatArray:
    """Return the fault of each gauge that moves chi-square's mean to its threshold, (n,), strain; inf: invisible.

    limit: the threshold (2116h), where it is not that of the rate.
    """
    threshold = scalar_redundancy.chi_square_threshold(false_alarm_rate, model.degrees) if limit is None else limit
    with np.errstate(divide="ignore"):
        found: FloatArray = np.sqrt((threshold - model.degrees) / model.visible)
    return found


def detect(
    model: Parity,
    strain: npt.ArrayLike,
    *,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    exclusion_rate: float = EXCLUSION_RATE,
    variance_factor: npt.ArrayLike = 1.0,
) -> Faults:
    """Return the fault decisions for readings of shape (..., n), strain with the offsets subtracted.

    A reading is faulty if chi-square exceeds the threshold of false_alarm_rate; a gauge is a candidate if the
    residual of its best-fitting fault (n - 4 degrees of freedom) is below that of exclusion_rate, so the true one
    is missed at that rate. Isolated is the only candidate. variance_factor, (...): ratio of the residuals' variance
    to that of the gauges' noise; a calibrated C adds 1 + G^T N^-1 G. Raises InputError for other shapes, and
    for rates outside (0, 1).
    """
    for name, rate in (("false_alarm_rate", false_alarm_rate), ("exclusion_rate", exclusion_rate)):
        if not 0.0 < rate < 1.0:
            raise InputError(f"{name} = {rate!r}: allowed is above 0 and below 1")
    V = floats("strain", strain)
    n = len(model.A)
    if V.ndim < 1 or V.shape[-1] != n:
        raise InputError(f"strain has the shape {V.shape}: allowed is (..., {n})")
    factor = floats("variance_factor", variance_factor)
    alarm = scalar_redundancy.chi_square_threshold(false_alarm_rate, n - 3)
    exclusion = scalar_redundancy.chi_square_threshold(exclusion_rate, n - 4)
    with np.errstate(invalid="ignore", over="ignore"):
        r = V - (V @ model.C.T) @ model.A.T
        weighed = r @ model.Q
        chi_square = np.sum(r * weighed, axis=-1) / factor
        fault = ~(chi_square <= alarm)
        candidates = np.zeros(V.shape, dtype=np.bool_)
        for k in np.flatnonzero(model.visible):
            # With four gauges only rounding is left, and every gauge explains all.
            rest = r - (weighed[..., k] / model.visible[k])[..., np.newaxis] * model.P[:, k]
            left = np.sum(rest * (rest @ model.Q), axis=-1) / factor
            candidates[..., k] = fault & ((n == 4) | (left <= exclusion)) & np.isfinite(chi_square)
    alone = np.where(candidates.sum(axis=-1) == 1, candidates.argmax(axis=-1), UNCLEAR)
    return Faults(chi_square, fault, candidates, np.where(fault, alone, NONE).astype(np.int64))


def _matrix(C: npt.ArrayLike) -> FloatArray:
    matrix = floats("C", C)
    if matrix.ndim != 2 or matrix.shape[0] != 3 or matrix.shape[1] < 3:
        raise InputError(f"C has the shape {matrix.shape}: allowed is (3, n) with n gauges, at least 3")
    if not np.isfinite(matrix).all():
        raise InputError(f"C holds {matrix[~np.isfinite(matrix)][0]}: allowed are finite numbers")
    return matrix


def _root(covariance_strain2: npt.ArrayLike, n: int) -> FloatArray:
    """Return the lower Cholesky factor."""
    covariance = floats("covariance_strain2", covariance_strain2)
    if covariance.shape != (n, n):
        raise InputError(f"covariance_strain2 has the shape {covariance.shape}: allowed is {(n, n)}")
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise InputError(
            "covariance_strain2 is not positive definite: with more than three gauges their noise sets their "
            "weights; allowed is a noise above zero for every gauge"
        ) from None
