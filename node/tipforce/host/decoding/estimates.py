"""Rows of `tipforce estimate`: offsets from tares, and the contact of each row with its uncertainty and status."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.measurements import MODES, Measurements
from tipforce.host.decoding.estimator import Before, Estimator
from tipforce.host.decoding.judged import Judge, Readings, frozen_gauges
from tipforce.samples import reasons
from tipforce.sensor.calibration.regressors import tare_groups


def estimates(
    calibration: Calibration, data: Measurements, saturation_microstrain: float | None = None
) -> Iterator[tuple[int, list[float], str]]:
    """Yield (line, [P_N, phi_deg, theta_deg, u_P_N, u_phi_deg, u_theta_deg], status) of each good row, in order.

    The uncertainty has the calibration's part where ``calibration.parameter_covariance`` is there.
    NaN is unknown; phi and theta are unknown where the status byte of a node would make them so.
    """
    weight = np.ones(len(data.line)) if data.weight is None else data.weight
    tares = _tares(data, weight, calibration)
    if saturation_microstrain is not None:
        own = calibration.converter_limit_strain
        limit = np.minimum(np.where(own > 0.0, own, np.inf), 1e-6 * saturation_microstrain)
        calibration = replace(calibration, converter_limit_strain=limit)
    if tares is not None and calibration.parameter_covariance is not None:
        blocks = calibration.parameter_covariance.copy()
        blocks[:, 3] = blocks[:, :, :, 3] = 0.0  # the tares give the offset, with a noise of their own
        calibration = replace(calibration, parameter_covariance=blocks)
    estimator = Estimator(calibration)
    given = Readings(
        data.strain,
        temperature_degC=data.temperature_degC,
        frozen=frozen_gauges(calibration, data.strain, weight),
        unloaded=data.unloaded,
        variance_factor=1.0 / weight,
    )
    if data.t_s is not None:  # without tares the age counts from the first row, the first that is known
        given = given._replace(age_s=data.t_s - data.t_s[:1])
    if tares is not None:
        offset, noise, age_s = tares
        given = given._replace(offset_strain=offset, variance_factor=1.0 / weight + noise)
        given = given._replace(age_s=None if data.t_s is None else age_s)
    if data.mode is not None:
        given = given._replace(pull=np.where(data.mode < 0, calibration.pull, data.mode == MODES.index("pull")))
    contacts, status, _ = estimator.rows(given, Before())
    words = {value: reasons.of_estimate(value) for value in np.unique(status).tolist()}
    for line, values, value in zip(data.line.tolist(), contacts.values.tolist(), status.tolist(), strict=True):
        yield line, values, words[value]


def _tares(
    data: Measurements, weight: FloatArray, calibration: Calibration
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """From the unloaded readings, those that follow each other averaged: the offset of each row, (m, n), interpolated,
    its noise in units of one reading's variance, (m,), and the time to the nearest tare, (m,), in rows where there are
    no times. Temperature is compensated where it is known. None without unloaded readings.
    """
    groups = tare_groups(data.unloaded, np.ones(len(data.line), dtype=np.bool_))
    if not groups:
        return None
    clock = data.t_s if data.t_s is not None else np.arange(len(data.line), dtype=np.float64)
    at = np.array([np.average(clock[group], weights=weight[group]) for group in groups])
    strain = Judge(calibration).compensated(data.strain, data.temperature_degC)
    tare = np.array([np.average(strain[group], axis=0, weights=weight[group]) for group in groups])
    readings = np.array([weight[group].sum() for group in groups])
    after = np.clip(np.searchsorted(at, clock), min(1, len(at) - 1), len(at) - 1)
    before = np.maximum(after - 1, 0)
    span = at[after] - at[before]
    share = np.clip((clock - at[before]) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)
    offset = tare[before] * (1.0 - share)[:, np.newaxis] + tare[after] * share[:, np.newaxis]
    noise = (1.0 - share) ** 2 / readings[before] + share**2 / readings[after]
    return offset, noise, np.minimum(np.abs(clock - at[before]), np.abs(clock - at[after]))
