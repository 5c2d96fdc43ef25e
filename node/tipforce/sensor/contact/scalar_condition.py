"""Singular values of a calibration matrix without numpy: the node itself rejects a bad one."""

from math import sqrt

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    Number = Any  # a number, or a column of samples

_SWEEPS = 30
_CONVERGED = 1e-15


def singular_range(rows: "list[list[float]]") -> "tuple[float, float]":
    """Return the largest and the smallest singular value of a few rows, each with full relative accuracy: the lengths
    of the rows rotated until all are orthogonal (one-sided Jacobi). NaN where an element is not finite."""
    largest = 0.0
    for row in rows:
        for value in row:
            if value - value != 0.0:
                return float("nan"), float("nan")
            largest = max(largest, abs(value))
    if largest == 0.0:
        return 0.0, 0.0
    work = [[value / largest for value in row] for row in rows]
    for _ in range(_SWEEPS):
        if not _sweep(work):
            break
    lengths = [sqrt(dot(row, row)) for row in work]
    return largest * max(lengths), largest * min(lengths)


def condition_number(rows: "list[list[float]]") -> float:
    """The 2-norm condition number of a matrix, see singular_range(); infinite when singular, NaN if not finite."""
    largest, smallest = singular_range(rows)
    if smallest == 0.0:
        return float("inf")
    return largest / smallest


def _sweep(work: "list[list[float]]") -> bool:
    turned = False
    for i in range(len(work)):
        for k in range(i + 1, len(work)):
            a, b = work[i], work[k]
            aa, bb, ab = dot(a, a), dot(b, b), dot(a, b)
            if abs(ab) <= _CONVERGED * sqrt(aa * bb):
                continue
            turned = True
            zeta = (bb - aa) / (2.0 * ab)
            t = (1.0 if zeta >= 0.0 else -1.0) / (abs(zeta) + sqrt(1.0 + zeta * zeta))
            c = 1.0 / sqrt(1.0 + t * t)
            s = c * t
            work[i] = [c * x - s * y for x, y in zip(a, b)]  # noqa: B905 (MicroPython's zip has no strict=)
            work[k] = [s * x + c * y for x, y in zip(a, b)]  # noqa: B905
    return turned


def dot(a: "Sequence[Number]", b: "Sequence[Number]") -> "Number":
    """The sum of products."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


def square(triangle: "Sequence[float]", n: int) -> "list[list[float]]":
    """The symmetric matrix whose upper triangle, by rows, is given."""
    full = [[0.0] * n for _ in range(n)]
    k = 0
    for i in range(n):
        for j in range(i, n):
            full[i][j] = full[j][i] = triangle[k]
            k += 1
    return full
