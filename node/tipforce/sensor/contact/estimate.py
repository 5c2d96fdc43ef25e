"""Contacts of many samples: the formulas of scalar*.py, operation by operation, for columns: F1, F2, F3 and the six
different elements of the covariance of F, each an array of the same shape (or a number)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.contact import scalar


def force_vector(P_newtons: npt.ArrayLike, phi_rad: npt.ArrayLike, theta_rad: npt.ArrayLike) -> FloatArray:
    """Return F = (P sin(phi), P sin(phi - theta), P cos(phi)), (..., 3), newtons: equation (16). phi: direction of the
    force on the tip, theta: angle of the contact on it. Raises InputError where the shapes do not broadcast."""
    P, phi, theta = floats("P", P_newtons), floats("phi", phi_rad), floats("theta", theta_rad)
    try:
        P, phi, theta = np.broadcast_arrays(P, phi, theta)
    except ValueError:
        raise InputError(
            f"P {P.shape}, phi {phi.shape}, theta {theta.shape}: allowed are shapes that broadcast together"
        ) from None
    with np.errstate(invalid="ignore", over="ignore"):
        return np.stack((P * np.sin(phi), P * np.sin(phi - theta), P * np.cos(phi)), axis=-1)


def force_from_strain(
    C: npt.ArrayLike, strain: npt.ArrayLike, offset_strain: npt.ArrayLike = 0.0, tare_newtons: npt.ArrayLike = 0.0
) -> FloatArray:
    """Return F = C (strain - offset) - tare in newtons, (..., 3): equation (1). C: (3, n), N per strain; strain: (...,
    n), a row with NaN or infinity gives no other; offset: (n,); tare: (3,). Raises InputError for other shapes."""
    matrix, V = floats("C", C), floats("strain", strain)
    offset, tare = floats("offset_strain", offset_strain), floats("tare", tare_newtons)
    if matrix.ndim != 2 or matrix.shape[0] != 3:
        raise InputError(f"C has the shape {matrix.shape}: allowed is (3, n), n gauges")
    n = matrix.shape[1]
    if V.ndim < 1 or V.shape[-1] != n:
        raise InputError(f"strain has the shape {V.shape}: allowed is (..., {n}), as C has {n} columns")
    if offset.shape not in {(), (n,)}:
        raise InputError(f"offset_strain has the shape {offset.shape}: allowed is ({n},) or a scalar")
    if tare.shape not in {(), (3,)}:
        raise InputError(f"tare_newtons has the shape {tare.shape}: allowed is (3,) or a scalar")
    with np.errstate(invalid="ignore", over="ignore"):
        return (V - offset) @ matrix.T - tare


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Contacts of n samples; every array has the shape (n,), or (...) for forces of shape (..., 3). NaN means unknown:
    all five for a force that is not finite, the angles if F1 = F3 = 0."""

    P_newtons: FloatArray
    """Magnitude of the force, at least zero."""
    phi_rad: FloatArray
    """Direction of the force on the tip, in (-pi, pi]."""
    theta_rad: FloatArray
    """Angle of the contact on the tip, in (-pi, pi]."""
    delta_rad: FloatArray
    """phi - theta, in (-pi, pi]: at most pi/2 in size for a pull, at least pi/2 for a push."""
    miss_newtons: FloatArray
    """Excess of |F2| over hypot(F1, F3), else zero: above zero the contact was taken as tangential."""


class Forces(NamedTuple):
    """Forces as columns, divided by a power of two so that their squares stay in range."""

    F1: FloatArray
    """Newtons; NaN where a component is not finite, and never -0.0, which would turn arctan2 to -pi."""
    F3: FloatArray
    f1: FloatArray
    """F1 / unit; f2 and f3 likewise."""
    f2: FloatArray
    f3: FloatArray
    unit: FloatArray
    hypotenuse: FloatArray
    """Of f1 and f3."""
    cosine: FloatArray
    """hypotenuse |cos(delta)|, as in scalar.contact()."""
    excess: FloatArray
    """|f2| - hypotenuse, or zero."""

    def take(self, rows: npt.NDArray[Any]) -> Forces:
        """Some rows of forces (m,)."""
        return Forces(*(column[rows] for column in self))


class Covariance(NamedTuple):
    """Covariances of F divided by root^2, a power of four; NaN in k11 where one is unusable."""

    k11: FloatArray
    k12: FloatArray
    k13: FloatArray
    k22: FloatArray
    k23: FloatArray
    k33: FloatArray
    root: FloatArray

    def take(self, rows: npt.NDArray[Any]) -> Covariance:
        """Those of some rows; one for all rows stays."""
        return Covariance(*(column[rows] if np.ndim(column) else column for column in self))


