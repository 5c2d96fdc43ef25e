"""The load on one fingertip: the sum of its contacts as a wrench about the tip's site, in the site's axes."""

from __future__ import annotations

from math import hypot, sqrt

Vector = tuple[float, float, float]


class Load:
    """The load on one tip at one time step.

    ``force_newtons`` is the sum of the contact forces on the tip, ``moment_newton_metres`` their moment about the site,
    both (3,) along x, y and z of the site (``tipforce.mujoco.mjcf``). ``F_newtons`` are F1, F2, F3, equation (16) of
    the paper: all that the gauges see. ``contacts`` counts the contacts, ``sum_newtons`` adds up their magnitudes.
    """

    __slots__ = (
        "F_newtons", "_axes", "_rows", "_wrench", "contacts", "force_newtons", "sum_newtons",
    )  # fmt: skip

    def __init__(
        self, axes: list[float], wrench: list[float], r_m: float, strain_per_newton: list[Vector], contacts: int
    ) -> None:
        """``axes``: the site's rotation by rows; ``wrench``: force, moment (both world) and the sum of magnitudes."""
        a, b, c, d, e, f, g, h, i = self._axes = axes
        fx, fy, fz, mx, my, mz, self.sum_newtons = self._wrench = wrench
        x, y = a * fx + d * fy + g * fz, b * fx + e * fy + h * fz
        self.force_newtons: Vector = x, y, c * fx + f * fy + i * fz
        self.F_newtons: Vector = y, (c * mx + f * my + i * mz) / r_m, x
        self.contacts = contacts
        self._rows = strain_per_newton

    @property
    def moment_newton_metres(self) -> Vector:
        """See the class."""
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
        return hypot(self.force_newtons[0], self.force_newtons[1])

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
