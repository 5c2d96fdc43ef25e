"""Estimates of `tipforce estimate`: offsets from tares, contact, uncertainty and status of each row."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.measurement_rows import MODES
from tipforce.host.configuration.measurements import Measurements
from tipforce.host.decoding.contacts import Contacts, Status
from tipforce.sensor.calibration.fit import covariance_of_estimate
from tipforce.sensor.calibration.regressors import tare_groups
from tipforce.sensor.contact import estimate as model
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.first_order import first_order_holds
from tipforce.sensor.contact.force import force_from_strain

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
CHUNK = 50_000

BEYOND_FIRST_ORDER, SATURATED, TARE = 1 << 8, 1 << 9, 1 << 10
"""Beside the bits of the status byte, in one integer per row."""
_WORDS = {
    scalar.CONTACT_PRESENT: "no_contact",  # said where the bit is clear
    scalar.THETA_UNRESOLVED: "theta_unresolved",
    scalar.MISSES_TIP: "misses_tip",
    scalar.OUTSIDE_PAD: "outside_pad",
    BEYOND_FIRST_ORDER: "beyond_first_order",
}


class Tares(NamedTuple):
    """Unloaded readings, those that follow each other averaged."""

    at: FloatArray
    """(k,): mean time, or mean row where there are no times."""
    offset_strain: FloatArray
    """(k, n)."""
    readings: FloatArray
    """(k,): how many (weighted) readings each is the mean of."""


class Estimates(NamedTuple):
    """Some rows: values and status."""

    values: FloatArray
    """(rows, 6): P, phi, theta and their standard uncertainties, newtons and degrees; NaN where unknown."""
    status: npt.NDArray[np.int64]
    """(rows,): the status byte's bits 0, 4, 5, 6, and the bits above."""


def tares_of(data: Measurements) -> Tares | None:
    """The tares of the data; None without unloaded readings."""
    groups = tare_groups(data.unloaded, np.ones(len(data.line), dtype=np.bool_))
    if not groups:
        return None
    clock, weight = _clock(data), _weight(data)
    at = np.array([np.average(clock[group], weights=weight[group]) for group in groups])
    offset = np.array([np.average(data.strain[group], axis=0, weights=weight[group]) for group in groups])
    return Tares(at, offset, np.array([weight[group].sum() for group in groups]))


def estimates(
    calibration: Calibration,
    data: Measurements,
    saturation_microstrain: float | None = None,
) -> Iterator[tuple[int, list[float], str]]:
    """Yield (line, [P_N, phi_deg, theta_deg, u_P_N, u_phi_deg, u_theta_deg], status) of each good row, in order.

    The uncertainty has the calibration's part where ``calibration.parameter_covariance`` is there.
    NaN is unknown; phi and theta are unknown where the status byte of a node would make them so.
    """
    limit = np.inf if saturation_microstrain is None else saturation_microstrain * 1e-6
    tares, was_present, words = tares_of(data), False, dict[int, str]()
    for start in range(0, len(data.line), CHUNK):
        found = estimated(calibration, data, slice(start, start + CHUNK), tares, limit, was_present)
        loaded = found.status[(found.status & TARE) == 0]
        was_present = bool(loaded[-1] & scalar.CONTACT_PRESENT) if loaded.size else was_present
        lines = data.line[start : start + CHUNK].tolist()
        for line, values, status in zip(lines, found.values.tolist(), found.status.tolist(), strict=True):
            if status not in words:
                words[status] = _in_words(status)
            yield line, values, words[status]


def estimate(calibration: Calibration, microstrain: npt.ArrayLike, *, was_present: bool = False) -> Contacts:
    """Contact, standard uncertainties and status of gauge readings, as `tipforce estimate` gives them.

    microstrain: (k, n) of n gauges in time order, or (n,) for one reading. ``was_present``: contact before the first.
    A reading that is not finite makes all unknown. Raises InputError for other shapes.
    """
    strain = np.asarray(microstrain, dtype=np.float64) * 1e-6
    if strain.ndim == 1:
        strain = strain[np.newaxis]
    if strain.ndim != 2 or strain.shape[1] != calibration.gauges:
        n = calibration.gauges
        raise InputError(f"microstrain has the shape {np.shape(microstrain)}: allowed are (k, {n}) and ({n},)")
    data = Measurements(np.arange(len(strain)), strain, None, None, None, None, None, None, None, (), ())
    found = estimated(calibration, data, slice(None), None, np.inf, was_present)
    status = (found.status & 0xFF | Status.CALIBRATED).astype(np.uint16)
    status |= np.where(found.status & BEYOND_FIRST_ORDER, np.uint16(Status.BEYOND_FIRST_ORDER), np.uint16(0))
    P, phi, theta, u_P, u_phi, u_theta = found.values.T
    return Contacts(P, phi, theta, u_P, u_phi, u_theta, status)


