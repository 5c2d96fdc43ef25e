"""The elastic force at the gauges by the structure's modes (theory: ``tipforce.sensor.dynamics.first_order_hold``)."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from .simulated import Forces

    Vector = tuple[float, float, float]
    Hold = tuple[float, float, float, float, float, float, float, float]
    Coefficients = tuple[tuple[Vector, Hold, Vector], ...]


class DynamicLoad:
    """Modes at rest under zero load, for one step length. ``coefficients`` (``held.node_coefficients(modes, step_s)``)
    per mode: load row (3), p11, p12, p21, p22, start and end weights (8), F1, F2, F3 per modal position (3)."""

    def __init__(self, coefficients: "Coefficients") -> None:
        self.coefficients = coefficients
        self._positions = [0.0] * len(coefficients)
        self._velocities = [0.0] * len(coefficients)

    def settle(self, force: "Sequence[float]") -> None:
        """Start in equilibrium under a constant force (F1, F2, F3)."""
        f1, f2, f3 = force
        for k in range(len(self.coefficients)):
            row = self.coefficients[k][0]
            self._positions[k] = row[0] * f1 + row[1] * f2 + row[2] * f3
            self._velocities[k] = 0.0

    def step(self, force_start: "Sequence[float]", force_end: "Sequence[float]") -> "Vector":
        """Return the elastic force (F1, F2, F3) in newtons at the end of a step with a load from start to end."""
        a1, a2, a3 = force_start
        b1, b2, b3 = force_end
        f1 = f2 = f3 = 0.0
        for k in range(len(self.coefficients)):
            row, hold, column = self.coefficients[k]
            start = row[0] * a1 + row[1] * a2 + row[2] * a3
            end = row[0] * b1 + row[1] * b2 + row[2] * b3
            z, w = self._positions[k], self._velocities[k]
            z1 = hold[0] * z + hold[1] * w + hold[4] * start + hold[5] * end
            self._velocities[k] = hold[2] * z + hold[3] * w + hold[6] * start + hold[7] * end
            self._positions[k] = z1
            f1 += column[0] * z1
            f2 += column[1] * z1
            f3 += column[2] * z1
        return f1, f2, f3


class DynamicForces:
    """The elastic force under ``applied(now_us)``, linear within a step, in equilibrium at the first call. ``step_us``
    divides the sample period. All steps are computed: the force does not depend on how often the node reads."""

    def __init__(self, dynamics: "DynamicLoad", applied: "Callable[[int], Forces]", step_us: int) -> None:
        if step_us < 1:
            raise ValueError("step_us: %r, allowed is 1 or more" % step_us)
        self._dynamics = dynamics
        self._applied = applied
        self._step_us = step_us
        self._now_us = -1
        self._load: "Forces" = (0.0, 0.0, 0.0)
        self._force: "Forces" = (0.0, 0.0, 0.0)

    def __call__(self, now_us: int) -> "Forces":
        """Return F1, F2, F3 in newtons at the last step that is not after ``now_us``."""
        if self._now_us < 0:
            self._now_us = now_us
            self._load = self._force = self._applied(now_us)
            self._dynamics.settle(self._load)
        while self._now_us + self._step_us <= now_us:
            self._now_us += self._step_us
            load = self._applied(self._now_us)
            self._force = self._dynamics.step(self._load, load)
            self._load = load
        return self._force
