"""Fault detection with more than three gauges. V = A F + e with the covariance Sigma of e; C = (A^T Q A)^-1 A^T Q, Q =
Sigma^-1. n - 3 combinations W of the gauges do not depend on the force (parity directions); chi-square is |W V|^2, and
a fault moves W V along its gauge's column of W. Two gauges with parallel columns cannot be distinguished: exactly if
the other n - 2 have no rank 3; one is invisible if the others have none: its fault looks like a force."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray, floats
from tipforce.errors import InputError
from tipforce.sensor.contact import scalar_redundancy
from tipforce.sensor.contact.scalar_redundancy import EXCLUSION_RATE, FALSE_ALARM_RATE

NONE, UNCLEAR = -1, -2
"""Values of Faults.isolated: no fault; a fault that no single gauge, or more than one, explains."""


@dataclass(frozen=True, slots=True, eq=False)
class Parity:
    """Information in the residuals of n > 3 gauges."""

    W: FloatArray
    """(n - 3, n), per strain: directions in which no force moves the gauges, each of variance 1."""
    visible: FloatArray
    """(n,), chi-square per squared unit fault of each gauge; zero: its fault is invisible."""


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
    """Return C = (A^T Q A)^-1 A^T Q, (3, n), for A (n, 3), strain per newton, and the gauges' covariance (n, n). Raises
    InputError where the shapes do not fit, A has no rank 3, or the covariance is not positive definite."""
    matrix = np.asarray(A, dtype=np.float64)
    if matrix.ndim != 2 or matrix.shape[1] != 3 or matrix.shape[0] < 3:
        raise InputError(f"A has the shape {matrix.shape}: allowed is (n, 3) with n gauges, at least 3")
    root = _root(covariance_strain2, matrix.shape[0])
    whitened = np.linalg.solve(root, matrix)
    if np.linalg.matrix_rank(whitened) < 3:
        raise InputError("the gauges cannot separate the three forces: allowed is A of rank 3")
    return np.asarray(np.linalg.solve(root.T, np.linalg.pinv(whitened).T).T, dtype=np.float64)


def structure_matrix(C: npt.ArrayLike, covariance_strain2: npt.ArrayLike) -> FloatArray:
    """Return A = Sigma C^T (C Sigma C^T)^-1, (n, 3), strain per newton: it inverts weighted_inverse(). Raises
    InputError where the shapes do not fit, C (3, n) has no rank 3, or the covariance is not positive definite."""
    (matrix, unit), covariance = _matrix(C), floats("covariance_strain2", covariance_strain2)
    _root(covariance, matrix.shape[1])
    if np.linalg.matrix_rank(matrix) < 3:
        raise InputError("the calibration cannot separate the three forces: allowed is C of rank 3")
    A = np.linalg.solve(matrix @ covariance @ matrix.T, matrix @ covariance).T / unit
    return np.asarray(A, dtype=np.float64)


def parity(C: npt.ArrayLike, covariance_strain2: npt.ArrayLike) -> Parity:
    """Return the information in the residuals of n > 3 gauges. C: (3, n), weighted by covariance_strain2 (n, n). Raises
    InputError as structure_matrix() does, and for n = 3, where every reading fits some force."""
    (matrix, _), covariance = _matrix(C), floats("covariance_strain2", covariance_strain2)
    n = matrix.shape[1]
    if n < 4:
        raise InputError("three gauges have no parity direction: fault detection needs at least four")
    structure_matrix(matrix, covariance)  # raises
    noise: list[float] = covariance[np.triu_indices(n)].tolist()
    W = scalar_redundancy.directions(matrix.tolist(), noise, list(range(n)))
    if W is None:
        raise InputError("the gauges' noise is too different: their covariance has no inverse in floating point")
    shown = [column is not None for column in scalar_redundancy.columns(W, noise)]
    return Parity(np.array(W), np.where(shown, np.square(W).sum(axis=0), 0.0))


def detectable_strain(
    model: Parity, false_alarm_rate: float = FALSE_ALARM_RATE, *, limit: float | None = None
) -> FloatArray:
    """Return the fault of each gauge that moves chi-square's mean to its threshold, (n,), strain; inf: invisible.
    limit: the threshold (2116h), where it is not that of the rate."""
    degrees = len(model.W)
    threshold = scalar_redundancy.chi_square_threshold(false_alarm_rate, degrees) if limit is None else limit
    with np.errstate(divide="ignore"):
        return np.sqrt((threshold - degrees) / model.visible)


def detect(
    model: Parity,
    strain: npt.ArrayLike,
    *,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    exclusion_rate: float = EXCLUSION_RATE,
    variance_factor: npt.ArrayLike = 1.0,
) -> Faults:
    """Return the fault decisions for readings (..., n), strain without offsets.

    Faulty: chi-square exceeds the threshold of false_alarm_rate; candidates: gauges whose best-fitting fault leaves (n
    - 4 degrees of freedom) less than that of exclusion_rate. variance_factor, (...): of the residuals over the gauges'
    noise; a calibrated C adds 1 + G^T N^-1 G. Raises InputError for other shapes, and for rates outside (0, 1)."""
    for name, rate in (("false_alarm_rate", false_alarm_rate), ("exclusion_rate", exclusion_rate)):
        if not 0.0 < rate < 1.0:
            raise InputError(f"{name} = {rate!r}: allowed is above 0 and below 1")
    V, n = floats("strain", strain), len(model.visible)
    if V.ndim < 1 or V.shape[-1] != n:
        raise InputError(f"strain has the shape {V.shape}: allowed is (..., {n})")
    factor = floats("variance_factor", variance_factor)
    alarm = scalar_redundancy.chi_square_threshold(false_alarm_rate, n - 3)
    exclusion = scalar_redundancy.chi_square_threshold(exclusion_rate, n - 4)
    with np.errstate(invalid="ignore", over="ignore"):
        p = V @ model.W.T
        chi_square = np.square(p).sum(axis=-1) / factor
        fault = ~(chi_square <= alarm)
        along = np.square(p @ model.W) / np.where(model.visible > 0.0, model.visible, np.inf)
        left = chi_square[..., np.newaxis] - along / factor[..., np.newaxis]
        # With four gauges only rounding is left, and every gauge explains all.
        candidates = (model.visible > 0.0) & ((n == 4) | (left <= exclusion))
        candidates &= (fault & np.isfinite(chi_square))[..., np.newaxis]
    alone = np.where(candidates.sum(axis=-1) == 1, candidates.argmax(axis=-1), UNCLEAR)
    return Faults(chi_square, fault, candidates, np.where(fault, alone, NONE).astype(np.int64))


def _matrix(C: npt.ArrayLike) -> tuple[FloatArray, float]:
    """C over its unit, a power of two: squares stay in range, and no direction W depends on it."""
    matrix = floats("C", C)
    if matrix.ndim != 2 or matrix.shape[0] != 3 or matrix.shape[1] < 3:
        raise InputError(f"C has the shape {matrix.shape}: allowed is (3, n) with n gauges, at least 3")
    if not np.isfinite(matrix).all():
        raise InputError(f"C holds {matrix[~np.isfinite(matrix)][0]}: allowed are finite numbers")
    unit = float(np.ldexp(1.0, np.frexp(np.abs(matrix).max())[1] - 1))
    return matrix / unit, unit


def _root(covariance_strain2: npt.ArrayLike, n: int) -> FloatArray:
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
