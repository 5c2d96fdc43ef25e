"""From measurements with loads to a calibration, with its checks."""

import datetime
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.measurements import MODES, Measurements
from tipforce.sensor import Fit, Model, Readings, beam_prior
from tipforce.sensor.calibration.data import require_degrees, require_no_rail, require_order, require_size
from tipforce.sensor.calibration.fit import best_fit
from tipforce.sensor.calibration.result import rounded, to_digits
from tipforce.sensor.calibration.statistics import overload_newtons, redundancy_limit
from tipforce.sensor.structure.layouts import CUSTOM_LAYOUT_CODE, layout_code
from tipforce.sensor.structure.strain import FABRICATED, Gauge, Geometry, gauge_matrix, strain_matrix
from tipforce.sources.layout_file import read_layout

ALLOWED_WITH_LAYOUT, ALLOWED_WITHOUT = 4.0, 30.0
"""Factors between the measured response and beam theory: real gauges and their factors, or another structure."""


@dataclass(frozen=True)
class FitRequest:
    """What a fit is asked for: the model of the readings, and what the calibration states. Strains in microstrain,
    angles in degrees, stress in MPa; None: estimated, not known, or that of the data."""

    layout: str | None = None
    angle_scatter: float = 0.5
    drift: Literal["none", "tare", "linear"] | None = None
    """None: what predicts rows that the fit leaves out best."""
    loss: Literal["huber", "soft_l1", "none"] = "huber"
    noise: float | None = None
    saturation: float | None = None
    """inf: no reading is at a limit."""
    yield_stress: float | None = None
    no_offset: bool = False
    prior: str | None = None
    """"beam": lean on beam theory, which may be off by the share ``prior_scatter``."""
    prior_scatter: float = 0.1
    sense: str | None = None
    serial: int = 0
    date: datetime.date | None = None

    @cached_property
    def structure(self) -> tuple[Geometry, tuple[Gauge, ...]] | None:
        """Dimensions and gauges of the layout. Raises InputError."""
        return read_layout(self.layout) if self.layout else None

    @cached_property
    def theory(self) -> FloatArray | None:
        """Beam theory of the layout, (n, 3), strain per newton."""
        return None if self.structure is None else gauge_matrix(*self.structure)

    @cached_property
    def model(self) -> Model:
        """The model that the flags ask for. Raises InputError for a prior without a layout."""
        if self.prior and self.structure is None:
            raise InputError("--prior beam needs --layout: the theory depends on where the gauges sit")
        prior = beam_prior(*self.structure, self.prior_scatter) if self.prior and self.structure else None
        scatter = float(np.radians(self.angle_scatter))
        return Model(
            offset=not self.no_offset, drift=self.drift or "none", loss=self.loss,
            phi_scatter_rad=scatter, theta_scatter_rad=scatter, prior=prior,
            noise_strain=None if self.noise is None else self.noise * 1e-6,
            saturation_strain=None if self.saturation is None else self.saturation * 1e-6,
        )  # fmt: skip

    def check_gauges(self, gauges: int, whose: str) -> None:
        """Raise InputError where the layout has another number of gauges."""
        if self.structure is not None and len(self.structure[1]) != gauges:
            raise InputError(f"--layout {self.layout} has {len(self.structure[1])} gauges, {whose} has {gauges}")


class Fitted(NamedTuple):
    """A fit, rounded, and the calibration that it gives."""

    request: FitRequest
    data: Measurements
    readings: Readings
    fit: Fit
    model: Model
    scores: dict[str, float]
    """Hold-out scores of the drifts that were tried."""
    calibration: Calibration


