"""Rows of `tipforce estimate`: offsets from tares, and the contact of each row with its uncertainty and status."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.measurements import MODES, Measurements
from tipforce.host.decoding.estimator import Before, Estimator
from tipforce.host.decoding.judged import Judge, Readings, frozen_gauges
from tipforce.samples import reasons
from tipforce.sensor.calibration.regressors import tare_groups


class Tares(NamedTuple):
    """Unloaded readings, those that follow each other averaged."""

    at: FloatArray
    """(k,): mean time, or mean row where there are no times."""
    offset_strain: FloatArray
    """(k, n)."""
    readings: FloatArray
    """(k,): how many (weighted) readings each is the mean of."""


def estimates(
    calibration: Calibration,
    data: Measurements,
    saturation_microstrain: float | None = None,
) -> Iterator[tuple[int, list[float], str]]:
    """Yield (line, [P_N, phi_deg, theta_deg, u_P_N, u_phi_deg, u_theta_deg], status) of each good row, in order.

    The uncertainty has the calibration's part where ``calibration.parameter_covariance`` is there.
    NaN is unknown; phi and theta are unknown where the status byte of a node would make them so.
    """
    tares, weight = tares_of(data, calibration), _weight(data)
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
        age_s=None if data.t_s is None else ages_s(data.t_s, None if tares is None else tares.at),
    )
    if tares is not None:
        offset, noise = _offsets(data, tares)
        given = given._replace(offset_strain=offset, variance_factor=1.0 / weight + noise)
    if data.mode is not None:
        given = given._replace(pull=np.where(data.mode < 0, calibration.pull, data.mode == MODES.index("pull")))
    contacts, status, _ = estimator.rows(given, Before())
    words = {value: reasons.of_estimate(value) for value in np.unique(status).tolist()}
    for line, values, value in zip(data.line.tolist(), contacts.values.tolist(), status.tolist(), strict=True):
        yield line, values, words[value]


def tares_of(data: Measurements, calibration: Calibration) -> Tares | None:
    """The tares of the data, their temperature compensated where it is known; None without unloaded readings."""
    groups = tare_groups(data.unloaded, np.ones(len(data.line), dtype=np.bool_))
    if not groups:
        return None
    clock, weight = _clock(data), _weight(data)
    at = np.array([np.average(clock[group], weights=weight[group]) for group in groups])
    strain = Judge(calibration).compensated(data.strain, data.temperature_degC)
    offset = np.array([np.average(strain[group], axis=0, weights=weight[group]) for group in groups])
    return Tares(at, offset, np.array([weight[group].sum() for group in groups]))


def _offsets(data: Measurements, tares: Tares) -> tuple[FloatArray, FloatArray]:
    """The offset of each row, (m, n), and its noise in units of one reading's variance, (m,)."""
    clock = _clock(data)
    after = np.clip(np.searchsorted(tares.at, clock), 1, max(len(tares.at) - 1, 1)) if len(tares.at) > 1 else 0
    before = np.maximum(np.asarray(after) - 1, 0)
    span = tares.at[after] - tares.at[before]
    share = np.clip((clock - tares.at[before]) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)
    offset = tares.offset_strain[before] * (1.0 - share)[:, np.newaxis]
    offset = offset + tares.offset_strain[after] * share[:, np.newaxis]
    return offset, (1.0 - share) ** 2 / tares.readings[before] + share**2 / tares.readings[after]


def _clock(data: Measurements) -> FloatArray:
    return data.t_s if data.t_s is not None else np.arange(len(data.line), dtype=np.float64)


def _weight(data: Measurements) -> FloatArray:
    return np.ones(len(data.line)) if data.weight is None else data.weight


def ages_s(t_s: FloatArray, tared_at_s: FloatArray | None) -> FloatArray:
    """Seconds of each row, (m,), to the nearest tare (k,); None: since the first row, the first that is known."""
    if tared_at_s is None:
        return t_s - t_s[:1]
    after = np.clip(np.searchsorted(tared_at_s, t_s), 0, len(tared_at_s) - 1)
    before = np.maximum(after - 1, 0)
    nearest: FloatArray = np.minimum(np.abs(t_s - tared_at_s[before]), np.abs(t_s - tared_at_s[after]))
    return nearest
