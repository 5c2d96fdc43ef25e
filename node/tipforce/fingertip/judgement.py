"""What the active calibration says of one sample: bits 12 to 15 of 2124h, gauges left out, uncertainty.
docs/objects.md, 2112h to 2116h and 2124h. The host judges recorded strains in the same way (host.decoding.judged)."""

from math import sqrt

from tipforce.dictionary import table
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.scalar_condition import dot

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .calibration import Active, Check, Covariance, Solver

RELEASE = 0.95  # of the overload force: an overload ends below
UNSTATED_KELVIN = 10.0  # standard uncertainty of a temperature that neither 2122h nor 2112h:3 and 4 tell
_CONTRADICTION = 1 << table.FAULT_CONTRADICTION
_BEYOND, _TEMPERATURE = 1 << table.FAULT_BEYOND_CALIBRATED, 1 << table.FAULT_TEMPERATURE
_OVERLOAD = 1 << table.FAULT_OVERLOAD


class Judgement:
    """One sample judged: ``bits`` 12 to 15 of 2124h; ``left_out``: the gauge that contradicts the others; ``solver``
    and ``force`` (newtons, before any tare) without it, None without rank 3 or agreement."""

    __slots__ = (
        "_active", "_extra", "_faults", "_kelvin", "_known_kelvin", "_lost", "_microstrains", "bits", "force",
        "left_out", "solver",
    )  # fmt: skip

    def __init__(
        self, active: "Active", microstrains: "list[float]", lost: int, temperature_degC: float, overloaded: bool
    ) -> None:
        """``microstrains`` as 6130h, ``lost`` the gauges left out already, ``temperature_degC``: NaN where unknown."""
        self._active, self._microstrains = active, microstrains
        self.bits = self.left_out = 0
        self.force: "tuple[float, float, float] | None" = None
        self._known_kelvin, self._kelvin, outside = difference(active, temperature_degC)
        if outside:
            self.bits = _TEMPERATURE
        self._lost = lost
        self._faults: "list[tuple[float, float]]" = []
        self._extra: "list[float] | None" = None
        solver, check = active.left.get(lost) or active.without(lost)
        if solver is not None and check is not None:
            solver = self._judge_gauges(check, solver)
        self.solver = solver
        if solver is None:
            return
        self.force = active.force(solver[0], microstrains, self._known_kelvin)
        calibrated, overload = active.forces
        if calibrated > 0.0 or overload > 0.0:
            P = magnitude(self.force)
            if calibrated > 0.0 and P > calibrated:
                self.bits |= _BEYOND
            if overload > 0.0 and P > (RELEASE * overload if overloaded else overload):
                self.bits |= _OVERLOAD

    @property
    def strains(self) -> "list[float]":
        """Of the gauges, offsets and temperature taken off."""
        return self._active.strains(self._microstrains, self._known_kelvin)

    def _judge_gauges(self, check: "Check", whole: "Solver") -> "Solver | None":
        """Set bit 12 where the gauges contradict each other, leave out the one that explains it; return what solves."""
        active = self._active
        model, strains = active.model, self.strains
        if model > 0.0:
            self._extra = [(model * s) * (model * s) for s in strains]
        bits, faults = _judged(check, strains, self._extra)
        if bits < 0:
            self._faults = faults
            return whole
        self.bits |= _CONTRADICTION
        # One bit alone; of four gauges the three that would be left cannot be checked.
        gauge = bits if bits & (bits - 1) == 0 and len(check[0]) > 1 else 0
        solver, rest = active.without(self._lost | gauge) if gauge else (None, None)
        if solver is None or rest is None:
            return None
        bits, faults = _judged(rest, strains, self._extra)
        if bits >= 0:
            return None
        self.left_out, self._faults = gauge, faults
        return solver

    def covariance(self) -> "Covariance":
        """Covariance of F, N^2: gauge noise, model, a temperature that is not compensated, a fault below the limit."""
        active, solver, force = self._active, self.solver, self.force
        if solver is None or force is None:
            return (scalar.NAN,) * 6
        matrix, (k11, k12, k13, k22, k23, k33) = solver
        model, parts = active.model, []  # vectors F, of each F F^T is added
        if model > 0.0:
            if self.bits & _BEYOND:  # what is not linear grows with the force, relative to it
                model *= magnitude(force) / active.forces[0]
            row1, row2, row3 = matrix
            parts = [
                (model * v * a, model * v * b, model * v * c)
                for v, a, b, c in zip(self.strains, row1, row2, row3)  # noqa: B905
            ]
        if self._kelvin > 0.0:
            moved = [active.gain_per_kelvin * f for f in force]
            if active.per_kelvin is not None:
                moved = [m + dot(row, active.per_kelvin) for m, row in zip(moved, matrix)]  # noqa: B905
            parts.append((self._kelvin * moved[0], self._kelvin * moved[1], self._kelvin * moved[2]))
        for f1, f2, f3 in parts:
            k11, k12, k13 = k11 + f1 * f1, k12 + f1 * f2, k13 + f1 * f3
            k22, k23, k33 = k22 + f2 * f2, k23 + f2 * f3, k33 + f3 * f3
        if self._faults:
            from tipforce.sensor.contact import scalar_redundancy  # a node with three gauges does without

            d11, d12, d13, d22, d23, d33 = scalar_redundancy.doubt(matrix, active.noise, self._faults)
            return k11 + d11, k12 + d12, k13 + d13, k22 + d22, k23 + d23, k33 + d33
        return k11, k12, k13, k22, k23, k33


def difference(active: "Active", temperature_degC: float) -> "tuple[float, float, bool]":
    """(kelvin to compensate, kelvin left as uncertainty, bit 14), NaN: not known. A needed temperature that is unknown
    is uniform in the calibrated range; beyond the range the distance is left as uncertainty."""
    low, high = active.range_degC
    ranged = low != 0.0 or high != 0.0
    if temperature_degC - temperature_degC == 0.0:
        kelvin = temperature_degC - active.reference_degC
        beyond = max(low - temperature_degC, temperature_degC - high, 0.0) if ranged else 0.0
        if 1.0 + active.gain_per_kelvin * kelvin > 0.0:
            return (kelvin if active.compensated else 0.0), beyond, beyond > 0.0
    if not active.compensated:
        return 0.0, 0.0, False
    if not ranged:
        return 0.0, UNSTATED_KELVIN, True
    a, b = low - active.reference_degC, high - active.reference_degC
    return 0.0, sqrt((a * a + a * b + b * b) / 3.0), True


def magnitude(force: "tuple[float, float, float]") -> float:
    """P as ``scalar.contact`` gives it, without the angles."""
    f1, f2, f3 = force
    hypotenuse = sqrt(f1 * f1 + f3 * f3)
    return max(hypotenuse, 0.5 * (hypotenuse + abs(f2)))


def _judged(check: "Check", V: "list[float]", extra: "list[float] | None") -> "tuple[int, list[tuple[float, float]]]":
    from tipforce.sensor.contact import scalar_redundancy  # a node with three gauges does without

    W, shown, alarm, exclusion = check
    _chi_square, bits, faults = scalar_redundancy.judge(W, shown, V, extra, alarm, exclusion)
    return bits, faults