def estimated(
    calibration: Calibration,
    data: Measurements,
    rows: slice,
    tares: Tares | None,
    limit: float,
    was_present: bool,
) -> Estimates:
    """Estimates of some rows that follow each other; ``was_present``: contact before the first of them.

    limit: the converter's, strain (inf: none).
    """
    V = data.strain[rows]
    offset, tare_noise = _offsets(calibration, data, rows, tares)
    F = force_from_strain(calibration.C, V - offset)
    covariance = np.zeros((*F.shape, 3))
    if calibration.parameter_covariance is not None:
        nothing, blocks = np.zeros_like(calibration.covariance_strain2), calibration.parameter_covariance
        covariance = covariance_of_estimate(calibration.C, nothing, blocks, F, offset_known=tares is not None)
    covariance += calibration.covariance_F * (1.0 / _weight(data)[rows] + tare_noise)[:, np.newaxis, np.newaxis]
    pull = np.full(len(V), calibration.pull)
    if data.mode is not None:
        mode = data.mode[rows]
        pull = np.where(mode < 0, pull, mode == MODES.index("pull"))
    found, u = _both_senses(F, covariance, pull)
    unloaded, saturated = data.unloaded[rows], (np.abs(V) >= limit).any(axis=1)
    counts = ~(unloaded | saturated)
    status = np.where(unloaded, TARE, np.where(saturated, SATURATED, 0))
    limits = model.Limits(
        calibration.contact_on_newtons,
        calibration.contact_off_newtons,
        calibration.theta_min_deg,
        calibration.theta_max_deg,
    )
    chosen = model.Contact(*(getattr(found, name)[counts] for name in model.Contact.__slots__))
    miss = model.miss_uncertainties(F[counts], covariance[counts])
    status[counts] = model.status(chosen, u[counts], miss, limits, was_present)
    values = _in_degrees(np.stack((found.P_newtons, found.phi_rad, found.theta_rad), axis=-1), u)
    values[~counts] = np.nan
    known = _known(status)
    values[:, [1, 4]] = np.where(known[:, :1], values[:, [1, 4]], np.nan)
    values[:, [2, 5]] = np.where(known[:, 1:], values[:, [2, 5]], np.nan)
    holds = first_order_holds(F, covariance) | ~np.isfinite(values[:, 3:])
    status[counts & ~holds.all(axis=1)] |= BEYOND_FIRST_ORDER
    return Estimates(values, status)


def _in_degrees(values: FloatArray, u: FloatArray) -> FloatArray:
    unit = np.array([1.0, scalar.DEGREES, scalar.DEGREES])
    return np.concatenate((values * unit, u * unit), axis=1)


def _both_senses(F: FloatArray, covariance: FloatArray, pull: BoolArray) -> tuple[model.Contact, FloatArray]:
    """Contacts and standard uncertainties, each row by its own load sense; what no row needs is not computed."""
    if pull.all() or not pull.any():
        sense = bool(pull.all())
        return model.contacts(F, pull=sense), model.standard_uncertainties(F, covariance, pull=sense)
    senses = [model.contacts(F, pull=sense) for sense in (True, False)]
    fields = ([getattr(found, name) for found in senses] for name in model.Contact.__slots__)
    u = [model.standard_uncertainties(F, covariance, pull=sense) for sense in (True, False)]
    return model.Contact(*(np.where(pull, *field) for field in fields)), np.where(pull[:, np.newaxis], *u)


def _known(status: npt.NDArray[np.int64]) -> BoolArray:
    """Whether phi and theta are known, (rows, 2), as scalar.unknown() says."""
    known = np.ones((status.size, 2), dtype=np.bool_)
    for value in np.unique(status & 0xFF):
        lost = scalar.unknown(int(value) | scalar.CALIBRATED)
        known[(status & 0xFF) == value] = [not lost & scalar.UNKNOWN_PHI, not lost & scalar.UNKNOWN_THETA]
    return known


def _offsets(
    calibration: Calibration, data: Measurements, rows: slice, tares: Tares | None
) -> tuple[FloatArray, FloatArray]:
    """The offset of each row, (rows, n) or (n,), and its noise in units of one reading's variance, (rows,)."""
    clock = _clock(data)[rows]
    if tares is None:
        return calibration.offset_strain, np.zeros(clock.size)
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


def _in_words(status: int) -> str:
    for bit, word in ((TARE, "tare"), (SATURATED, "saturated")):
        if status & bit:
            return word
    shown = status ^ scalar.CONTACT_PRESENT
    return " ".join(word for bit, word in _WORDS.items() if shown & bit) or "ok"
