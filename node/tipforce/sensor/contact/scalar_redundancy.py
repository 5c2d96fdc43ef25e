"""More than three gauges, on the MicroPython subset: whether and which gauges contradict, and the force from the rest
(redundancy.py explains it). Matrices are lists of rows, noise is the upper triangle of the gauges' covariance (2106h),
strain^2. Gauges that vary more than their noise, by ``extra`` strain^2 (a model uncertainty grows with the strain),
make p = W V vary by M = I + sum of extra_k w_k w_k, w_k column k of W; chi-square p M^-1 p is that of Sigma +
diag(extra)."""

from math import erfc, exp, pi, sqrt

from .scalar_condition import condition_number, dot, square

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    Directions = list[list[float]]
    from .scalar_condition import Number


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
    """Return A, n rows of 3, strain per newton: Sigma C^T (C Sigma C^T)^-1; None where that has no rank 3. noise all
    zero stands for gauges of equal noise."""
    covariance = _covariance(noise, len(C[0]))
    through = [[dot(row, column) for column in covariance] for row in C]  # C Sigma, Sigma being symmetric
    K = [[dot(left, right) for right in C] for left in through]
    columns = _solved(K, through)
    return None if columns is None else [[row[i] for row in columns] for i in range(len(C[0]))]


def leave_out(
    C: list[list[float]], noise: list[float], left_out: list[int], condition_limit: float = CONDITION_LIMIT
) -> tuple[list[list[float]], tuple[float, float, float, float, float, float]] | None:
    """Return (3 rows of n, newtons per unit strain; covariance of F, upper triangle, N^2) without the gauges
    ``left_out`` (from 0), zeros for them; None without rank 3: fewer than three left, a singular covariance, or a
    condition number over the limit. C must weigh by noise; all zero: equal weights, a covariance of zero."""
    n = len(C[0])
    kept = [k for k in range(n) if k not in left_out]
    A = structure_matrix(C, noise)
    if A is None or len(kept) < 3:
        return None
    full = _covariance(noise, n)
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


def _covariance(noise: list[float], n: int) -> list[list[float]]:
    """The covariance as n rows; the unit matrix where all of it is zero."""
    return square(noise, n) if any(noise) else [[1.0 if i == j else 0.0 for j in range(n)] for i in range(n)]


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


NO_FAULT = 16.0
"""Odds, before a sample, that no gauge is at fault to those that a certain one is."""
LEAST_SHARE = 0.1
"""Of a gauge's own variance: a gauge that shows less in the residuals counts as invisible. Its noise there would pass
for a fault that moves F by more than three times what all its noise does."""


def directions(C: "list[list[float]]", noise: "list[float]", kept: "list[int]") -> "Directions | None":
    """Return W, m - 3 rows of n, per strain, of the m gauges ``kept``; zero columns for the others. C: 3 rows of n that
    weigh by noise (2106h, upper triangle). None: m < 4, noise zero, a singular covariance, or a C without rank 3."""
    n = len(C[0])
    A = structure_matrix(C, noise) if len(kept) > 3 and any(noise) else None
    if A is None:
        return None
    full = _covariance(noise, n)
    inverse_root = _inverse_root([[full[i][j] for j in kept] for i in kept])
    if inverse_root is None:
        return None
    whitened = [[dot(row, [A[k][i] for k in kept]) for row in inverse_root] for i in range(3)]
    basis: list[list[float]] = []
    for column in whitened:
        if not _extend(basis, column):
            return None
    m = len(kept)
    while len(basis) < m:
        # Of the unit vectors the one that is furthest from what is spanned: its length stays well above rounding.
        left = [1.0 - sum([row[i] * row[i] for row in basis]) for i in range(m)]
        axis = left.index(max(left))
        _extend(basis, [1.0 if i == axis else 0.0 for i in range(m)])
    W = [[0.0] * n for _ in range(m - 3)]
    for row, unit in zip(W, basis[3:]):  # noqa: B905 (MicroPython's zip has no strict=)
        for place in range(m):
            row[kept[place]] = dot(unit, [line[place] for line in inverse_root])
    return W


def columns(W: "Directions", noise: "list[float]") -> "list[list[float] | None]":
    """Return column k of W for each gauge, None for one whose fault no residual shows."""
    n = len(W[0])
    full = _covariance(noise, n)
    shown: list[list[float] | None] = []
    for k in range(n):
        column = [row[k] for row in W]
        shown.append(column if dot(column, column) * full[k][k] >= SMALLEST_VARIANCE else None)
    return shown


def judge(
    W: "Directions",
    shown: "list[list[float] | None]",
    strains: "list[float]",
    extra: "Sequence[float] | None",
    alarm: float,
    exclusion: float,
) -> "tuple[float, int, list[tuple[float, float]]]":
    """Return (chi-square, bits of the gauges that may be at fault, (chi-square, visibility) of each gauge's fault,
    zeros where not shown). Bits -1: nothing is wrong; 0: no single gauge explains it, or NaN; several: not
    distinguished.

    strains: without offsets, finite for gauges that are not kept. shown: ``columns``. extra: strain^2 of each gauge
    beside its noise. alarm, exclusion: limits of chi-square with as many degrees of freedom as W has rows, and one
    less, for what the best-fitting fault of a gauge leaves."""
    chi_square, faults = explained(W, shown, strains, extra)
    bits = 0
    for k in range(len(strains)):
        # With one direction nothing is left but rounding, and every gauge explains all.
        if shown[k] is not None and (len(W) == 1 or chi_square - faults[k][0] <= exclusion):
            bits |= 1 << k
    if chi_square <= alarm:
        return chi_square, -1, faults
    if chi_square - chi_square != 0.0:  # NaN or infinity
        return chi_square, 0, faults
    return chi_square, bits, faults