class Deviations(NamedTuple):
    """Standard uncertainties as columns."""

    P: FloatArray
    phi: FloatArray
    theta: FloatArray
    sine: FloatArray
    """Of F2 / P, to first order."""


def forces(F1: FloatArray, F2: FloatArray, F3: FloatArray) -> Forces:
    """Return what contact and uncertainty are computed from, of forces in newtons."""
    with np.errstate(invalid="ignore", over="ignore"):
        a1, a2, a3 = np.abs(F1), np.abs(F2), np.abs(F3)
        unit = _power_of_two(np.frexp(np.maximum(np.maximum(a1, a2), a3))[1])
        down = 1.0 / unit
        a1, a2, a3 = a1 * down, a2 * down, a3 * down
        total = a1 + a2 + a3
        nothing = total - total  # 0.0, or NaN
        large, small = np.maximum(a1, a3), np.minimum(a1, a3)
        across = small * small + nothing
        hypotenuse = np.sqrt(large * large + across)
        cosine_squared = (large - a2) * (large + a2) + across
        excess = np.maximum(-cosine_squared, 0.0)
        if excess.any():
            excess = excess / np.where(excess > 0.0, a2 + hypotenuse, 1.0)
        cosine = np.sqrt(np.maximum(cosine_squared, 0.0))
        return Forces(F1 + nothing, F3, F1 * down, F2 * down + nothing, F3 * down, unit, hypotenuse, cosine, excess)


def covariances(elements: Sequence[Any]) -> Covariance:
    """Return the covariances with elements 11, 12, 13, 22, 23, 33, N^2; NaN if not finite, or a variance is below 0."""
    k11, _, _, k22, _, k33 = elements
    with np.errstate(invalid="ignore", over="ignore"):
        largest = np.maximum(np.maximum(np.maximum(k11, k22), k33), 0.0)
        half = (np.frexp(largest)[1] + 1) // 2
        root = _power_of_two(half, 500)
        down = _power_of_two(-2 * half)
        k11, k12, k13, k22, k23, k33 = (np.asarray(element * down) for element in elements)
        total = k11 + k12 + k13 + k22 + k23 + k33
        nothing = np.where(np.minimum(np.minimum(k11, k22), k33) < 0.0, np.nan, total - total)
    return Covariance(k11 + nothing, k12, k13, k22, k23, k33, root)


def contact_columns(F: Forces, sense: FloatArray | float) -> Contact:
    """Return the contacts; sense: 1.0 for a pull, -1.0 for a push."""
    with np.errstate(over="ignore"):
        P, miss = (F.hypotenuse + 0.5 * F.excess) * F.unit, F.excess * F.unit
    phi, delta = _angle(F.F1, F.F3), _angle(F.f2, sense * F.cosine)
    undirected = (F.F1 == 0.0) & (F.F3 == 0.0)
    if undirected.any():
        phi, delta = np.where(undirected, np.nan, (phi, delta))
    return Contact(P, phi, _wrapped(phi - delta), delta, miss)


def deviation_columns(F: Forces, K: Covariance, sense: FloatArray | float) -> Deviations:
    """Return the standard uncertainties of the contacts, as scalar_uncertainty.uncertainty()."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        n1, n3 = F.f1 / F.hypotenuse, F.f3 / F.hypotenuse
        P = np.maximum(F.hypotenuse, 0.5 * (F.hypotenuse + np.abs(F.f2)))
        x = np.minimum(np.maximum(F.f2 / F.hypotenuse, -1.0), 1.0)
        g1, g3 = -x * n1, -x * n3
        down = 1.0 / F.unit
        u_sine = _deviation(K, g1, 1.0, g3) / P * K.root * down
        slope = sense * _finite_slope(np.abs(x), F.cosine / F.hypotenuse, u_sine)
        u_P = _deviation(K, n1, 0.0, n3)
        zero = F.hypotenuse == 0.0
        if zero.any():
            u_P = np.where(zero, _worst_deviation(K), u_P)
        u_phi = _deviation(K, n3, 0.0, -n1) / P * K.root * down
        u_theta = _deviation(K, n3 - slope * g1, -slope, -n1 - slope * g3) / P * K.root * down
        return Deviations(u_P * K.root, u_phi, u_theta, u_sine)


def miss_deviation(F: Forces, K: Covariance) -> FloatArray:
    """Return the standard uncertainties of |F2| - hypot(F1, F3), as scalar_uncertainty.miss_uncertainty()."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sign = np.where(F.f2 < 0.0, -1.0, 1.0)
        u = _deviation(K, -F.f1 / F.hypotenuse, sign, -F.f3 / F.hypotenuse)
        bound = _worst_deviation(K) + np.sqrt(np.maximum(K.k22, 0.0))
        return np.where(F.hypotenuse == 0.0, bound, u) * K.root


