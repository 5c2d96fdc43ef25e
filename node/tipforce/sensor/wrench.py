"""Six axes: a wrench on a convex surface -> contact centroid, its uncertainty, its status. For sensors to come.

The functions have the names and the parts of contact.py, for wrenches (fx, fy, fz, mx, my, mz) on the tip about the
surface's origin, newtons and newton metres, and loads that push. On a cylinder of the tip's radius a planar load gives
what contact.py gives: f = (F3, F1, 0), m = (0, 0, r F2). A planar node imports neither this file nor surfaces.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError
from tipforce.sensor.contact import scalar
from tipforce.sensor.surfaces import Surface

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
StatusArray = npt.NDArray[np.uint8]

_SINGULAR = 1e-13  # of a matrix whose rows have unit length


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Contacts of wrenches of shape (..., 6); NaN where unknown: a wrench that is not finite, or has no contact."""

    force_newtons: FloatArray
    """(...), |f|."""
    centroid_m: FloatArray
    """(..., 3), on the surface."""
    normal: FloatArray
    """(..., 3), outward unit normal at the centroid."""
    normal_newtons: FloatArray
    """(...), pressing force along the normal, at least zero but for rounding."""
    torque_newton_metres: FloatArray
    """(...), about the outward normal."""
    miss_newtons: FloatArray
    """(...), by how much the load misses the surface (Surface.excess()), else zero."""


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """First-order standard uncertainties; infinite where the load is tangential."""

    force_newtons: FloatArray
    """(...)."""
    centroid_covariance_m2: FloatArray
    """(..., 3, 3)."""
    torque_newton_metres: FloatArray
    """(...)."""
    miss_newtons: FloatArray
    """(...)."""

    @property
    def centroid_m(self) -> FloatArray:
        """Largest standard uncertainty of the centroid in any direction, (...), metres."""
        known = np.asarray(np.isfinite(self.centroid_covariance_m2).all(axis=(-2, -1)))
        covariance = np.where(known[..., np.newaxis, np.newaxis], self.centroid_covariance_m2, 0.0)
        largest = np.linalg.eigvalsh(covariance)[..., -1]
        unknown = np.where(np.isnan(self.centroid_covariance_m2).any(axis=(-2, -1)), np.nan, np.inf)
        return np.asarray(np.where(known, np.sqrt(np.maximum(largest, 0.0)), unknown), dtype=np.float64)


class Limits(NamedTuple):
    """What a status is judged by."""

    contact_on_newtons: float
    contact_off_newtons: float
    resolved_m: float
    """Largest standard uncertainty of the centroid with which it still counts as resolved."""


def contacts(wrench: npt.ArrayLike, surface: Surface) -> Contact:
    """Return the contacts of wrenches (..., 6) that push on a surface.

    Raises InputError where the last axis is not 6; numbers that are not finite give NaN, never an error.
    """
    f, m, unit, finite = _scaled(wrench, surface)
    c, k = surface.solve(f, m)
    gradient = surface.gradient(c)
    slope = np.linalg.norm(gradient, axis=-1)
    normal = gradient / slope[..., np.newaxis]
    excess, _ = surface.excess(f, m)
    known = finite[..., np.newaxis]
    return Contact(
        force_newtons=np.where(finite, np.linalg.norm(f, axis=-1) * unit, np.nan),
        centroid_m=np.where(known, c, np.nan),
        normal=np.where(known, normal, np.nan),
        normal_newtons=np.where(finite, -np.sum(f * normal, axis=-1) * unit, np.nan),
        torque_newton_metres=np.where(finite, k * slope * unit, np.nan),
        miss_newtons=np.where(finite, np.maximum(excess, 0.0) * unit, np.nan),
    )


def standard_uncertainties(wrench: npt.ArrayLike, covariance: npt.ArrayLike, surface: Surface) -> Uncertainty:
    """Return the standard uncertainties of contacts() to first order.

    wrench: (..., 6); covariance: (6, 6) or (..., 6, 6), symmetric. The contact equations m = c x f + k grad g(c)
    and g(c) = 0 are differentiated, not the solution: one formula for all surfaces, singular only where the load
    is tangential and without torque (then infinite). Raises InputError for other shapes.
    """
    f, m, unit, finite = _scaled(wrench, surface)
    K = np.asarray(covariance, dtype=np.float64)
    if K.shape not in {(6, 6), (*f.shape[:-1], 6, 6)}:
        raise InputError(f"covariance has the shape {K.shape}: allowed is (6, 6) or {(*f.shape[:-1], 6, 6)}")
    c, k = surface.solve(f, m)
    known = finite & np.isfinite(c).all(axis=-1) & np.isfinite(K).all(axis=(-2, -1))
    J, regular = _jacobian(f, np.where(known[..., np.newaxis], c, 0.0), np.where(known, k, 0.0), surface)
    J = J / unit[..., np.newaxis, np.newaxis]  # c does not scale with the wrench; k's row is scaled back below
    centroid = J[..., :3, :] @ K @ np.swapaxes(J[..., :3, :], -1, -2)
    gradient = surface.gradient(c)
    slope = np.linalg.norm(gradient, axis=-1)[..., np.newaxis]
    with np.errstate(invalid="ignore"):
        turn = np.einsum("...i,ij,...jk->...k", gradient, surface.hessian(), J[..., :3, :])
        torque = (J[..., 3, :] * slope + k[..., np.newaxis] * turn / slope) * unit[..., np.newaxis]
        length = np.linalg.norm(f, axis=-1)[..., np.newaxis]
        pull = np.concatenate([f / np.where(length > 0.0, length, np.nan), np.zeros_like(m)], axis=-1)
    infinite = np.where(regular, 1.0, np.inf)
    unknown = np.where(known, infinite, np.nan)
    _, by_wrench = surface.excess(f, m)
    return Uncertainty(
        force_newtons=np.where(finite, _deviation(pull, K), np.nan),
        centroid_covariance_m2=np.where(
            (known & regular)[..., np.newaxis, np.newaxis], centroid, unknown[..., np.newaxis, np.newaxis]
        ),
        torque_newton_metres=np.where(known & regular, _deviation(torque, K), unknown),
        miss_newtons=np.where(finite, _deviation(by_wrench, K), np.nan),
    )


