"""Validity of the first-order uncertainty of contact.py: where it holds, and where an interval needs a warning."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, floats
from tipforce.errors import InputError
from tipforce.sensor.contact.estimate import contacts, standard_uncertainties

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
