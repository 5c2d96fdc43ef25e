"""What `tipforce calibrate fit` checks beside the fit itself, and where the calibration is valid."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from tipforce.errors import InputError
from tipforce.host.configuration.measurements import Measurements
from tipforce.sensor.calibration.fit import Fit, Model, Readings
from tipforce.sensor.calibration.plausibility import require_degrees, require_order, require_size
from tipforce.sensor.calibration.rails import rails
from tipforce.sensor.calibration.rounding import to_digits
from tipforce.sensor.calibration.validity import overload_newtons, redundancy_limit
from tipforce.sensor.structure.gauge_positions import gauge_matrix
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import strain_matrix
from tipforce_tools.cli.layout_file import read_layout

ALLOWED_WITH_LAYOUT, ALLOWED_WITHOUT = 4.0, 30.0
"""Factors between the measured response and beam theory: real gauges and their factors, or another structure."""


def check_readings(args: argparse.Namespace, data: Measurements, readings: Readings, model: Model) -> None:
    """Raise InputError for angles in radians, and for extremes that repeat, with the flag that settles it."""
    require_degrees(readings)
    if model.saturation_strain is not None and np.isinf(model.saturation_strain).all():
        return
    limit = np.full(readings.strain.shape[1], np.inf if args.saturation is None else args.saturation * 1e-6)
    loads = np.stack((readings.P_newtons, readings.phi_rad, readings.theta_rad), axis=-1)
    for rail in rails(readings.strain, loads, limit):
        value = np.floor(abs(rail.strain) * 1e9) / 1e3  # below what the converter shows
        raise InputError(
            f"{rail.words(data.line)}: that is what a converter's limit looks like. If it is, give --saturation "
            f"{value:.10g}; if the readings have no limit, --saturation none"
        )


def check_theory(args: argparse.Namespace, fit: Fit) -> None:
    """Raise InputError where the size of the response, or the order of the gauges, is not what theory says."""
    if args.layout:
        theory = gauge_matrix(*read_layout(args.layout))
        require_size(fit.A, theory, ALLOWED_WITH_LAYOUT, args.layout)
        require_order(fit.A, theory, args.layout)
        return
    typical = np.sqrt(np.mean(np.square(strain_matrix(FABRICATED, "I"))))
    require_size(fit.A, np.full(fit.A.shape, typical), ALLOWED_WITHOUT, "a gauge of the paper's fingertip")


def validity_of(args: argparse.Namespace, fit: Fit) -> dict[str, Any]:
    """Fields of the calibration: forces, temperatures, limits. What the data do not show stays 0 (not known)."""
    n = len(fit.A)
    largest = max(load.P_newtons for load in fit.loads)
    straight, warm = fit.nonlinearity, fit.temperature
    found: dict[str, Any] = {
        "calibrated_force_newtons": largest,
        "model_uncertainty": 0.0 if straight is None else float(to_digits(straight.model_uncertainty, 3)),
        "redundancy_limit": limit_of(fit, fit.noise_covariance_strain2, fit.noise_dof, largest),
    }
    if args.saturation is not None and np.isfinite(args.saturation):
        found["converter_limit_strain"] = np.full(n, args.saturation * 1e-6)
    if args.layout:
        yield_pascals = None if args.yield_stress is None else args.yield_stress * 1e6
        overload = overload_newtons(read_layout(args.layout)[0], yield_pascals)
        found["overload_force_newtons"] = float(to_digits(overload, 4)) if overload > largest else 0.0
    if warm is not None:
        found |= {
            "reference_temperature_degC": warm.reference_degC,
            "temperature_min_degC": warm.lowest_degC,
            "temperature_max_degC": warm.highest_degC,
            "gain_temperature_per_K": float(to_digits(warm.gain_per_K, 6)) if warm.gain_fitted else 0.0,
        }
        if warm.offset_fitted:
            found["offset_temperature_strain_per_K"] = to_digits(warm.offset_strain_per_K, 6)
    return found


def limit_of(fit: Fit, Sigma: Any, dof: float, largest_newtons: float) -> float:
    """The limit of the redundancy check for one reading with the covariance Sigma, known with ``dof``."""
    limit = redundancy_limit(fit.A, Sigma, fit.parameter_covariance, dof, largest_newtons)
    return float(to_digits(limit, 6))
