"""Convex surfaces on which a wrench has a contact centroid: sphere, ellipsoid, cylinder, half-plane.

The contact-centroid problem (Bicchi, Salisbury and Brock, Int. J. Robotics Research 12, 1993): a force f and a moment
m about the origin come from one soft-finger contact that pushes: m = c x f + k grad g(c), with the centroid c on the
surface g(c) = 0 and f against its outward normal grad g. k grad g is the torque about the normal. Each surface here has
a closed form that divides neither by f . m, which is zero for every load in a plane, nor by k.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite, pi
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError
from tipforce.sensor.contact.estimate import contacts

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


class Centroid(NamedTuple):
    """A solution of the contact-centroid problem; NaN where there is none."""

    c_m: FloatArray
    """(..., 3)."""
    k: FloatArray
    """(...): multiplier of grad g."""


class Surface(Protocol):
    """What wrench.py asks of a surface. f: (..., 3) newtons, m: (..., 3) newton metres, c: (..., 3) metres."""

    @property
    def size_m(self) -> float:
        """A typical radius, to scale with."""

    def solve(self, f: FloatArray, m: FloatArray) -> Centroid:
        """The centroid of a push."""

    def gradient(self, c: FloatArray) -> FloatArray:
        """grad g, outward, (..., 3)."""

    def hessian(self) -> FloatArray:
        """The second derivatives of g, (3, 3): all surfaces here are quadrics."""

    def excess(self, f: FloatArray, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """By how much the load misses the surface (negative: it does not), newtons, (...), and its gradient by
        (f, m), (..., 6)."""

    def outside(self, c: FloatArray) -> BoolArray:
        """Whether a centroid lies beyond the part of the surface that may be touched, (...)."""


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """x^2 / a^2 + y^2 / b^2 + z^2 / c^2 = 1. Raises InputError for axes that are not positive."""

    semi_axes_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        for axis in self.semi_axes_m:
            _check_positive("semi_axes_m", axis)

    @property
    def size_m(self) -> float:
        """The geometric mean of the semi-axes."""
        return float(np.prod(self.semi_axes_m) ** (1.0 / 3.0))

    def solve(self, f: FloatArray, m: FloatArray) -> Centroid:
        """The unit sphere's solution u, stretched: in u = c / axes the ellipsoid's problem is the sphere's.

        On the unit sphere k u + u x f = m. Its length and its products with f and u give |m|^2 = f^2 - s^2 + k^2
        and f . m = k s for s = u . f, a quadratic for s^2 whose root for a push is s = -|s|; then
        u = (k m + s f + f x m) / (k^2 + f^2).
        """
        f, m = self._unit_sphere(f, m)
        along = np.sum(f * m, axis=-1)
        difference = _difference_of_squares(f, m)
        root = np.hypot(difference, 2.0 * along)
        larger = 0.5 * (np.abs(difference) + root)
        with np.errstate(divide="ignore", invalid="ignore"):
            smaller = np.where(larger > 0.0, along * along / larger, 0.0)
            s = -np.sqrt(np.where(difference >= 0.0, larger, smaller))
            k = np.copysign(np.sqrt(np.where(difference >= 0.0, smaller, larger)), -along)
            total = k * k + np.sum(f * f, axis=-1)
            u = k[..., np.newaxis] * m + s[..., np.newaxis] * f + np.cross(f, m)
            u = np.where(total[..., np.newaxis] > 0.0, u / total[..., np.newaxis], np.nan)
        return Centroid(u * np.array(self.semi_axes_m), np.where(total > 0.0, k, np.nan))

    def gradient(self, c: FloatArray) -> FloatArray:
        """c / axes^2 (g is half of what the equation says)."""
        return c / np.square(self.semi_axes_m)

    def hessian(self) -> FloatArray:
        """diag(1 / axes^2)."""
        return np.diag(1.0 / np.square(self.semi_axes_m))

    def excess(self, f: FloatArray, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """|m| - |f| on the unit sphere, in newtons: above zero the torque arm about the normal exceeds the radius.

        On a planar load that is |F2| - P; no friction can hold such a torque, so the load misses the tip.
        """
        axes, volume = np.array(self.semi_axes_m), float(np.prod(self.semi_axes_m))
        unit = self.size_m**2
        f, m = self._unit_sphere(f, m)
        length_f, length_m = np.linalg.norm(f, axis=-1), np.linalg.norm(m, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_f = -np.where(length_f[..., np.newaxis] > 0.0, f / length_f[..., np.newaxis], 0.0) * (volume / axes)
            by_m = np.where(length_m[..., np.newaxis] > 0.0, m / length_m[..., np.newaxis], 0.0) * axes
        return (length_m - length_f) / unit, np.concatenate([by_f, by_m], axis=-1) / unit

    def outside(self, c: FloatArray) -> BoolArray:
        """Nowhere."""
        return np.zeros(c.shape[:-1], dtype=np.bool_)

    def _unit_sphere(self, f: FloatArray, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        axes, volume = np.array(self.semi_axes_m), float(np.prod(self.semi_axes_m))
        return f * (volume / axes), m * axes


def sphere(radius_m: float) -> Ellipsoid:
    """Return a sphere about the origin. Raises InputError for a radius that is not positive."""
    return Ellipsoid((radius_m, radius_m, radius_m))


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder about the z-axis: the paper's tip, in three dimensions. Raises InputError for unusable sizes."""

    radius_m: float
    half_length_m: float = inf
    theta_min_rad: float = 0.0
    theta_max_rad: float = 2.0 * pi
    """The pad: theta = atan2(y, x) of the contact."""

    def __post_init__(self) -> None:
        _check_positive("radius_m", self.radius_m)
        if not self.half_length_m > 0.0:
            raise InputError(f"half_length_m = {self.half_length_m!r}: allowed is a positive number")
        if not self.theta_min_rad <= self.theta_max_rad:
            raise InputError(f"theta_min_rad = {self.theta_min_rad!r}: allowed is at most {self.theta_max_rad!r}")

    @property
    def size_m(self) -> float:
        """The radius."""
        return self.radius_m

    def solve(self, f: FloatArray, m: FloatArray) -> Centroid:
        """The planar estimator gives theta; then m_x and m_y give z and the torque, linearly."""
        theta = contacts(self._planar(f, m), pull=False).theta_rad
        ux, uy = np.cos(theta), np.sin(theta)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (ux * m[..., 1] - uy * m[..., 0] + self.radius_m * f[..., 2]) / (ux * f[..., 0] + uy * f[..., 1])
            z = np.where(np.isfinite(z), z, np.nan)
        right_x = m[..., 0] - self.radius_m * uy * f[..., 2] + z * f[..., 1]
        right_y = m[..., 1] + self.radius_m * ux * f[..., 2] - z * f[..., 0]
        return Centroid(np.stack([self.radius_m * ux, self.radius_m * uy, z], axis=-1), ux * right_x + uy * right_y)

    def gradient(self, c: FloatArray) -> FloatArray:
        """(x, y, 0) / radius."""
        return c * (np.array([1.0, 1.0, 0.0]) / self.radius_m)

    def hessian(self) -> FloatArray:
        """diag(1, 1, 0) / radius."""
        return np.diag([1.0, 1.0, 0.0]) / self.radius_m

    def excess(self, f: FloatArray, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """|F2| - hypot(F1, F3), as on the planar tip: no torque about the normal has a part along the axis."""
        F = self._planar(f, m)
        P, sign = np.hypot(F[..., 0], F[..., 2]), np.where(F[..., 1] < 0.0, -1.0, 1.0)
        zero = np.zeros_like(P)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_x, by_y = (np.where(P > 0.0, -f[..., axis] / P, 0.0) for axis in (0, 1))
        gradient = np.stack([by_x, by_y, zero, zero, zero, sign / self.radius_m], axis=-1)
        return np.abs(F[..., 1]) - P, gradient

    def outside(self, c: FloatArray) -> BoolArray:
        """Beyond the ends of the cylinder or of the pad."""
        theta = np.arctan2(c[..., 1], c[..., 0])
        beyond: BoolArray = (theta - self.theta_min_rad) % (2.0 * pi) > self.theta_max_rad - self.theta_min_rad
        result: BoolArray = beyond | (np.abs(c[..., 2]) > self.half_length_m)
        return result

    def _planar(self, f: FloatArray, m: FloatArray) -> FloatArray:
        """F of equation (16)."""
        return np.stack([f[..., 1], m[..., 2] / self.radius_m, f[..., 0]], axis=-1)


@dataclass(frozen=True, slots=True)
class HalfPlane:
    """The flat n . c = distance, which may be touched where edge . c <= reach. n and edge: unit vectors.

    Raises InputError for vectors that are not of unit length, or an edge that is not across n.
    """

    normal: tuple[float, float, float]
    distance_m: float
    edge: tuple[float, float, float] | None = None
    reach_m: float = 0.0

    def __post_init__(self) -> None:
        for name, vector in (("normal", self.normal), ("edge", self.normal if self.edge is None else self.edge)):
            if not abs(float(np.linalg.norm(vector)) - 1.0) < 1e-9:
                raise InputError(f"{name} = {vector!r}: allowed is a vector of length 1")
        if self.edge is not None and abs(float(np.dot(self.normal, self.edge))) > 1e-9:
            raise InputError(f"edge = {self.edge!r}: allowed is a vector across the normal {self.normal!r}")
        if not (isfinite(self.distance_m) and isfinite(self.reach_m)):
            raise InputError(
                f"distance_m = {self.distance_m!r}, reach_m = {self.reach_m!r}: allowed are finite numbers"
            )

    @property
    def size_m(self) -> float:
        """The distance from the origin; a millimetre for a plane through it."""
        return max(abs(self.distance_m), 1e-3)

    def solve(self, f: FloatArray, m: FloatArray) -> Centroid:
        """The moment across the normal is linear in the centroid."""
        n = np.array(self.normal)
        press = np.sum(f * n, axis=-1)
        along = self.distance_m * n
        with np.errstate(divide="ignore", invalid="ignore"):
            c = along + np.cross(n, m - np.cross(along, f)) / press[..., np.newaxis]
            c = np.where((press < 0.0)[..., np.newaxis], c, np.nan)
        return Centroid(c, np.sum((m - np.cross(c, f)) * n, axis=-1))

    def gradient(self, c: FloatArray) -> FloatArray:
        """n."""
        return np.broadcast_to(np.array(self.normal), c.shape)

    def hessian(self) -> FloatArray:
        """Zero."""
        return np.zeros((3, 3))

    def excess(self, f: FloatArray, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """f . n: a force that pulls at the plane does not come from a push."""
        gradient = np.broadcast_to(np.array([*self.normal, 0.0, 0.0, 0.0]), (*m.shape[:-1], 6))
        return np.sum(f * np.array(self.normal), axis=-1), gradient

    def outside(self, c: FloatArray) -> BoolArray:
        """Beyond the edge."""
        if self.edge is None:
            return np.zeros(c.shape[:-1], dtype=np.bool_)
        result: BoolArray = np.sum(c * np.array(self.edge), axis=-1) > self.reach_m
        return result


def _difference_of_squares(f: FloatArray, m: FloatArray) -> FloatArray:
    """|f|^2 - |m|^2, exact where both are nearly equal and one part of f is most of it, as in contact.py."""
    parts = np.sort(np.abs(f), axis=-1)
    length = np.linalg.norm(m, axis=-1)
    large = parts[..., 2]
    result: FloatArray = (large - length) * (large + length) + parts[..., 1] ** 2 + parts[..., 0] ** 2
    return result


def _check_positive(name: str, value: float) -> None:
    if not 0.0 < value < inf:
        raise InputError(f"{name} = {value!r}: allowed is a positive finite number of metres")
