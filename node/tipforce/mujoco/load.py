"""The load on one fingertip: the sum of its contacts as a wrench about the tip's site, in the site's axes."""

from __future__ import annotations

from math import hypot, sqrt

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.mujoco.contacts import Wrench

Vector = tuple[float, float, float]


class Load:
    """The load on one tip at one time step; vectors (3,) are along x, y and z of the site (``tipforce.mujoco.mjcf``).

    ``F_newtons`` are F1, F2, F3, equation (16) of the paper: all that the gauges see.
    """

    __slots__ = ("F_newtons", "_axes", "_rows", "_wrench")

    def __init__(self, axes: list[float], wrench: Wrench, r_m: float, strain_per_newton: list[Vector]) -> None:
        """``axes``: the site's rotation by rows."""
        a, b, c, d, e, f, g, h, i = self._axes = axes
        fx, fy, fz, mx, my, mz, _total, _count = self._wrench = wrench
        self.F_newtons: Vector = b * fx + e * fy + h * fz, (c * mx + f * my + i * mz) / r_m, a * fx + d * fy + g * fz
        self._rows = strain_per_newton

    @property
    def contacts(self) -> int:
        """Contacts on the tip."""
        return self._wrench[7]

    @property
    def sum_newtons(self) -> float:
        """The magnitudes of the contact forces, added up."""
        return self._wrench[6]

    @property
    def force_newtons(self) -> Vector:
        """The sum of the contact forces."""
        F = self.F_newtons
        c, f, i = self._axes[2::3]
        fx, fy, fz = self._wrench[:3]
        return F[2], F[0], c * fx + f * fy + i * fz

    @property
    def moment_newton_metres(self) -> Vector:
        """Their moment about the site."""
        a, b, c, d, e, f, g, h, i = self._axes
        mx, my, mz = self._wrench[3:6]
        return a * mx + d * my + g * mz, b * mx + e * my + h * mz, c * mx + f * my + i * mz

    @property
    def microstrain(self) -> list[float]:
        """The strain of each gauge, without offset and noise."""
        f1, f2, f3 = self.F_newtons
        return [1e6 * (c1 * f1 + c2 * f2 + c3 * f3) for c1, c2, c3 in self._rows]

    @property
    def P_newtons(self) -> float:
        """The force in the sensor's plane."""
        return hypot(self.F_newtons[0], self.F_newtons[2])

    @property
    def unseen_newtons(self) -> float:
        """The force out of the sensor's plane, along z, which the gauges do not see."""
        return abs(self.force_newtons[2])

    @property
    def unseen_newton_metres(self) -> float:
        """The moment about x and y, which the gauges do not see: of forces along z, and of contacts off the plane."""
        moment = self.moment_newton_metres
        return hypot(moment[0], moment[1])

    @property
    def cancelled_newtons(self) -> float:
        """By how much the magnitudes of several contact forces exceed that of their sum; the gauges see the sum."""
        x, y, z = self.force_newtons
        return max(0.0, self.sum_newtons - sqrt(x * x + y * y + z * z))