def status(
    contact: Contact, uncertainty: Uncertainty, surface: Surface, limits: Limits, was_present: bool = False
) -> StatusArray:
    """Return bits 0, 4, 5, 6 of the status byte for n wrenches in time order, with the meaning of contact.py.

    Bit 4: the centroid is unresolved; 5: the load misses the surface beyond its uncertainty; 6: the centroid lies
    outside what may be touched. contact and uncertainty: shape (n,). Raises InputError for other shapes, or a
    contact-off above contact-on.
    """
    on, off, resolved_m = limits
    if not off <= on:
        raise InputError(f"contact_off_newtons = {off!r}: allowed is at most contact_on_newtons = {on!r}")
    P = contact.force_newtons
    if P.ndim != 1 or uncertainty.force_newtons.shape != P.shape:
        raise InputError(f"contact {P.shape}, uncertainty {uncertainty.force_newtons.shape}: allowed are (n,) and (n,)")
    present = np.zeros(P.shape, dtype=np.bool_)
    for index, force in enumerate(P):
        was_present = bool(force >= (off if was_present else on))
        present[index] = was_present
    with np.errstate(invalid="ignore"):
        resolved = (uncertainty.centroid_m <= resolved_m) & (off <= P) & np.isfinite(contact.centroid_m).all(axis=-1)
        beyond = scalar.MISS_COVERAGE_FACTOR * uncertainty.miss_newtons + scalar.MISS_FLOOR * P
        misses = contact.miss_newtons > beyond
    outside = surface.outside(contact.centroid_m) & present & resolved & ~misses
    bits = (
        present * scalar.CONTACT_PRESENT
        + ~resolved * scalar.THETA_UNRESOLVED
        + misses * scalar.MISSES_TIP
        + outside * scalar.OUTSIDE_PAD
    )
    return np.asarray(bits, dtype=np.uint8)


def _scaled(wrench: npt.ArrayLike, surface: Surface) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """(f, m, unit, finite): the wrench over unit, a power of two, so that squares stay in range; zero where NaN."""
    w = np.asarray(wrench, dtype=np.float64)
    if w.ndim < 1 or w.shape[-1] != 6:
        raise InputError(f"wrench has the shape {w.shape}: allowed is (..., 6), newtons and newton metres")
    finite: BoolArray = np.asarray(np.isfinite(w).all(axis=-1))
    w = np.where(finite[..., np.newaxis], w, 0.0)
    size = np.maximum(np.abs(w[..., :3]).max(axis=-1), np.abs(w[..., 3:]).max(axis=-1) / surface.size_m)
    exponent = np.frexp(size)[1].astype(np.int64)
    w = np.ldexp(w, -exponent[..., np.newaxis])
    return w[..., :3], w[..., 3:], np.ldexp(1.0, exponent), finite


def _jacobian(f: FloatArray, c: FloatArray, k: FloatArray, surface: Surface) -> tuple[FloatArray, BoolArray]:
    """(d(c, k) / d(f, m), (..., 4, 6); where the equations are regular, (...)).

    From dc x f + k H dc + dk grad g = dm - c x df and grad g . dc = 0, solved with lengths in units of the
    surface's size, so that the rows are alike.
    """
    L = surface.size_m
    gradient = surface.gradient(c)
    scale = np.linalg.norm(gradient, axis=-1)[..., np.newaxis]
    scale = np.where(scale > 0.0, scale, 1.0)
    M = np.zeros((*f.shape[:-1], 4, 4))
    M[..., :3, :3] = k[..., np.newaxis, np.newaxis] * surface.hessian() - _cross_matrix(f)
    M[..., :3, 3] = M[..., 3, :3] = gradient / scale
    right = np.zeros((*f.shape[:-1], 4, 6))
    right[..., :3, :3] = -_cross_matrix(c) / L
    right[..., :3, 3:] = np.eye(3) / L
    lengths = np.linalg.norm(M, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        regular: BoolArray = np.abs(np.linalg.det(M)) > _SINGULAR * np.prod(lengths, axis=-1)
    M = np.where(regular[..., np.newaxis, np.newaxis], M, np.eye(4))
    J = np.linalg.solve(M, right) * L
    J[..., 3, :] /= scale
    return np.asarray(J, dtype=np.float64), regular


def _cross_matrix(v: FloatArray) -> FloatArray:
    """The matrix of v x, (..., 3, 3)."""
    matrix = np.zeros((*v.shape, 3))
    for row, column, axis in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[..., row, column] = -v[..., axis]
        matrix[..., column, row] = v[..., axis]
    return matrix


def _deviation(gradient: FloatArray, covariance: FloatArray) -> FloatArray:
    """sqrt(g K g), (...)."""
    with np.errstate(invalid="ignore"):
        variance = np.einsum("...i,...ij,...j->...", gradient, covariance, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)), dtype=np.float64)
