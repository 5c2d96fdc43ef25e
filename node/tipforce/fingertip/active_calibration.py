"""The calibration that is active on a node, unpacked: what turns gauge strain into force, and what judges it."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    Covariance = tuple[float, float, float, float, float, float]
    Solver = tuple[list[list[float]], Covariance]
    # rows and columns of scalar_parity, what chi-square must exceed for an alarm, and what excludes a gauge
    Check = tuple[list[list[float]], list[list[float] | None], float, float]

_MOST_SOLVERS = 12  # kept for gauges left out: memory stays bounded whatever gauges do


class Active:
    """One calibration, unpacked: ``C`` is three rows in N per strain, ``noise`` the covariance of the gauges.

    ``forces``, ``range_degC`` and ``model`` are 2112h; ``converter`` 2113h and ``per_kelvin`` 2114h, None where all
    are zero; ``gain_per_kelvin`` 2115h; ``redundancy`` 2116h. ``checked``: a sample has something to be judged by.
    """

    __slots__ = (
        "C", "_checks", "_solvers", "checked", "converter", "forces", "gain_per_kelvin", "limits", "model", "noise",
        "offsets", "per_kelvin", "pull", "range_degC", "record", "redundancy", "reference_degC",
    )  # fmt: skip

    def __init__(self, record: bytes, values: "list[float]", n: int) -> None:
        self.record = record
        self.C = [values[row * n : row * n + n] for row in range(3)]
        self.offsets = values[3 * n : 4 * n]
        after_facts = 4 * n + 4
        triangle = n * (n + 1) // 2
        self.noise = values[after_facts : after_facts + triangle]
        pad = after_facts + triangle
        _radius, theta_min, theta_max, on, off, sense = values[pad : pad + 6]
        self.limits = (on, off, theta_min, theta_max)
        self.pull = bool(sense)
        self.reference_degC = values[4 * n + 2]
        pad += 6
        self.forces = values[pad], values[pad + 1]
        self.range_degC = values[pad + 2], values[pad + 3]
        self.model = values[pad + 4]
        converter, per_kelvin = values[pad + 5 : pad + 5 + n], values[pad + 5 + n : pad + 5 + 2 * n]
        self.converter = converter if any(converter) else None
        self.per_kelvin = per_kelvin if any(per_kelvin) else None
        self.gain_per_kelvin, self.redundancy = values[pad + 5 + 2 * n :]
        known = any(self.forces) or any(self.range_degC) or self.compensated()
        self.checked = known or self.model > 0.0 or (n > 3 and self.redundancy > 0.0)
        self._checks: "dict[int, Check | None]" = {}
        self._solvers: "dict[int, Solver | None]" = {0: (self.C, _propagate(self.C, self.noise, n))}

    def compensated(self) -> bool:
        """True where the record has a coefficient of temperature."""
        return self.per_kelvin is not None or self.gain_per_kelvin != 0.0

    def check(self, lost: int) -> "Check | None":
        """What judges the gauges that are left without those of the bit mask ``lost``; None where nothing can.

        2116h is for n - 3 degrees of freedom: with fewer gauges the limit of the same false-alarm rate holds.
        """
        if lost not in self._checks:
            if len(self._checks) >= _MOST_SOLVERS:
                self._checks.clear()
            self._checks[lost] = self._find_check(lost)
        return self._checks[lost]

    def _find_check(self, lost: int) -> "Check | None":
        n = len(self.offsets)
        kept = [k for k in range(n) if not lost >> k & 1]
        if not self.redundancy > 0.0 or len(kept) < 4:
            return None
        from tipforce.sensor.contact import scalar_parity, scalar_redundancy  # a node with three gauges does without

        W = scalar_parity.directions(self.C, self.noise, kept)
        if W is None:
            return None
        alarm = self.redundancy if len(kept) == n else scalar_redundancy.same_rate(self.redundancy, n - 3, len(W))
        exclusion = scalar_redundancy.same_rate(self.redundancy, n - 3, len(W) - 1)
        return W, scalar_parity.columns(W, self.noise), alarm, exclusion

    def solver(self, lost: int) -> "Solver | None":
        """(matrix, covariance of F in N^2) that do without the gauges of the bit mask ``lost``.

        None where the gauges left have no rank 3, always so with three gauges and one lost.
        """
        if lost not in self._solvers:
            if len(self._solvers) >= _MOST_SOLVERS:
                self._solvers = {0: self._solvers[0]}
            found = None
            n = len(self.offsets)
            if n > 3:
                from tipforce.sensor.contact import scalar_redundancy  # a node with three gauges does without

                found = scalar_redundancy.leave_out(self.C, self.noise, [k for k in range(n) if lost >> k & 1])
            self._solvers[lost] = found
        return self._solvers[lost]

    def force(self, matrix: "list[list[float]]", microstrains: "list[float]") -> "tuple[float, float, float]":
        """F1, F2, F3 in newtons before any tare: F = C (V - offset), V the gauge strain."""
        F1 = F2 = F3 = 0.0
        for m, o, c1, c2, c3 in zip(microstrains, self.offsets, matrix[0], matrix[1], matrix[2]):  # noqa: B905
            v = 1e-6 * m - o
            F1 += c1 * v
            F2 += c2 * v
            F3 += c3 * v
        return F1, F2, F3


def _propagate(C: "list[list[float]]", noise: "list[float]", n: int) -> "Covariance":
    """Upper triangle of C Sigma C^T, Sigma given as its own upper triangle by rows."""
    full = square(noise, n)

    def product(a: "list[float]", b: "list[float]") -> float:
        return sum([a[i] * full[i][j] * b[j] for i in range(n) for j in range(n)])

    c1, c2, c3 = C
    return product(c1, c1), product(c1, c2), product(c1, c3), product(c2, c2), product(c2, c3), product(c3, c3)


def square(noise: "Sequence[float]", n: int) -> "list[list[float]]":
    """The symmetric matrix whose upper triangle, by rows, is ``noise``."""
    full = [[0.0] * n for _ in range(n)]
    k = 0
    for i in range(n):
        for j in range(i, n):
            full[i][j] = full[j][i] = noise[k]
            k += 1
    return full
