"""Whether a calibration can be that of a sensor: numbers, rank, covariance, validity, and the size of its matrix."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.host.configuration.calibration import Calibration

_LEAST_RANK = 1e-9  # smallest over largest singular value: below, rounding alone decides
NORM_MIN, NORM_MAX = 10.0, 1e7
"""2-norm of C, N per unit strain, that a node commits (2104h)."""
TYPICAL_NEWTONS_PER_STRAIN = 5e3
"""Smallest singular value of C by beam theory: 4.4e3 to 6.1e3 for the cases I to III in the fabricated dimensions."""
ALLOWED = 30.0
"""Factor to either side of it: other dimensions, materials, numbers of gauges."""
_NEAR = 3.0  # factor from a suspect
_SUSPECTS = {
    1e-6: "the matrix looks like newtons per microstrain: multiply it by 1e6",
    1e6: "the matrix looks like newtons per 1e-6 microstrain (converted twice): multiply it by 1e-6",
    1e-3: "the matrix looks like newtons per millistrain, or kilonewtons per strain: multiply it by 1000",
    1e3: "the matrix looks like millinewtons per strain: multiply it by 0.001",
    1000.0 / 9.80665: "the loads look like grams: multiply the matrix by 0.00980665",
}
_VALIDITY = (
    "calibrated_force_newtons", "overload_force_newtons", "temperature_min_degC", "temperature_max_degC",
    "model_uncertainty", "gain_temperature_per_K", "redundancy_limit", "converter_limit_strain",
    "offset_temperature_strain_per_K",
)  # fmt: skip
_NOT_NEGATIVE = (
    "calibrated_force_newtons", "overload_force_newtons", "model_uncertainty", "converter_limit_strain",
    "redundancy_limit",
)  # fmt: skip
_CONTACT = (
    "reference_temperature_degC", "tip_radius_m", "theta_min_deg", "theta_max_deg", "contact_on_newtons",
    "contact_off_newtons",
)  # fmt: skip


def check(calibration: Calibration) -> None:
    """Raise InputError for a calibration that no sensor can have; the text names the field and what is allowed."""
    S = calibration.covariance_strain2
    for name, values in (("matrix", calibration.C), ("offset", calibration.offset_strain), ("covariance", S)):
        if not np.isfinite(values).all():
            raise InputError(f"calibration {name}: {values[~np.isfinite(values)][0]} is not finite")
    _check_matrix(calibration.C)
    if not np.allclose(S, S.T, rtol=1e-9, atol=0.0):
        raise InputError("calibration covariance: not symmetric")
    if not (np.diagonal(S) > 0.0).all():
        raise InputError(
            f"calibration covariance: a gauge's variance is {np.diagonal(S).min():g}: allowed is above 0, because a "
            "reading without noise would count as exactly known"
        )
    deviation = np.sqrt(np.diagonal(S))
    with np.errstate(over="ignore"):
        correlation = S / deviation / deviation[:, np.newaxis]
    if not np.isfinite(correlation).all() or np.linalg.eigvalsh(correlation)[0] < -1e-9:
        raise InputError("calibration covariance: not positive semi-definite; no correlation may be over 1")
    if calibration.parameter_covariance is not None:
        _check_parameters(calibration.parameter_covariance)
    drift = calibration.tare_drift_strain_per_s
    if not 0.0 <= drift < np.inf:
        raise InputError(f"calibration tare_drift: {1e6 * drift:g} microstrain/s, allowed is 0 (not stated) or above")
    _check_validity(calibration)
    calibration.record()  # each value fits its field


def _check_parameters(blocks: FloatArray) -> None:
    """A covariance here makes covariance_of_estimate() one for every load: no load needs a check of its own."""
    from tipforce.sensor.calibration.rounding import DIGITS

    side = blocks.shape[0] * blocks.shape[1]
    matrix = blocks.reshape(side, side)
    variance = np.diagonal(matrix)
    scale = np.where(variance > 0.0, variance, np.abs(matrix).max(initial=0.0) or 1.0)  # 0: an offset not fitted
    correlation = matrix / np.sqrt(scale) / np.sqrt(scale)[:, np.newaxis]
    # A file's numbers are rounded to a place of the largest one.
    rounding = side * 10.0 ** (1 - DIGITS) * float(np.abs(matrix).max(initial=0.0) / scale.min())
    if not np.isfinite(matrix).all() or np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0] < -1e-9 - rounding:
        raise InputError("calibration parameter covariance: not positive semi-definite; no correlation may be over 1")


def _check_matrix(C: FloatArray) -> None:
    singular = np.linalg.svd(C, compute_uv=False)
    if not singular[-1] > singular[0] * _LEAST_RANK:
        raise InputError(
            f"calibration matrix: rank below 3 (singular values {', '.join(f'{s:.3g}' for s in singular)} N per "
            "unit strain): it cannot tell three force components"
        )
    # The response to a newton, not the norm of C: an ill-conditioned layout does not change it.
    ratio = float(singular[-1]) / TYPICAL_NEWTONS_PER_STRAIN
    factor = min(_SUSPECTS, key=lambda one: abs(np.log(one / ratio)))
    if not 1.0 / ALLOWED <= ratio <= ALLOWED and 1.0 / _NEAR <= factor / ratio <= _NEAR:
        raise InputError(
            f"calibration matrix: {ratio:.3g} times the size that beam theory gives (allowed {1.0 / ALLOWED:.2g} to "
            f"{ALLOWED:g}): {_SUSPECTS[factor]}"
        )
    if not NORM_MIN <= singular[0] <= NORM_MAX:
        raise InputError(
            f"calibration matrix: 2-norm {singular[0]:.3g} N per unit strain: allowed is {NORM_MIN:g} to {NORM_MAX:g}"
        )


def _check_validity(calibration: Calibration) -> None:
    """2110h to 2116h: finite, and of the sign and order that the node's commit wants."""
    for name in (*_VALIDITY, *_CONTACT):
        values = np.atleast_1d(getattr(calibration, name))
        if not np.isfinite(values).all():
            raise InputError(f"calibration {name}: {values[~np.isfinite(values)][0]} is not finite")
        if name in _NOT_NEGATIVE and (values < 0.0).any():
            raise InputError(f"calibration {name}: {values.min():g}, allowed is 0 (not known) and above")
    for low, high in (
        ("temperature_min_degC", "temperature_max_degC"),
        ("theta_min_deg", "theta_max_deg"),
        ("contact_off_newtons", "contact_on_newtons"),
    ):
        if getattr(calibration, low) > getattr(calibration, high):
            raise InputError(
                f"calibration {low}: {getattr(calibration, low):g} is above {high} {getattr(calibration, high):g}"
            )
