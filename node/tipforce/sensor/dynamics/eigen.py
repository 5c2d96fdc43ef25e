"""Eigenvalues of a small symmetric positive definite matrix, the small ones as exact as the large ones."""

from __future__ import annotations

import math

import numpy as np

from tipforce.arrays import FloatArray

_SWEEPS = 60


def jacobi(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (values (n,), vectors (n, n) as columns), largest value first, by Jacobi's rotations.

    Unlike numpy.linalg.eigh, whose errors are a fraction of the largest eigenvalue, the relative error of each
    eigenvalue is rounding times the condition number of the matrix with its diagonal scaled to 1 (Demmel and Veselic
    1992): a thin beam's stiffness beside a thick one's keeps its digits. A rotation is skipped only where the entry is
    small against the geometric mean of its two diagonal entries.
    """
    A, Q = matrix.copy(), np.eye(len(matrix))
    pairs = [(i, j) for i in range(len(A)) for j in range(i + 1, len(A))]
    for _ in range(_SWEEPS):
        rotated = False
        for i, j in pairs:
            if abs(A[i, j]) > 1e-17 * math.sqrt(abs(A[i, i])) * math.sqrt(abs(A[j, j])):
                rotated = _rotate(A, Q, i, j) or rotated
        if not rotated:
            break
    order = np.argsort(-np.diagonal(A))
    return np.diagonal(A)[order], Q[:, order]


def _rotate(A: FloatArray, Q: FloatArray, i: int, j: int) -> bool:
    """One rotation that makes A[i, j] zero; False where it changes nothing."""
    a, b, g = float(A[i, i]), float(A[j, j]), float(A[i, j])
    half = 0.5 * (b - a) / g
    tangent = math.copysign(1.0, half) / (abs(half) + math.hypot(1.0, half))
    c = 1.0 / math.hypot(1.0, tangent)
    s = tangent * c
    for M in (A.T, A, Q):  # rows, then columns: A.T is a view
        x, y = M[:, i].copy(), M[:, j].copy()
        M[:, i], M[:, j] = c * x - s * y, s * x + c * y
    # The exact diagonal: the products above would leave rounding of the larger in the smaller.
    A[i, i], A[j, j] = a - tangent * g, b + tangent * g
    A[i, j] = A[j, i] = 0.0
    return a != A[i, i] or b != A[j, j] or abs(tangent) > 1e-16
