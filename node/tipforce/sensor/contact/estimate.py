"""Contacts of many samples: strain to force to contact, uncertainty, status, and where first order holds.

The formulas of scalar.py for numpy arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray, floats
from tipforce.errors import InputError
from tipforce.sensor.contact import scalar


def force_vector(P_newtons: npt.ArrayLike, phi_rad: npt.ArrayLike, theta_rad: npt.ArrayLike) -> FloatArray:
    """Return F = (P sin(phi), P sin(phi - theta), P cos(phi)) in newtons, shape (..., 3): equation (16).

    The three arguments broadcast against each other to the shape (...). phi is the direction of the force on
    the tip, theta the angle of the contact on it, both from the x-axis. Raises InputError where the shapes do
    not broadcast.
    """
    P, phi, theta = floats("P", P_newtons), floats("phi", phi_rad), floats("theta", theta_rad)
    try:
        P, phi, theta = np.broadcast_arrays(P, phi, theta)
    except ValueError:
        raise InputError(
            f"P {P.shape}, phi {phi.shape}, theta {theta.shape}: allowed are shapes that broadcast together"
        ) from None
    F: FloatArray = np.stack((P * np.sin(phi), P * np.sin(phi - theta), P * np.cos(phi)), axis=-1)
    return F


def force_from_strain(
    C: npt.ArrayLike,
    strain: npt.ArrayLike,
    offset_strain: npt.ArrayLike = 0.0,
    tare_newtons: npt.ArrayLike = 0.0,
) -> FloatArray:
    """Return F = C (strain - offset) - tare in newtons, shape (..., 3): equation (1) with offset and tare.

    C: (3, n), newtons per unit strain. strain: (..., n). offset_strain: (n,) or a scalar. tare_newtons: (3,)
    or a scalar. NaN or infinity in a strain makes that row NaN or infinite, no other. Raises InputError where
    the shapes do not fit.
    """
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
        F: FloatArray = (V - offset) @ matrix.T - tare
    return F


StatusArray = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Contacts of n samples; every array has the shape (n,), or (...) for forces of shape (..., 3).

    NaN means unknown: all five for a force that is not finite, the angles if F1 = F3 = 0.
    """

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


class Limits(NamedTuple):
    """Input of a status; a plain tuple of the same order is the input of scalar.status_bits()."""

    contact_on_newtons: float
    contact_off_newtons: float
    theta_min_deg: float
    theta_max_deg: float


def contacts(F_newtons: npt.ArrayLike, *, pull: bool) -> Contact:
    """Return the contacts of forces F of shape (..., 3), newtons: the inverse of equation (16).

    pull: True for a load that pulls at the surface (a rope), False for one that pushes (a contact). Loads
    from 1e-300 to 1e300 N keep full precision. P = (hypot + |F2|) / 2 where the line of action misses the
    tip. Raises InputError where the last axis is not 3; numbers that are not finite give NaN, never an error.
    """
    F, finite = _forces(F_newtons)
    f, exponent = _scaled(F)
    hypotenuse, cosine, excess = _triangle(f)
    # One factor less than the exponent, twice: the largest floats would overflow in 2 ** exponent.
    unit = np.ldexp(1.0, exponent - 1)
    with np.errstate(over="ignore"):
        P = (2.0 * hypotenuse + excess) * unit
        miss = 2.0 * excess * unit
    # Adding zero turns -0.0 into 0.0, which keeps arctan2 away from -pi.
    phi = _wrapped(np.arctan2(F[..., 0] + 0.0, F[..., 2]))
    delta = _wrapped(np.arctan2(f[..., 1] + 0.0, cosine if pull else -cosine))
    theta = _wrapped(phi - delta)
    directed = finite & ((F[..., 0] != 0.0) | (F[..., 2] != 0.0))
    return Contact(
        P_newtons=np.where(finite, P, np.nan),
        phi_rad=np.where(directed, phi, np.nan),
        theta_rad=np.where(directed, theta, np.nan),
        delta_rad=np.where(directed, delta, np.nan),
        miss_newtons=np.where(finite, miss, np.nan),
    )