def contacts(F_newtons: npt.ArrayLike, *, pull: bool) -> Contact:
    """Return the contacts of forces (..., 3), newtons, as scalar.contact(): the inverse of equation (16). pull: the
    load pulls at the surface (a rope), else it pushes (a contact). Raises InputError where the last axis is not 3."""
    return contact_columns(checked_forces(F_newtons), 1.0 if pull else -1.0)


def standard_uncertainties(F_newtons: npt.ArrayLike, covariance_F: npt.ArrayLike, *, pull: bool) -> FloatArray:
    """Return the standard uncertainties of P, phi, theta, (..., 3), N and rad, as scalar.uncertainty(); NaN for bad
    numbers. F: (..., 3); covariance_F: (3, 3) or (..., 3, 3), N^2. Raises InputError for other shapes."""
    F = checked_forces(F_newtons)
    u = deviation_columns(F, checked_covariances(covariance_F, F_newtons), 1.0 if pull else -1.0)
    return np.stack(u[:3], axis=-1)


def checked_forces(F_newtons: npt.ArrayLike) -> Forces:
    """Return forces() of F (..., 3). Raises InputError for another shape."""
    F = floats("F", F_newtons)
    if F.ndim < 1 or F.shape[-1] != 3:
        raise InputError(f"F has the shape {F.shape}: allowed is (..., 3), newtons")
    return forces(F[..., 0], F[..., 1], F[..., 2])


def checked_covariances(covariance_F: npt.ArrayLike, F_newtons: npt.ArrayLike) -> Covariance:
    """Return covariances() of one for all forces, or of one each. Raises InputError for another shape."""
    K, shape = floats("covariance_F", covariance_F), np.shape(F_newtons)
    if K.shape not in {(3, 3), (*shape, 3)}:
        raise InputError(f"covariance_F has the shape {K.shape}: allowed is (3, 3) or {(*shape, 3)}")
    return covariances([K[..., i, j] for i in range(3) for j in range(i, 3)])


def _power_of_two(exponent: npt.NDArray[np.integer[Any]], most: int = 1000) -> FloatArray:
    """2^exponent, of ``most`` in size: then its inverse is exact, too, and what is scaled by it far from any border."""
    power: FloatArray = np.ldexp(1.0, np.minimum(np.maximum(exponent, -most), most))
    return power


def _angle(y: FloatArray, x: FloatArray) -> FloatArray:
    angle_rad: FloatArray = np.arctan2(y, x)
    least = angle_rad <= -np.pi
    return np.where(least, np.pi, angle_rad) if least.any() else angle_rad


def _wrapped(angle_rad: FloatArray) -> FloatArray:
    down = np.where(angle_rad > np.pi, angle_rad - scalar.TWO_PI, angle_rad)
    return np.where(down <= -np.pi, down + scalar.TWO_PI, down)


def _deviation(K: Covariance, g1: FloatArray, g2: FloatArray | float, g3: FloatArray) -> FloatArray:
    variance = (
        g1 * (K.k11 * g1 + 2.0 * (K.k12 * g2 + K.k13 * g3)) + g2 * (K.k22 * g2 + 2.0 * K.k23 * g3) + g3 * K.k33 * g3
    )
    return np.sqrt(np.maximum(variance, 0.0))


def _worst_deviation(K: Covariance) -> FloatArray:
    difference = 0.5 * (K.k11 - K.k33)
    radius = np.sqrt(difference * difference + K.k13 * K.k13)
    return np.sqrt(np.maximum(0.5 * (K.k11 + K.k33) + radius, 0.0))


def _finite_slope(x: FloatArray, cosine: FloatArray, step: FloatArray) -> FloatArray:
    """Return the slope of asin over one standard uncertainty, as in scalar_uncertainty."""
    inward = _arc(x, cosine, -np.minimum(step, 1.0 + x))
    outward = _arc(x, cosine, np.minimum(step, cosine * cosine / (1.0 + x)))
    chords = np.sqrt(0.5 * (inward * inward + outward * outward)) / step
    known = step < scalar.SMALLEST_STEP
    return np.where(known, 1.0 / np.maximum(cosine, scalar.SMALLEST_COSINE), chords) if known.any() else chords


def _arc(x: FloatArray, cosine: FloatArray, step: FloatArray) -> FloatArray:
    span = 2.0 * x + step
    other = np.sqrt(np.maximum(cosine * cosine - step * span, 0.0))
    total = cosine + other
    ratio = span / np.where(total > 0.0, total, np.inf)
    return 2.0 * np.arcsin(np.minimum(0.5 * np.abs(step) * np.sqrt(1.0 + ratio * ratio), 1.0))
