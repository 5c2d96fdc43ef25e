"""More than three gauges: whether they contradict each other, and which one, sample by sample.

Needs the math module only and keeps to what MicroPython has. With V = A F + e and the covariance Sigma of e, the n - 3
rows w of ``directions`` have w A = 0 and w Sigma w = 1: p = W V does not depend on the force. Gauges that vary more
than their noise, by ``extra`` strain^2 (a model uncertainty grows with the strain), make p vary by M = I + sum of
extra_k w_k w_k; chi-square p M^-1 p is that of the weighted residuals of redundancy.py with Sigma + diag(extra). A
fault f of gauge k adds f w_k to p, w_k being column k of W.
"""

from math import exp, sqrt

from .scalar_redundancy import SMALLEST_VARIANCE, square, structure_matrix

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    Directions = list[list[float]]

NO_FAULT = 16.0
"""Odds, before a sample, that no gauge is at fault to those that a certain one is."""
LEAST_SHARE = 0.1
"""Of a gauge's own variance: a gauge that shows less in the residuals counts as invisible. Its noise there would pass
for a fault that moves F by more than three times what all its noise does."""


def directions(C: "list[list[float]]", noise: "list[float]", kept: "list[int]") -> "Directions | None":
    """Return W, m - 3 rows of n, per strain, of the m gauges ``kept``; zero columns for the others.

    C: 3 rows of n, the inverse that weighs by noise (2106h, upper triangle). None: m < 4, noise all zero, a singular
    covariance, or a C without rank 3.
    """
    n = len(C[0])
    A = structure_matrix(C, noise) if len(kept) > 3 and any(noise) else None
    if A is None:
        return None
    full = square(noise, n)
    inverse_root = _inverse_root([[full[i][j] for j in kept] for i in kept])
    if inverse_root is None:
        return None
    whitened = [[_dot(row, [A[k][i] for k in kept]) for row in inverse_root] for i in range(3)]
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
            row[kept[place]] = _dot(unit, [line[place] for line in inverse_root])
    return W


def columns(W: "Directions", noise: "list[float]") -> "list[list[float] | None]":
    """Return column k of W for each gauge, None for one whose fault no residual shows."""
    n = len(W[0])
    full = square(noise, n)
    found: list[list[float] | None] = []
    for k in range(n):
        column = [row[k] for row in W]
        found.append(column if _dot(column, column) * full[k][k] >= SMALLEST_VARIANCE else None)
    return found


def judge(
    W: "Directions",
    shown: "list[list[float] | None]",
    strains: "list[float]",
    extra: "Sequence[float] | None",
    alarm: float,
    exclusion: float,
) -> "tuple[float, int, list[tuple[float, float]]]":
    """Return (chi-square, bits of the gauges that may be at fault, (chi-square, visibility) of each gauge's fault).

    strains: offsets taken off; what gauges that are not kept read does not matter, as long as it is finite. shown:
    ``columns``. extra: strain^2 of each gauge beside its noise, None for none. alarm and exclusion: what chi-square
    must exceed with as many degrees of freedom as W has rows, and with one less. Bits -1: nothing is wrong; 0: no
    single gauge explains it; one bit: that gauge; more: they cannot be told apart. A gauge explains what its
    best-fitting fault leaves no more than ``exclusion`` of; of that fault, the chi-square it explains and the
    chi-square per strain^2 are returned, zeros for a gauge that is not shown. NaN in: chi-square NaN, bits 0.
    """
    p = [_dot(row, strains) for row in W]
    root = None if extra is None else _root(W, extra)
    q = p if root is None else _forward(root, p)
    chi_square = _dot(q, q)
    faults: list[tuple[float, float]] = []
    bits = 0
    for k in range(len(strains)):
        column = shown[k]
        if column is None:
            faults.append((0.0, 0.0))
            continue
        s = column if root is None else _forward(root, column)
        visible = _dot(s, s)
        along = _dot(s, q)
        explained = along * along / visible
        faults.append((explained, visible))
        # With one direction nothing is left but rounding, and every gauge explains all.
        if len(W) == 1 or chi_square - explained <= exclusion:
            bits |= 1 << k
    if chi_square <= alarm:
        return chi_square, -1, faults
    if chi_square - chi_square != 0.0:  # NaN or infinity
        return chi_square, 0, faults
    return chi_square, bits, faults


def doubt(
    C: "list[list[float]]",
    noise: "list[float]",
    faults: "list[tuple[float, float]]",
) -> "tuple[float, float, float, float, float, float]":
    """Return what a fault below the limit adds to the covariance of F: upper triangle, N^2.

    The sum over the gauges of the square of what the best-fitting fault of each does to F, weighed by the probability
    of that fault (Bayes: odds of NO_FAULT to 1 before the sample, likelihood exp(explained / 2)). faults: of ``judge``.
    """
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


def _root(W: "Directions", extra: "Sequence[float]") -> "list[list[float]]":
    """The lower Cholesky factor of M = I + W diag(extra) W^T."""
    d = len(W)
    L = [[0.0] * d for _ in range(d)]
    for i in range(d):
        scaled = [x * e for x, e in zip(W[i], extra)]  # noqa: B905
        for j in range(i + 1):
            total = _dot(scaled, W[j]) - _dot(L[i][:j], L[j][:j])
            L[i][j] = sqrt(1.0 + total) if i == j else total / L[j][j]
    return L


def _forward(L: "list[list[float]]", b: "list[float]") -> "list[float]":
    """x with L x = b."""
    x: list[float] = []
    for i in range(len(b)):
        x.append((b[i] - _dot(L[i][:i], x)) / L[i][i])
    return x


def _inverse_root(S: "list[list[float]]") -> "list[list[float]] | None":
    """The inverse of the lower Cholesky factor of S, row by row; None where S is singular."""
    m = len(S)
    scale = []
    for i in range(m):
        if not S[i][i] > 0.0:
            return None
        scale.append(1.0 / sqrt(S[i][i]))
    L = [[0.0] * m for _ in range(m)]
    for i in range(m):
        for j in range(i + 1):
            total = S[i][j] * scale[i] * scale[j] - _dot(L[i][:j], L[j][:j])
            if i == j and not total > 1e-12:
                return None
            L[i][j] = sqrt(total) if i == j else total / L[j][j]
    # Column j of the inverse solves L x = e_j; the scale belongs to the gauge, hence to the column.
    solved = [_forward(L, [1.0 if i == j else 0.0 for i in range(m)]) for j in range(m)]
    return [[solved[j][i] * scale[j] for j in range(m)] for i in range(m)]


def _extend(basis: "list[list[float]]", column: "list[float]") -> bool:
    """Add the unit vector of what ``column`` has outside of the basis; False where that is rounding alone."""
    length = sqrt(_dot(column, column))
    if not length > 0.0:
        return False
    left = [x / length for x in column]
    for _ in range(2):  # the second pass removes what rounding left of the first
        for row in basis:
            along = _dot(row, left)
            left = [x - along * y for x, y in zip(left, row)]  # noqa: B905
    length = sqrt(_dot(left, left))
    if not length > 1e-6:
        return False
    basis.append([x / length for x in left])
    return True


def _dot(a: "Sequence[float]", b: "Sequence[float]") -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total