def estimate(
    C: npt.ArrayLike,
    strain: npt.ArrayLike,
    offset_strain: npt.ArrayLike = 0.0,
    tare_newtons: npt.ArrayLike = 0.0,
    *,
    pull: bool,
) -> tuple[FloatArray, Contact]:
    """Return (F, contacts) of gauge readings: force_from_strain(), then contacts().

    C: (3, n) newtons per unit strain; strain: (..., n); offset_strain: (n,); tare_newtons: (3,). F: (..., 3)
    newtons. Raises InputError where the shapes do not fit. For forces alone, force_from_strain() avoids the
    computation of angles.
    """
    F = force_from_strain(C, strain, offset_strain, tare_newtons)
    return F, contacts(F, pull=pull)


def standard_uncertainties(F_newtons: npt.ArrayLike, covariance_F: npt.ArrayLike, *, pull: bool) -> FloatArray:
    """Return the standard uncertainties of P, phi, theta: shape (..., 3), in newtons, radians, radians.

    F: (..., 3); covariance_F: (3, 3) or (..., 3, 3), symmetric, N^2. First order, but for the near-tangent
    correction that scalar.uncertainty() describes. F1 = F3 = 0: u_P for the worst direction, the angles NaN.
    Numbers that are not finite, and variances below zero, give NaN. Raises InputError for other shapes.
    """
    F, finite = _forces(F_newtons)
    covariance, known = _covariances(covariance_F, F)
    f, exponent = _scaled(F)
    hypotenuse, cosine, _ = _triangle(f)
    K, half = _scaled_covariance(covariance)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        n1, n3 = f[..., 0] / hypotenuse, f[..., 2] / hypotenuse
        zero, one = np.zeros_like(n1), np.ones_like(n1)
        P = np.maximum(hypotenuse, 0.5 * (hypotenuse + np.abs(f[..., 1])))
        x = np.clip(f[..., 1] / hypotenuse, -1.0, 1.0)
        g1, g3 = -x * n1, -x * n3
        step = _times_power(_deviation(K, g1, one, g3) / P, half - exponent)
        slope = _finite_slope(np.abs(x), cosine / hypotenuse, step) * (1.0 if pull else -1.0)
        u_P = np.where(hypotenuse == 0.0, _worst_deviation(K), _deviation(K, n1, zero, n3))
        u_phi = _deviation(K, n3, zero, -n1) / P
        u_theta = _deviation(K, n3 - slope * g1, -slope, -n1 - slope * g3) / P
        angles = [_times_power(u, half - exponent) for u in (u_phi, u_theta)]
        result = np.stack([_times_power(u_P, half), *angles], axis=-1)
    result[~(finite & known)] = np.nan
    return result


def miss_uncertainties(F_newtons: npt.ArrayLike, covariance_F: npt.ArrayLike) -> FloatArray:
    """Return the standard uncertainty of |F2| - hypot(F1, F3) in newtons, shape (...).

    F: (..., 3); covariance_F: (3, 3) or (..., 3, 3), N^2. F1 = F3 = 0: the largest value that any direction
    and correlation can give. Numbers that are not finite give NaN. Raises InputError for other shapes.
    """
    F, finite = _forces(F_newtons)
    covariance, known = _covariances(covariance_F, F)
    f, _ = _scaled(F)
    hypotenuse, _, _ = _triangle(f)
    K, half = _scaled_covariance(covariance)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sign = np.where(f[..., 1] < 0.0, -1.0, 1.0)
        u = _deviation(K, -f[..., 0] / hypotenuse, sign, -f[..., 2] / hypotenuse)
        bound = _worst_deviation(K) + np.sqrt(np.maximum(K[..., 1, 1], 0.0))
        u = _times_power(np.where(hypotenuse == 0.0, bound, u), half)
    return np.where(finite & known, u, np.nan)