def fitted(request: FitRequest, data: Measurements, note: Callable[[str], None] = lambda _text: None) -> Fitted:
    """Fit measurements with loads; ``note`` takes a remark on the load sense. Raises InputError for flags that are not
    allowed, data that look like another unit or a converter's limit, and rows that determine no calibration."""
    if data.P_newtons is None or data.phi_rad is None or data.theta_rad is None:
        raise InputError("the data have no loads: the columns P_N, phi_deg, theta_deg are needed")
    P = np.where(data.unloaded, 0.0, data.P_newtons)  # a tare row has no load whatever its angles say
    readings = Readings(data.strain, P, data.phi_rad, data.theta_rad, data.t_s, data.weight, data.temperature_degC)
    require_degrees(readings)
    loads = np.stack((readings.P_newtons, readings.phi_rad, readings.theta_rad), axis=-1)
    require_no_rail(readings.strain, loads, request.model.saturation_strain, data.line)
    fit, model, scores = best_fit(readings, request.model, [request.drift] if request.drift else None)
    if request.theory is None:
        typical = np.sqrt(np.mean(np.square(strain_matrix(FABRICATED, "I"))))
        require_size(fit.A, np.full(fit.A.shape, typical), ALLOWED_WITHOUT, "a gauge of the paper's fingertip")
    else:
        require_size(fit.A, request.theory, ALLOWED_WITH_LAYOUT, str(request.layout))
        require_order(fit.A, request.theory, str(request.layout))
    fit = rounded(fit)
    return Fitted(request, data, readings, fit, model, scores, _calibration_of(request, data, fit, note))


def limit_of(fit: Fit, Sigma: FloatArray, dof: float, largest_newtons: float) -> float:
    """The limit of the redundancy check for one reading with the covariance Sigma, known with ``dof``."""
    return float(to_digits(redundancy_limit(fit.A, Sigma, fit.parameter_covariance, dof, largest_newtons), 6))


def _calibration_of(request: FitRequest, data: Measurements, fit: Fit, note: Callable[[str], None]) -> Calibration:
    code = CUSTOM_LAYOUT_CODE if request.structure is None else layout_code(request.structure[1])
    day = request.date or datetime.date.today()
    noise, parameters = map(to_digits, fit.record_covariances)
    return Calibration(
        fit.C, fit.offset_strain, noise, request.serial,
        day.year * 10000 + day.month * 100 + day.day, layout_code=code, pull=_pulls(request, data, note),
        parameter_covariance=parameters,
        **_validity_of(request, fit),
    )  # fmt: skip


def _validity_of(request: FitRequest, fit: Fit) -> dict[str, Any]:
    """Fields of the calibration: forces, temperatures, limits. What the data do not show stays 0 (not known)."""
    largest = max(load.P_newtons for load in fit.loads)
    straight, warm = fit.nonlinearity, fit.temperature
    fields: dict[str, Any] = {
        "calibrated_force_newtons": largest,
        "model_uncertainty": 0.0 if straight is None else float(to_digits(straight.model_uncertainty, 3)),
        "redundancy_limit": limit_of(fit, fit.noise_covariance_strain2, fit.noise_dof, largest),
    }
    if request.saturation is not None and np.isfinite(request.saturation):
        fields["converter_limit_strain"] = np.full(len(fit.A), request.saturation * 1e-6)
    if request.structure is not None:
        yield_pascals = None if request.yield_stress is None else request.yield_stress * 1e6
        overload = overload_newtons(request.structure[0], yield_pascals)
        fields["overload_force_newtons"] = float(to_digits(overload, 4)) if overload > largest else 0.0
    if warm is not None:
        fields |= {
            "reference_temperature_degC": warm.reference_degC,
            "temperature_min_degC": warm.lowest_degC,
            "temperature_max_degC": warm.highest_degC,
            "gain_temperature_per_K": float(to_digits(warm.gain_per_K, 6)) if warm.gain_fitted else 0.0,
        }
        if warm.offset_fitted:
            fields["offset_temperature_strain_per_K"] = to_digits(warm.offset_strain_per_K, 6)
    return fields


def _pulls(request: FitRequest, data: Measurements, note: Callable[[str], None]) -> bool:
    if request.sense or data.mode is None:
        return request.sense in ("pull", None)
    pushes, pulls = (bool((data.mode == MODES.index(name)).any()) for name in ("push", "pull"))
    if pushes and pulls:
        note("the data have pushes and pulls: the file says push; --sense pull for the other")
    return not pushes
