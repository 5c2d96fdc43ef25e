"""Figure 9 of the paper by simulation: errors at the grooves of section 4.1 after a calibration as in section 4.3."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.calibration.grooves import Grooves, paper_grooves
from tipforce.sensor.contact.estimate import contacts, standard_uncertainties
from tipforce.sensor.contact.force import force_from_strain, force_vector
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import Layout
from tipforce.sensor.structure.published import CALIBRATION_THETA_DEG, CALIBRATION_WEIGHT_NEWTONS
from tipforce.sensor.structure.strain import calibration_matrix, strain_matrix


@dataclass(frozen=True, slots=True, eq=False)
class GrooveErrors:
    """Errors of (P, phi, theta) at n grooves, newtons and radians."""

    grooves: Grooves
    errors: FloatArray
    """(repeats, n, 3): estimate minus truth, of independent calibrations and readings."""
    standard_uncertainties: FloatArray
    """(n, 3): first order, from the reading's noise and the calibration's."""


def simulate_groove_errors(
    geometry: Geometry,
    gauges: Layout,
    noise_strain: float,
    *,
    repeats: int,
    seed: int,
    P_newtons: float = CALIBRATION_WEIGHT_NEWTONS,
) -> GrooveErrors:
    """Return the errors caused by equal, independent, normal gauge noise at the paper's grooves.

    Each repeat fits V = A F by least squares to noisy readings in the grooves between 0 and 90 degrees, as section
    4.3 does, inverts A, then reads every groove once more. noise_strain: standard deviation per reading. Three
    gauges. Raises InputError for noise that is not positive, fewer than 1 repeat, or another number of gauges.
    """
    A = strain_matrix(geometry, gauges)
    if A.shape[0] != 3:
        raise InputError(f"{A.shape[0]} gauges: allowed are layouts of 3 gauges, as in the paper")
    if not (noise_strain > 0.0 and P_newtons > 0.0) or repeats < 1:
        raise InputError(
            f"noise_strain = {noise_strain!r}, P_newtons = {P_newtons!r}, repeats = {repeats!r}: "
            "allowed are positive numbers"
        )
    rng = np.random.default_rng(seed)
    grooves = paper_grooves()
    F = force_vector(P_newtons, grooves.phi_rad, grooves.theta_rad)
    fitted = F[_calibrated(grooves)]
    errors = np.empty((repeats, len(F), 3))
    for index in range(repeats):
        V = fitted @ A.T + rng.normal(0.0, noise_strain, (len(fitted), 3))
        C = np.linalg.inv(np.linalg.lstsq(fitted, V, rcond=None)[0].T)
        readings = F @ A.T + rng.normal(0.0, noise_strain, F.shape)
        errors[index] = _contact_errors(force_from_strain(C, readings), grooves, P_newtons)
    C = calibration_matrix(geometry, gauges)
    leverage = np.einsum("ni,ij,nj->n", F, np.linalg.inv(fitted.T @ fitted), F)
    covariances = noise_strain**2 * (1.0 + leverage[:, np.newaxis, np.newaxis]) * (C @ C.T)
    return GrooveErrors(grooves, errors, standard_uncertainties(F, covariances, pull=True))


def _calibrated(grooves: Grooves) -> npt.NDArray[np.bool_]:
    low, high = np.radians(CALIBRATION_THETA_DEG)
    inside: npt.NDArray[np.bool_] = (grooves.theta_rad >= low) & (grooves.theta_rad <= high + 1e-9)
    return inside


def _contact_errors(F: FloatArray, grooves: Grooves, P_newtons: float) -> FloatArray:
    found = contacts(F, pull=True)
    errors = np.stack(
        (found.P_newtons - P_newtons, found.phi_rad - grooves.phi_rad, found.theta_rad - grooves.theta_rad), axis=-1
    )
    errors[:, 1:] = (errors[:, 1:] + np.pi) % (2.0 * np.pi) - np.pi
    result: FloatArray = errors
    return result
