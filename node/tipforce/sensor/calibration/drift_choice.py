"""Which drift of the offsets, and whether they follow temperature: what predicts left-out rows best."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tipforce.errors import InputError
from tipforce.sensor.calibration.data import Model, Readings
from tipforce.sensor.calibration.fit import fit_calibration
from tipforce.sensor.calibration.regressors import tare_groups
from tipforce.sensor.calibration.result import Fit

SMALLEST_SPAN_K = 0.5
"""Change of temperature below which its effect on the offsets is not asked for."""


def best_fit(readings: Readings, model: Model) -> tuple[Fit, Model, dict[str, float]]:
    """Return the fit of the drift that the hold-out score prefers, its model, and the scores by name.

    Candidates: no drift, linear where the rows have times, tare where unloaded readings at two times allow it; each
    also with a temperature coefficient of the offsets where temperatures change. Raises InputError as
    fit_calibration() does where no candidate can be fitted.
    """
    fits: dict[str, tuple[Fit, Model]] = {}
    refused: InputError | None = None
    for drift in _drifts(readings, model):
        for warm in (False, True) if _warms(readings, model) else (False,):
            tried = replace(model, drift=drift, temperature=warm)  # type: ignore[arg-type]
            try:
                fits[f"{drift} and temperature" if warm else drift] = fit_calibration(readings, tried), tried
            except InputError as error:
                refused = refused or error
    if not fits:
        raise refused or InputError("no model can be fitted to these rows")
    if refused is not None and "none" not in fits:
        raise refused
    best = max(fits, key=lambda name: fits[name][0].hold_out_score)
    return *fits[best], {name: fit.hold_out_score for name, (fit, _) in fits.items()}


def fit_with_drift(readings: Readings, model: Model) -> tuple[Fit, Model, dict[str, float]]:
    """Return the same for the drift of the model alone; only the temperature coefficient is chosen."""
    fits = []
    for warm in (False, True) if _warms(readings, model) else (False,):
        tried = replace(model, temperature=warm)
        try:
            fits.append((fit_calibration(readings, tried), tried))
        except InputError:
            if not fits:
                raise
    fit, model = max(fits, key=lambda one: one[0].hold_out_score)
    return fit, model, {model.drift: fit.hold_out_score}


def _drifts(readings: Readings, model: Model) -> list[str]:
    if not model.offset or readings.t_s is None:
        return ["none"]
    found = ["none", "linear"] if np.ptp(readings.t_s) > 0.0 else ["none"]
    usable = np.ones(len(readings.P_newtons), dtype=np.bool_)
    if len(tare_groups(np.asarray(readings.P_newtons) == 0.0, usable)) > 2:
        found.append("tare")
    return found


def _warms(readings: Readings, model: Model) -> bool:
    T = readings.temperature_degC
    return bool(model.offset and T is not None and np.isfinite(T).all() and np.ptp(T) >= SMALLEST_SPAN_K)