def explained(
    W: "Directions",
    shown: "list[list[float] | None]",
    strains: "Sequence[Number]",
    extra: "Sequence[Number] | None",
    noise: "float | Number" = 1.0,
    square_root: "Callable[[Number], Number]" = sqrt,
) -> "tuple[Number, list[tuple[Number, Number]]]":
    """Return (chi-square, (what of it the best-fitting fault explains, chi-square per strain^2) of each gauge), as
    ``judge``. noise: its variance factor. With numpy's square root strains may be columns of samples."""
    p = [dot(row, strains) for row in W]
    root = None if extra is None else _root(W, extra, noise, square_root)
    q = p if root is None else _forward(root, p)
    faults = []
    for column in shown:
        if column is None:
            faults.append((0.0, 0.0))
            continue
        s = column if root is None else _forward(root, column)
        visible, along = dot(s, s), dot(s, q)
        faults.append((along * along / visible, visible))
    return dot(q, q), faults


def doubt(
    C: "list[list[float]]", noise: "list[float]", faults: "list[tuple[float, float]]"
) -> "tuple[float, float, float, float, float, float]":
    """Return what a fault below the limit adds to the covariance of F, upper triangle, N^2: squares of what each
    gauge's best-fitting fault does to F, by its probability (Bayes: odds of NO_FAULT to 1 before the sample, likelihood
    exp(explained / 2)). faults: of ``judge``."""
    n = len(faults)
    shown: list[int] = []
    place, most = 0, 0.0
    for k in range(n):
        explained, visible = faults[k]
        if visible * noise[place] >= LEAST_SHARE:
            shown.append(k)
            most = max(most, explained)
        place += n - k
    # Likelihoods relative to the largest: a limit far above any chi-square leaves nothing that overflows.
    total = NO_FAULT * exp(-0.5 * most) + sum([exp(0.5 * (faults[k][0] - most)) for k in shown])
    k11 = k12 = k13 = k22 = k23 = k33 = 0.0
    for k in shown:
        explained, visible = faults[k]
        squared = exp(0.5 * (explained - most)) / total * explained / visible
        f1, f2, f3 = C[0][k], C[1][k], C[2][k]
        k11, k12, k13 = k11 + squared * f1 * f1, k12 + squared * f1 * f2, k13 + squared * f1 * f3
        k22, k23, k33 = k22 + squared * f2 * f2, k23 + squared * f2 * f3, k33 + squared * f3 * f3
    return k11, k12, k13, k22, k23, k33


def _root(
    W: "Directions", extra: "Sequence[Number]", noise: "float | Number", square_root: "Callable[[Number], Number]"
) -> "list[list[Number]]":
    """The lower Cholesky factor of M = noise I + W diag(extra) W^T."""
    d = len(W)
    L = [[0.0] * d for _ in range(d)]
    for i in range(d):
        scaled = [x * e for x, e in zip(W[i], extra)]  # noqa: B905
        for j in range(i + 1):
            total = dot(scaled, W[j]) - dot(L[i][:j], L[j][:j])
            L[i][j] = square_root(noise + total) if i == j else total / L[j][j]
    return L


def _forward(L: "list[list[Number]]", b: "Sequence[Number]") -> "list[Number]":
    x: list[Number] = []
    for i in range(len(b)):
        x.append((b[i] - dot(L[i][:i], x)) / L[i][i])
    return x


def _inverse_root(S: "list[list[float]]") -> "list[list[float]] | None":
    m = len(S)
    scale = []
    for i in range(m):
        if not S[i][i] > 0.0:
            return None
        scale.append(1.0 / sqrt(S[i][i]))
    L = [[0.0] * m for _ in range(m)]
    for i in range(m):
        for j in range(i + 1):
            total = S[i][j] * scale[i] * scale[j] - dot(L[i][:j], L[j][:j])
            if i == j and not total > 1e-12:
                return None
            L[i][j] = sqrt(total) if i == j else total / L[j][j]
    # Column j of the inverse solves L x = e_j; the scale belongs to the gauge, hence to the column.
    solved = [_forward(L, [1.0 if i == j else 0.0 for i in range(m)]) for j in range(m)]
    return [[solved[j][i] * scale[j] for j in range(m)] for i in range(m)]


def _extend(basis: "list[list[float]]", column: "list[float]") -> bool:
    """Add the unit vector of what ``column`` has outside of the basis; False where that is rounding alone."""
    length = sqrt(dot(column, column))
    if not length > 0.0:
        return False
    left = [x / length for x in column]
    for _ in range(2):  # the second pass removes what rounding left of the first
        for row in basis:
            along = dot(row, left)
            left = [x - along * y for x, y in zip(left, row)]  # noqa: B905
    length = sqrt(dot(left, left))
    if not length > 1e-6:
        return False
    basis.append([x / length for x in left])
    return True
