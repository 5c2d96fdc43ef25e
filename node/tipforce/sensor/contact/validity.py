"""Of the contacts of many samples: their status bits, and whether first-order uncertainties can be trusted."""

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray
from tipforce.errors import InputError
from tipforce.sensor.contact import estimate, scalar


def status_columns(
    contact: estimate.Contact,
    resolved: BoolArray,
    misses: BoolArray,
    limits: tuple[float, float, float, float],
    was_present: bool,
    counts: BoolArray | bool = True,
) -> IntArray:
    """Return scalar.status_bits() of samples in time order; one that does not count leaves contact as it was."""
    on, off, theta_min_deg, theta_max_deg = limits
    P, theta = contact.P_newtons, contact.theta_rad
    loaded = off <= P
    present = held((on <= P) & counts, ~loaded & counts, was_present)
    resolved = resolved & loaded & np.isfinite(theta)
    past_start_deg = theta * scalar.DEGREES - theta_min_deg + scalar.PAD_SLACK_DEG
    with np.errstate(invalid="ignore"):
        past_start_deg = past_start_deg - 360.0 * np.floor(past_start_deg / 360.0)
        outside = past_start_deg > theta_max_deg - theta_min_deg + 2.0 * scalar.PAD_SLACK_DEG
    bits: IntArray = (
        present * scalar.CONTACT_PRESENT
        + ~resolved * scalar.THETA_UNRESOLVED
        + misses * scalar.MISSES_TIP
        + (outside & present & resolved & ~misses) * scalar.OUTSIDE_PAD
    )
    return bits


def is_resolved(u_P_newtons: FloatArray, u_theta_rad: FloatArray) -> BoolArray:
    """Return whether the uncertainties, (...), leave theta resolved; not where one is NaN."""
    return (u_P_newtons >= 0.0) & (u_theta_rad * scalar.DEGREES <= scalar.THETA_RESOLVED_DEG)


def check_limits(limits: tuple[float, float, float, float]) -> None:
    """Raise InputError for limits that no sample can be compared with."""
    on, off, theta_min_deg, theta_max_deg = limits
    if not off <= on:
        raise InputError(f"contact_off_newtons = {off!r}: allowed is at most contact_on_newtons = {on!r}")
    if not theta_min_deg <= theta_max_deg:
        raise InputError(f"theta_min_deg = {theta_min_deg!r}: allowed is at most theta_max_deg = {theta_max_deg!r}")


def held(on: BoolArray, off: BoolArray, before: bool) -> BoolArray:
    """Return a state over time, (m,): that of the last sample that switched it on or off, ``before`` the first."""
    switched = on | off
    if switched.all():
        return on
    last = np.maximum.accumulate(np.where(switched, np.arange(on.size), -1))
    return np.where(last >= 0, on[last], before)


CURVATURE_LIMIT = 0.25
"""Largest curvature() with which first order holds; bench/coverage.py measures its coverage."""


def curvature(F_newtons: npt.ArrayLike, covariance_F: npt.ArrayLike) -> FloatArray:
    """Return the change of the first-order slopes of P, phi, theta over one standard uncertainty, as fractions: (...,
    3). F: (..., 3) newtons; covariance_F: (3, 3) or (..., 3, 3), N^2. With x = F2 / P = sin(delta):

    - P: u_t^2 / (P u(P)), u_t the uncertainty of the force across its own direction: twice the bias of P over u(P).
      Or u(x) / cos^2(delta) if larger: where the line of action may miss by noise, P is projected;
    - phi: u(P) / P, because a force that is too small has too large an angular error;
    - theta: u(x) / cos^2(delta), or that of phi if it is larger; infinite where the line of action misses.

    F1 = F3 = 0: all infinite. Numbers that are not finite: NaN. Raises InputError for other shapes."""
    F = estimate.checked_forces(F_newtons)
    u = estimate.deviation_columns(F, estimate.checked_covariances(covariance_F, F_newtons), 1.0)
    ratios = np.stack(curvature_columns(F, estimate.contact_columns(F, 1.0).P_newtons, u), axis=-1)
    directed = ((F.F1 != 0.0) | (F.F3 != 0.0))[..., np.newaxis]
    return np.where(np.isfinite(u.P)[..., np.newaxis], np.where(directed, ratios, np.inf), np.nan)


def curvature_columns(
    F: estimate.Forces, P_newtons: FloatArray, u: estimate.Deviations
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return curvature() of P, phi and theta, of contacts with F1 or F3."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        cosine = F.cosine / F.hypotenuse
        bias = np.where(u.P > 0.0, u.phi * u.phi * P_newtons / u.P, np.where(u.phi == 0.0, 0.0, np.inf))
        bend = np.where(u.sine > 0.0, u.sine / (cosine * cosine), 0.0)
        swing = u.P / P_newtons
        return np.maximum(bias, bend), swing, np.maximum(bend, swing)


def first_order_holds(F_newtons: npt.ArrayLike, covariance_F: npt.ArrayLike) -> BoolArray:
    """Whether uncertainties of P, phi, theta can be trusted, (..., 3): curvature() within limits. Raises InputError."""
    with np.errstate(invalid="ignore"):
        return np.asarray(curvature(F_newtons, covariance_F) <= CURVATURE_LIMIT)
