"""More than three gauges, for a microcontroller: the force without a dead gauge, and limits of chi-square.

Needs the math module only and keeps to what MicroPython has; redundancy.py holds the same for arrays and explains it.
A node computes what it needs of it when a gauge is left out; scalar_parity.py is the check itself.
Matrices are lists of rows, noise is the upper triangle of the gauges' covariance by rows (object 2106h), strain^2.
"""

from math import erfc, exp, pi, sqrt

from .scalar_condition import condition_number

CONDITION_LIMIT = 1e4  # of the matrix of the gauges left, 2-norm, as 2105h:1: beyond it they have no rank 3
FALSE_ALARM_RATE = 1e-4  # of fault detection, per sample
EXCLUSION_RATE = 1e-3  # of isolation: how often the faulty gauge itself is not among those named
SMALLEST_VARIANCE = 1e-6  # of a gauge's own variance: below, the other gauges say nothing about this one
_SMALLEST_PIVOT = 1e-13
_BISECTIONS = 200


def chi_square_threshold(rate: float, degrees: int) -> float:
    """Return what chi-square with so many degrees of freedom exceeds at this rate; degrees from 0, rate in (0, 1)."""
    if degrees <= 0:
        return 0.0
    low, high = 0.0, 1.0
    while _exceeds(high, degrees) > rate:
        low, high = high, 2.0 * high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        if _exceeds(middle, degrees) > rate:
            low = middle
        else:
            high = middle
    return high


def same_rate(limit: float, degrees: int, fewer: int) -> float:
    """Return the limit with ``fewer`` degrees of freedom that chi-square exceeds as often as ``limit`` with degrees."""
    rate = _exceeds(limit, degrees)
    # So high a limit that no float holds its rate stays as it is.
    return chi_square_threshold(rate, fewer) if 0.0 < rate < 1.0 else limit


def _exceeds(x: float, degrees: int) -> float:
    """The probability that chi-square exceeds x: a finite sum for whole degrees of freedom."""
    half = 0.5 * x
    if degrees % 2:
        total, term, k = erfc(sqrt(half)), sqrt(half / pi) * exp(-half) * 2.0, 3
    else:
        total, term, k = exp(-half), half * exp(-half), 4
    while k <= degrees:
        total += term
        term *= x / k
        k += 2
    return total


def structure_matrix(C: list[list[float]], noise: list[float]) -> list[list[float]] | None:
    """Return A, n rows of 3, strain per newton: Sigma C^T (C Sigma C^T)^-1; None where that has no rank 3.

    noise all zero stands for gauges of equal noise.
    """
    covariance = square(noise, len(C[0]))
    through = [[_dot(row, column) for column in covariance] for row in C]  # C Sigma, Sigma being symmetric
    K = [[_dot(left, right) for right in C] for left in through]
    columns = _solved(K, through)
    return None if columns is None else [[row[i] for row in columns] for i in range(len(C[0]))]


def leave_out(
    C: list[list[float]], noise: list[float], left_out: list[int], condition_limit: float = CONDITION_LIMIT
) -> tuple[list[list[float]], tuple[float, float, float, float, float, float]] | None:
    """Return (matrix, covariance of F) that use all gauges but some, or None where the rest has no rank 3.

    left_out: gauges from 0. The matrix is 3 rows of n with zeros for the gauges left out, newtons per unit
    strain; the covariance is the upper triangle 11, 12, 13, 22, 23, 33, N^2, as scalar.uncertainty() takes it.
    No rank 3: fewer than three gauges left, a singular covariance, or a condition number over the limit. C must
    be the inverse that weighs by noise. noise all zero: equal weights, and a covariance of zero.
    """
    n = len(C[0])
    kept = [k for k in range(n) if k not in left_out]
    A = structure_matrix(C, noise)
    if A is None or len(kept) < 3:
        return None
    full = square(noise, n)
    rows = [A[k] for k in kept]
    weighed = _solved([[full[i][j] for j in kept] for i in kept], rows)  # Q A
    if weighed is None:
        return None
    M = [[sum([rows[k][i] * weighed[k][j] for k in range(len(kept))]) for j in range(3)] for i in range(3)]
    columns = _solved(M, [[row[i] for row in weighed] for i in range(3)])
    inverse = _solved(M, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    if columns is None or inverse is None or not condition_number(columns) <= condition_limit:
        return None
    matrix = [[0.0] * n for _ in range(3)]
    for place in range(len(kept)):
        for i in range(3):
            matrix[i][kept[place]] = columns[i][place]
    scale = 1.0 if any(noise) else 0.0
    (k11, k12, k13), (_, k22, k23), (_, _, k33) = inverse
    return matrix, (scale * k11, scale * k12, scale * k13, scale * k22, scale * k23, scale * k33)


def subsets(
    C: list[list[float]], noise: list[float], condition_limit: float = CONDITION_LIMIT
) -> list[tuple[list[list[float]], tuple[float, float, float, float, float, float]] | None]:
    """Return n + 1 results of leave_out(): item k without gauge k, item n with all."""
    n = len(C[0])
    found = [leave_out(C, noise, [k], condition_limit) for k in range(n)]
    found.append(leave_out(C, noise, [], condition_limit))
    return found


def force(matrix: list[list[float]], strains: list[float]) -> tuple[float, float, float]:
    """Return F1, F2, F3 in newtons from strains with the offsets taken off; gauges left out may read anything."""
    F = [0.0, 0.0, 0.0]
    for i in range(3):
        row = matrix[i]
        for k in range(len(row)):
            if row[k] != 0.0:  # a dead gauge may read NaN, which zero does not remove
                F[i] += row[k] * strains[k]
    return F[0], F[1], F[2]


def square(noise: list[float], n: int) -> list[list[float]]:
    """The covariance as n rows; the unit matrix where all of it is zero."""
    full = [[0.0] * n for _ in range(n)]
    place = 0
    for i in range(n):
        for j in range(i, n):
            full[i][j] = full[j][i] = noise[place]
            place += 1
    if not any(noise):
        for i in range(n):
            full[i][i] = 1.0
    return full


def _dot(a: list[float], b: list[float]) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


def _solved(M: list[list[float]], B: list[list[float]]) -> list[list[float]] | None:
    """X with M X = B for a symmetric positive definite M, by elimination; None where M is singular."""
    n = len(M)
    scale = []
    for i in range(n):
        if not M[i][i] > 0.0:
            return None
        scale.append(1.0 / sqrt(M[i][i]))
    # Rows and columns scaled to a unit diagonal: then no pivoting is needed, and a pivot says how singular M is.
    work = [[M[i][j] * scale[i] * scale[j] for j in range(n)] + [x * scale[i] for x in B[i]] for i in range(n)]
    for i in range(n):
        pivot = work[i][i]
        if not pivot > _SMALLEST_PIVOT:
            return None
        for k in range(i + 1, n):
            factor = work[k][i] / pivot
            if factor != 0.0:
                work[k] = [work[k][j] - factor * work[i][j] for j in range(len(work[k]))]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            factor = work[i][k]
            work[i] = work[i][:n] + [work[i][j] - factor * work[k][j] for j in range(n, len(work[i]))]
        work[i] = work[i][:n] + [x / work[i][i] for x in work[i][n:]]
    return [[x * scale[i] for x in work[i][n:]] for i in range(n)]
