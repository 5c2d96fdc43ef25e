"""Figures of merit of a structure: predicted uncertainties, noise, condition number, largest strain.

All figures are closed formulas of Table 1's beam theory; optimise any of them, report the others beside it. The
condition number alone does not contain noise: it is unchanged if every gauge reads half as much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.structure.strain import condition_number, noise_gain

PAPER_LOAD_NEWTONS = 4.4
_CONTACTS, _DIRECTIONS = 61, 9  # midpoints over pad and friction cone; twice as many change u by less than 1e-3


@dataclass(frozen=True, slots=True)
class LoadSet:
    """The loads over which uncertainties are averaged: contacts on the pad, pushes within the friction cone.

    Uniform in theta over the pad and in the angle between push and inward normal. Raises InputError for a load,
    pad or friction coefficient out of range.
    """

    load_newtons: float = PAPER_LOAD_NEWTONS
    theta_min_deg: float = 0.0
    theta_max_deg: float = 180.0
    friction: float = 0.5
    """Coefficient of friction: the push stays within atan(friction) of the normal."""

    def __post_init__(self) -> None:
        if not 0.0 < self.load_newtons < math.inf:
            raise InputError(f"load = {self.load_newtons!r} N: allowed is a positive finite number")
        if not -360.0 <= self.theta_min_deg <= self.theta_max_deg <= 360.0:
            raise InputError(
                f"pad from {self.theta_min_deg!r} to {self.theta_max_deg!r} degrees: allowed is -360 to 360, rising"
            )
        if not 0.0 <= self.friction <= 10.0:
            raise InputError(f"friction = {self.friction!r}: allowed is 0 to 10")

    def angles(self) -> tuple[FloatArray, FloatArray]:
        """Return (phi_rad, theta_rad), each (k,): the directions and contacts of the set."""
        theta = math.radians(self.theta_min_deg) + math.radians(self.theta_max_deg - self.theta_min_deg) * (
            (np.arange(_CONTACTS) + 0.5) / _CONTACTS
        )
        cone = math.atan(self.friction) * (2.0 * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS - 1.0)
        theta, cone = (grid.ravel() for grid in np.meshgrid(theta, cone))
        return theta + math.pi + cone, theta

    def weights(self) -> FloatArray:
        """Return W_P, W_phi, W_theta, shape (3, 3, 3): means of j j^T, j the gradient of P, phi or theta by F.

        First order: the mean variance of the quantity is tr(W C Sigma_V C^T). Units 1, (rad/N)^2, (rad/N)^2.
        """
        phi, theta = self.angles()
        s, c, zero = np.sin(phi), np.cos(phi), np.zeros_like(phi)
        delta = phi - theta
        gradient_P = np.stack((s, zero, c), axis=-1)
        gradient_phi = np.stack((c, zero, -s), axis=-1) / self.load_newtons
        # sin(delta) = F2 / P: d(delta) = (dF2 - sin(delta) dP) / (P cos(delta)), and theta = phi - delta.
        slope_2 = np.stack((zero, 1.0 / np.cos(delta), zero), axis=-1) / self.load_newtons
        slope_P = np.tan(delta)[:, np.newaxis] * gradient_P / self.load_newtons
        gradients = (gradient_P, gradient_phi, gradient_phi - slope_2 + slope_P)
        return np.stack([j.T @ j / len(phi) for j in gradients])


@dataclass(frozen=True, slots=True)
class Merit:
    """Figures of a strain matrix at a given gauge noise and load set."""

    u_P_newtons: float
    """Standard uncertainties: RMS over the load set, from gauge noise alone, first order."""
    u_phi_deg: float
    u_theta_deg: float
    noise_gain_newtons: float
    """sqrt(trace(C C^T)) in newtons per microstrain."""
    smallest_singular_value: float
    """Of the strain matrix, in microstrain per newton: the smallest reading of the gauges for a unit force."""
    condition_number: float


def merit(strain_matrix: npt.ArrayLike, noise_microstrain: float, loads: LoadSet) -> Merit:
    """Return the figures of a strain matrix (n, 3), strain per newton; equal white noise on every gauge.

    A matrix of rank below 3 gives infinite uncertainties. Raises InputError for a noise that is negative or not
    finite, or another shape.
    """
    A = 1e6 * np.asarray(strain_matrix, dtype=np.float64)
    if A.ndim != 2 or A.shape[1] != 3 or A.shape[0] < 3:
        raise InputError(f"strain matrix of shape {A.shape}: allowed is (n, 3), n at least 3")
    if not 0.0 <= noise_microstrain < math.inf:
        raise InputError(f"noise = {noise_microstrain!r} microstrain: allowed is 0 or more, finite")
    if np.linalg.matrix_rank(A) < 3:
        return Merit(math.inf, math.inf, math.inf, math.inf, 0.0, math.inf)
    C = np.linalg.pinv(A)
    u = [noise_microstrain * math.sqrt(np.trace(W @ C @ C.T)) for W in loads.weights()]
    return Merit(
        u[0], math.degrees(u[1]), math.degrees(u[2]), noise_gain(C),
        float(np.linalg.svd(A, compute_uv=False)[-1]), condition_number(A),
    )  # fmt: skip


def worst_strain(strain_matrix: npt.ArrayLike, load_newtons: float) -> float:
    """Return the largest reading of any gauge (strain), over the same loads, from a strain matrix (n, 3)."""
    A = np.asarray(strain_matrix, dtype=np.float64)
    return float(np.max(np.hypot(A[:, 0], A[:, 2]) + np.abs(A[:, 1]))) * load_newtons