def status(
    contact: Contact,
    uncertainties: npt.ArrayLike,
    u_miss_newtons: npt.ArrayLike,
    limits: Limits,
    was_present: bool = False,
) -> StatusArray:
    """Return bits 0, 4, 5, 6 of the status byte for n samples in time order: scalar.status_bits() n times.

    contact: arrays of shape (n,). uncertainties: (n, 3) or (3,) from standard_uncertainties().
    u_miss_newtons: (n,) or a scalar from miss_uncertainties(). was_present: contact before the first sample.
    Raises InputError for other shapes, for limits that are NaN, a contact-off above contact-on, or a pad
    whose minimum is above its maximum.
    """
    _check_limits(limits)
    P, theta = contact.P_newtons, contact.theta_rad
    u, u_miss = floats("uncertainties", uncertainties), floats("u_miss_newtons", u_miss_newtons)
    if P.ndim != 1 or u.shape not in {(3,), (P.size, 3)} or u_miss.shape not in {(), P.shape}:
        raise InputError(
            f"contact {P.shape}, uncertainties {u.shape}, u_miss_newtons {u_miss.shape}: "
            "allowed are (n,), (n, 3) or (3,), (n,) or a scalar"
        )
    present = _hysteresis(P, limits, was_present)
    with np.errstate(invalid="ignore"):
        resolved = (u[..., 0] >= 0.0) & (u[..., 2] * scalar.DEGREES <= scalar.THETA_RESOLVED_DEG)
        resolved = resolved & ~(limits.contact_off_newtons > P) & np.isfinite(theta)
        misses = contact.miss_newtons > scalar.MISS_COVERAGE_FACTOR * u_miss + scalar.MISS_FLOOR * P
        past_start_deg = (theta * scalar.DEGREES - limits.theta_min_deg + scalar.PAD_SLACK_DEG) % 360.0
        outside = past_start_deg > limits.theta_max_deg - limits.theta_min_deg + 2.0 * scalar.PAD_SLACK_DEG
    outside &= present & resolved & ~misses
    bits = (
        present * scalar.CONTACT_PRESENT
        + ~resolved * scalar.THETA_UNRESOLVED
        + misses * scalar.MISSES_TIP
        + outside * scalar.OUTSIDE_PAD
    )
    result: StatusArray = bits.astype(np.uint8)
    return result


def _forces(F_newtons: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
    """Return F with the rows that are not finite set to zero, and which rows are finite."""
    F = floats("F", F_newtons)
    if F.ndim < 1 or F.shape[-1] != 3:
        raise InputError(f"F has the shape {F.shape}: allowed is (..., 3), newtons")
    finite: BoolArray = np.asarray(np.isfinite(F).all(axis=-1))
    return np.where(finite[..., np.newaxis], F, 0.0), finite


def _covariances(covariance_F: npt.ArrayLike, F: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the covariances with the unusable ones (not finite, a variance below zero) set to zero, and the usable."""
    covariance = floats("covariance_F", covariance_F)
    if covariance.shape not in {(3, 3), (*F.shape, 3)}:
        raise InputError(f"covariance_F has the shape {covariance.shape}: allowed is (3, 3) or {(*F.shape, 3)}")
    with np.errstate(invalid="ignore"):
        variances = np.diagonal(covariance, axis1=-2, axis2=-1) >= 0.0
    known: BoolArray = np.asarray(np.isfinite(covariance).all(axis=(-2, -1)) & variances.all(axis=-1))
    return np.where(known[..., np.newaxis, np.newaxis], covariance, 0.0), known


def _scaled(F: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return (f, exponent) with F = f 2^exponent and the largest |f| in [0.5, 1): squares stay in range."""
    exponent = np.frexp(np.abs(F).max(axis=-1))[1].astype(np.int64)
    return np.ldexp(F, -exponent[..., np.newaxis]), exponent


def _triangle(f: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (hypotenuse, hypotenuse times |cos(delta)|, |F2| - hypotenuse or zero), as in scalar.contact()."""
    a1, a2, a3 = np.moveaxis(np.abs(f), -1, 0)
    large, small = np.maximum(a1, a3), np.minimum(a1, a3)
    hypotenuse = np.sqrt(large * large + small * small)
    cosine_squared = (large - a2) * (large + a2) + small * small
    total = a2 + hypotenuse
    excess = np.maximum(-cosine_squared, 0.0) / np.where(total > 0.0, total, 1.0)
    return hypotenuse, np.sqrt(np.maximum(cosine_squared, 0.0)), excess


def _wrapped(angle_rad: FloatArray) -> FloatArray:
    """Return the angle, at most one turn off, in (-pi, pi]."""
    down = np.where(angle_rad > np.pi, angle_rad - scalar.TWO_PI, angle_rad)
    return np.where(down <= -np.pi, down + scalar.TWO_PI, down)


def _scaled_covariance(covariance: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return (K, half) with covariance = K 2^(2 half) and variances at most 1."""
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    half = (np.frexp(np.maximum(variances.max(axis=-1), 0.0))[1].astype(np.int64) + 1) // 2
    return np.ldexp(covariance, -2 * half[..., np.newaxis, np.newaxis]), half


def _deviation(K: FloatArray, g1: FloatArray, g2: FloatArray, g3: FloatArray) -> FloatArray:
    """Return sqrt(g K g), as in scalar.py."""
    variance = (
        g1 * (K[..., 0, 0] * g1 + 2.0 * (K[..., 0, 1] * g2 + K[..., 0, 2] * g3))
        + g2 * (K[..., 1, 1] * g2 + 2.0 * K[..., 1, 2] * g3)
        + g3 * K[..., 2, 2] * g3
    )
    return np.sqrt(np.maximum(variance, 0.0))


def _worst_deviation(K: FloatArray) -> FloatArray:
    difference = 0.5 * (K[..., 0, 0] - K[..., 2, 2])
    radius = np.sqrt(difference * difference + K[..., 0, 2] ** 2)
    return np.sqrt(np.maximum(0.5 * (K[..., 0, 0] + K[..., 2, 2]) + radius, 0.0))


def _finite_slope(x: FloatArray, cosine: FloatArray, step: FloatArray) -> FloatArray:
    """Return the slope of asin over one standard uncertainty, as scalar.finite_slope() describes."""
    inward = _arc(x, cosine, -np.minimum(step, 1.0 + x))
    outward = _arc(x, cosine, np.minimum(step, cosine * cosine / (1.0 + x)))
    chords = np.sqrt(0.5 * (inward * inward + outward * outward)) / step
    known = 1.0 / np.maximum(cosine, scalar.SMALLEST_COSINE)
    return np.where(step < scalar.SMALLEST_STEP, known, chords)


def _arc(x: FloatArray, cosine: FloatArray, step: FloatArray) -> FloatArray:
    other = np.sqrt(np.maximum(cosine * cosine - step * (2.0 * x + step), 0.0))
    total = cosine + other
    ratio = (2.0 * x + step) / np.where(total > 0.0, total, np.inf)
    return 2.0 * np.arcsin(np.minimum(0.5 * np.abs(step) * np.sqrt(1.0 + ratio * ratio), 1.0))


def _times_power(value: FloatArray, exponent: IntArray) -> FloatArray:
    """Return value 2^exponent in two steps, infinite where it overflows."""
    first = exponent // 2
    result: FloatArray = value * np.ldexp(1.0, first) * np.ldexp(1.0, exponent - first)
    return result


def _check_limits(limits: Limits) -> None:
    on, off, theta_min_deg, theta_max_deg = limits
    if not off <= on:
        raise InputError(f"contact_off_newtons = {off!r}: allowed is at most contact_on_newtons = {on!r}")
    if not theta_min_deg <= theta_max_deg:
        raise InputError(f"theta_min_deg = {theta_min_deg!r}: allowed is at most theta_max_deg = {theta_max_deg!r}")


def _hysteresis(P_newtons: FloatArray, limits: Limits, was_present: bool) -> BoolArray:
    """Return contact over time: each sample has the state of the last one that switched it on or off."""
    with np.errstate(invalid="ignore"):
        on = P_newtons >= limits.contact_on_newtons
        off = ~(P_newtons >= limits.contact_off_newtons)
    last = np.maximum.accumulate(np.where(on | off, np.arange(P_newtons.size), -1))
    return np.where(last >= 0, on[last], was_present)


CURVATURE_LIMIT = 0.25
"""Largest curvature() with which first order holds.

For theta: |F2| / P is at least two standard uncertainties below 1. bench/coverage.py measures its coverage.
"""


def curvature(F_newtons: npt.ArrayLike, covariance_F: npt.ArrayLike) -> FloatArray:
    """Return the change of the first-order slopes of P, phi, theta over one standard uncertainty: (..., 3).

    F: (..., 3) newtons; covariance_F: (3, 3) or (..., 3, 3), N^2. Three fractions of the slope itself, with x =
    F2 / P = sin(delta) and u(x) its standard uncertainty:

    - P: u_t^2 / (P u(P)), u_t the uncertainty of the force across its own direction: twice the bias of P over
      u(P) (s / P for isotropic noise s, whose bias is s^2 / 2P). Or theta's first where that is larger: where the
      line of action may miss by noise, P is projected, and u(P) then is larger than its spread;
    - phi: u(P) / P, because a force that is too small has too large an angular error;
    - theta: u(x) / cos^2(delta), as asin'' / asin' = x / cos^2 with x = 1, or that of phi if it is larger. It
      grows without bound towards a tangential contact, and is infinite where the line of action misses.

    The load sense has no effect. F1 = F3 = 0: all infinite. Numbers that are not finite: NaN. Raises
    InputError for other shapes.
    """
    F = floats("F", F_newtons)
    u = standard_uncertainties(F, covariance_F, pull=True)
    found = contacts(F, pull=True)
    P, u_P, u_phi = found.P_newtons, u[..., 0], u[..., 1]
    cosine = np.where(found.miss_newtons > 0.0, 0.0, np.maximum(np.cos(found.delta_rad), 0.0))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u_x = _sine_uncertainty(F / P[..., np.newaxis], covariance_F) / P
        bias = np.where(u_P > 0.0, u_phi * u_phi * P / u_P, np.where(u_phi > 0.0, np.inf, 0.0))
        swing = u_P / P
        bend = np.where(u_x > 0.0, u_x / (cosine * cosine), 0.0)
        ratios: FloatArray = np.stack([np.maximum(bias, bend), swing, np.maximum(bend, swing)], axis=-1)
    known = np.isfinite(u[..., 0])
    directed = np.isfinite(found.phi_rad)
    ratios = np.where(directed[..., np.newaxis], ratios, np.inf)
    return np.where(known[..., np.newaxis], ratios, np.nan)


def first_order_holds(
    F_newtons: npt.ArrayLike, covariance_F: npt.ArrayLike, limit: float = CURVATURE_LIMIT
) -> BoolArray:
    """Return whether the standard uncertainties of P, phi, theta can be trusted: shape (..., 3), in this order.

    True where curvature() is at most limit; False for unknown values. For theta that is u(F2 / P) <= limit
    cos^2(delta). Raises InputError for other shapes, and for a limit that is not positive.
    """
    if not limit > 0.0:
        raise InputError(f"limit = {limit!r}: allowed is a positive number")
    with np.errstate(invalid="ignore"):
        holds: BoolArray = np.asarray(curvature(F_newtons, covariance_F) <= limit)
    return holds


def _sine_uncertainty(f: FloatArray, covariance_F: npt.ArrayLike) -> FloatArray:
    """Return P times the standard uncertainty of F2 / P for unit forces f; covariance in N^2."""
    hypotenuse = np.hypot(f[..., 0], f[..., 2])
    x = np.clip(f[..., 1] / hypotenuse, -1.0, 1.0)
    gradient = np.stack([-x * f[..., 0] / hypotenuse, np.ones_like(x), -x * f[..., 2] / hypotenuse], axis=-1)
    covariance = floats("covariance_F", covariance_F)
    variance = np.einsum("...i,...ij,...j->...", gradient, covariance, gradient)
    result: FloatArray = np.sqrt(np.maximum(variance, 0.0))
    return result
