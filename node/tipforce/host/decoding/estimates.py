"""Estimates of `tipforce estimate`: offsets from tares, contact, uncertainty and status of each row."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray, floats
from tipforce.errors import InputError
from tipforce.fingertip.application import FROZEN_READINGS
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.measurements import LARGEST_MICROSTRAIN, MODES, Measurements
from tipforce.host.decoding import judged
from tipforce.host.decoding.health import lost_gauges
from tipforce.samples import reasons
from tipforce.samples.reasons import Status
from tipforce.sensor.calibration.fit import covariance_of_estimate
from tipforce.sensor.calibration.regressors import tare_groups
from tipforce.sensor.contact import estimate as model
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.estimate import first_order_holds

CHUNK = 50_000


@dataclass(frozen=True, slots=True, eq=False)
class Contacts:
    """k samples of one finger; NaN stands for unknown. Uncertainties are standard uncertainties (1 sigma)."""

    P_newtons: FloatArray
    """(k,) force magnitude."""
    phi_deg: FloatArray
    """(k,) force direction, (-180, 180]."""
    theta_deg: FloatArray
    """(k,) contact angle."""
    u_P_newtons: FloatArray
    u_phi_deg: FloatArray
    u_theta_deg: FloatArray
    status: npt.NDArray[np.integer[Any]]
    """(k,) bits of ``Status``, uint16."""

    def __len__(self) -> int:
        return len(self.status)

    @property
    def values(self) -> FloatArray:
        """(k, 6) the values and their uncertainties, in this order."""
        names = ("P_newtons", "phi_deg", "theta_deg", "u_P_newtons", "u_phi_deg", "u_theta_deg")
        return np.stack([getattr(self, name) for name in names], axis=-1)

    def has(self, status: Status) -> npt.NDArray[np.bool_]:
        """(k,) the samples with any of these bits."""
        found: npt.NDArray[np.bool_] = (self.status & np.uint16(status)) != 0
        return found


class Tares(NamedTuple):
    """Unloaded readings, those that follow each other averaged."""

    at: FloatArray
    """(k,): mean time, or mean row where there are no times."""
    offset_strain: FloatArray
    """(k, n)."""
    readings: FloatArray
    """(k,): how many (weighted) readings each is the mean of."""


class Before(NamedTuple):
    """What the sample before leaves for its successor."""

    present: bool = False
    overloaded: bool = False


def tares_of(data: Measurements, calibration: Calibration) -> Tares | None:
    """The tares of the data, their temperature compensated where it is known; None without unloaded readings."""
    groups = tare_groups(data.unloaded, np.ones(len(data.line), dtype=np.bool_))
    if not groups:
        return None
    clock, weight = _clock(data), _weight(data)
    at = np.array([np.average(clock[group], weights=weight[group]) for group in groups])
    strain = judged.Judge(calibration).compensated(data.strain, data.temperature_degC)
    offset = np.array([np.average(strain[group], axis=0, weights=weight[group]) for group in groups])
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
    limit = None if saturation_microstrain is None else saturation_microstrain * 1e-6
    tares, before, words = tares_of(data, calibration), Before(), dict[int, str]()
    still = frozen_gauges(calibration, data.strain, _weight(data))
    age_s = None if data.t_s is None else ages_s(data.t_s, None if tares is None else tares.at)
    for start in range(0, len(data.line), CHUNK):
        rows = slice(start, start + CHUNK)
        age = None if age_s is None else age_s[rows]
        found = estimated(calibration, data, rows, tares, limit, before, frozen=still[rows], age_s=age)
        before = following(found, before)
        lines = data.line[start : start + CHUNK].tolist()
        for line, values, status in zip(lines, found.values.tolist(), found.status.tolist(), strict=True):
            if status not in words:
                words[status] = reasons.of_estimate(status)
            yield line, values, words[status]


def following(found: Contacts, before: Before) -> Before:
    """What the last sample leaves for the next; rows without a force leave contact as it was."""
    sensed = found.status[(found.status & reasons.NO_ESTIMATE) == 0]
    present = bool(sensed[-1] & scalar.CONTACT_PRESENT) if sensed.size else before.present
    overloaded = bool(found.status[-1] & reasons.OVERLOAD) if found.status.size else before.overloaded
    return Before(present, overloaded)


def estimate(
    calibration: Calibration,
    microstrain: npt.ArrayLike,
    *,
    temperature_degC: npt.ArrayLike | None = None,
    lost: IntArray | None = None,
    was_present: bool = False,
) -> Contacts:
    """Contact, standard uncertainties and status of gauge readings, as `tipforce estimate` gives them.

    microstrain: (k, n) of n gauges in time order, or (n,) for one reading. ``temperature_degC``: (k,) or one number,
    NaN or None where it is not known. ``lost``: (k,), bits of gauges that something else says have failed.
    ``was_present``: contact before the first. A reading that is not finite, or over 1e6 microstrain, makes all unknown;
    a gauge that stands still for longer than its noise allows counts as lost. Raises InputError for other shapes.
    """
    readings = np.atleast_2d(floats("microstrain", microstrain))
    if readings.ndim != 2 or readings.shape[1] != calibration.gauges:
        n = calibration.gauges
        raise InputError(f"microstrain has the shape {np.shape(microstrain)}: allowed are (k, {n}) and ({n},)")
    strain = np.where(np.abs(readings) <= LARGEST_MICROSTRAIN, readings, np.nan) * 1e-6
    temperature = None
    if temperature_degC is not None:
        temperature = _of_rows("temperature_degC", floats("temperature_degC", temperature_degC), len(strain))
    if lost is not None:
        lost = _of_rows("lost", np.asarray(lost), len(strain))
        if not np.issubdtype(lost.dtype, np.integer):
            raise InputError(f"lost has the type {lost.dtype}: allowed are integers, bits of gauges")
    data = Measurements(np.arange(len(strain)), strain, None, None, None, None, temperature, None, None, (), ())
    still = frozen_gauges(calibration, data.strain, _weight(data))
    found = estimated(calibration, data, slice(None), None, None, Before(was_present), lost, still)
    status = (found.status & 0xFFFF | Status.CALIBRATED).astype(np.uint16)
    for bits, flag in (
        (reasons.LEFT_OUT | reasons.OVERLOAD, Status.SATURATED),
        (reasons.CONTRADICTION | reasons.FROZEN, Status.FAULT),
    ):
        status |= np.where(found.status & bits, np.uint16(flag), np.uint16(0))
    return replace(found, status=status)


def of_samples(
    calibration: Calibration,
    columns: Mapping[str, npt.NDArray[Any]],
    microstrain: FloatArray,
    status: npt.NDArray[np.uint16],
    rows: npt.NDArray[np.intp],
    temperature_degC: FloatArray | None = None,
    was_present: bool = False,
) -> tuple[Contacts, BoolArray]:
    """Contact of some ``rows`` of a node's samples, and which hold: where the node left a gauge out, it must be known.

    ``columns``, ``microstrain`` (k, n), ``status`` and ``temperature_degC`` (k,) are those of all samples.
    """
    missing = lost_gauges(columns, microstrain.shape)[rows] | judged.at_end(microstrain[rows])
    temperature = None if temperature_degC is None else temperature_degC[rows]
    contacts = estimate(
        calibration, microstrain[rows], temperature_degC=temperature, lost=missing, was_present=was_present
    )
    return contacts, (status[rows] & np.uint16(Status.SATURATED) == 0) | contacts.has(Status.SATURATED)


def _of_rows(name: str, values: npt.NDArray[Any], rows: int) -> npt.NDArray[Any]:
    if values.shape not in {(), (rows,)}:
        raise InputError(f"{name} has the shape {values.shape}: allowed are one number and ({rows},)")
    return np.broadcast_to(values, rows)


def estimated(
    calibration: Calibration,
    data: Measurements,
    rows: slice,
    tares: Tares | None,
    limit: float | None,
    before: Before,
    lost: IntArray | None = None,
    frozen: IntArray | None = None,
    age_s: FloatArray | None = None,
) -> Contacts:
    """Estimates of some rows that follow each other; their status has ``reasons.FROZEN`` and ``TARE``, too.

    before: what the sample before the first of them left.
    limit: the converter's, strain, beside the calibration's own (2113h); None: that alone. lost: (rows,), bits of
    gauges that something else says have failed; frozen: those that stand still;
    age_s: (rows,), of the tare.
    """
    strain = data.strain[rows]
    temperature = None if data.temperature_degC is None else data.temperature_degC[rows]
    at_limit = _at_limit(calibration, strain, limit)
    missing = at_limit if lost is None else at_limit | lost
    still = np.zeros_like(missing) if frozen is None else frozen
    judge = judged.Judge(calibration)
    offset, tare_noise = _offsets(calibration, data, rows, tares)
    factor = 1.0 / _weight(data)[rows] + tare_noise
    V = judge.compensated(strain, temperature) - offset
    found = judge.judge(V, temperature, missing | still, before.overloaded, factor)
    F, covariance = found.F_newtons, found.covariance
    if calibration.parameter_covariance is not None:
        covariance = covariance + _of_calibration(calibration, found, tares is not None)
    if age_s is not None and calibration.tare_drift_strain_per_s > 0.0:
        covariance = covariance + covariance_of_age(calibration, found.matrix, age_s)
    pull = np.full(len(V), calibration.pull)
    if data.mode is not None:
        mode = data.mode[rows]
        pull = np.where(mode < 0, pull, mode == MODES.index("pull"))
    contact, u = _both_senses(F, covariance, pull)
    status = _judged_status(found, data.unloaded[rows], missing, still)
    counts = (status & reasons.NO_ESTIMATE) == 0
    if not calibration.calibrated_force_newtons > 0.0:
        status[counts] |= reasons.UNRANGED
    limits = model.Limits(
        calibration.contact_on_newtons,
        calibration.contact_off_newtons,
        calibration.theta_min_deg,
        calibration.theta_max_deg,
    )
    chosen = model.Contact(*(getattr(contact, name)[counts] for name in model.Contact.__slots__))
    miss = model.miss_uncertainties(F[counts], covariance[counts])
    status[counts] |= model.status(chosen, u[counts], miss, limits, before.present)
    values = _in_degrees(np.stack((contact.P_newtons, contact.phi_rad, contact.theta_rad), axis=-1), u)
    values[~counts] = np.nan
    known = _known(status)
    values[:, [1, 4]] = np.where(known[:, :1], values[:, [1, 4]], np.nan)
    values[:, [2, 5]] = np.where(known[:, 1:], values[:, [2, 5]], np.nan)
    holds = first_order_holds(F, covariance) | ~np.isfinite(values[:, 3:])
    status[counts & ~holds.all(axis=1)] |= reasons.BEYOND_FIRST_ORDER
    P, phi, theta, u_P, u_phi, u_theta = values.T
    return Contacts(P, phi, theta, u_P, u_phi, u_theta, status)


def _at_limit(calibration: Calibration, strain: FloatArray, limit: float | None) -> IntArray:
    """Bits of the gauges at the converter's limit, the smaller one of the calibration's and ``limit``."""
    own = calibration.converter_limit_strain
    limits = np.where(own > 0.0, own, np.inf)
    if limit is not None:
        limits = np.minimum(limits, limit)
    with np.errstate(invalid="ignore"):
        reached = np.abs(strain) >= limits
    bits: IntArray = reached @ (1 << np.arange(strain.shape[1]))
    return bits


def _judged_status(found: judged.Judged, unloaded: BoolArray, missing: IntArray, still: IntArray) -> IntArray:
    """The bits that are known before any contact is."""
    known = np.isfinite(found.F_newtons).all(axis=1)
    contradict = (found.faults & reasons.CONTRADICTION) != 0
    status = found.faults & (reasons.BEYOND_CALIBRATED | reasons.TEMPERATURE | reasons.OVERLOAD)
    status |= np.where(contradict & ~known, reasons.CONTRADICTION, 0)
    status |= np.where(known & ((found.faults & judged.GAUGES) != 0), reasons.LEFT_OUT, 0)
    lost = ~known & ~contradict
    status |= np.where(lost & (missing != 0), scalar.SATURATED, np.where(lost & (still != 0), reasons.FROZEN, 0))
    marked: IntArray = np.where(unloaded, reasons.TARE, status)
    return marked


def _of_calibration(calibration: Calibration, found: judged.Judged, offset_known: bool) -> FloatArray:
    """The calibration's part of the covariance of F, (m, 3, 3); rows that do without a gauge have their own matrix."""
    nothing, blocks = np.zeros_like(calibration.covariance_strain2), calibration.parameter_covariance
    assert blocks is not None
    covariance = np.zeros((*found.F_newtons.shape, 3))
    left = found.faults & judged.GAUGES
    known = np.isfinite(found.F_newtons).all(axis=1)
    for mask in np.unique(left[known]).tolist():
        rows = known & (left == mask)
        C = found.matrix[np.flatnonzero(rows)[0]]
        covariance[rows] = covariance_of_estimate(C, nothing, blocks, found.F_newtons[rows], offset_known=offset_known)
    return covariance


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


def frozen_gauges(calibration: Calibration, strain: FloatArray, weight: FloatArray) -> IntArray:
    """Bits of the gauges that repeat one reading more often than their noise allows, (m,).

    strain: (m, n) in time order, all of a table; weight: (m,), readings that a row averages. The smallest step in the
    table is its resolution: a gauge with less noise may repeat itself. All rows of a run are marked, the first ones
    too, which a node cannot know yet. At an end of the converter a gauge is saturated, not frozen.
    """
    found = np.zeros(len(strain), dtype=np.int64)
    steps = np.abs(np.diff(strain, axis=0))
    moved = steps[steps > 0.0]
    if len(strain) <= FROZEN_READINGS or not moved.size:
        return found
    noise = np.sqrt(np.diagonal(calibration.covariance_strain2) / weight.max())
    noisy = noise >= moved.min() * (1.0 - 1e-6)
    for gauge in np.flatnonzero(noisy).tolist():
        run = np.concatenate(([0], np.cumsum(steps[:, gauge] != 0.0)))
        found |= np.where(np.bincount(run)[run] > FROZEN_READINGS, 1 << gauge, 0)
    return found & ~judged.at_end(1e6 * strain)


def ages_s(t_s: FloatArray, tared_at_s: FloatArray | None) -> FloatArray:
    """Seconds of each row, (m,), to the nearest tare (k,); None: since the first row, the first that is known."""
    if tared_at_s is None:
        return t_s - t_s[:1]
    after = np.clip(np.searchsorted(tared_at_s, t_s), 0, len(tared_at_s) - 1)
    before = np.maximum(after - 1, 0)
    nearest: FloatArray = np.minimum(np.abs(t_s - tared_at_s[before]), np.abs(t_s - tared_at_s[after]))
    return nearest


def covariance_of_age(calibration: Calibration, matrix: FloatArray, age_s: FloatArray) -> FloatArray:
    """The covariance (m, 3, 3), N^2, of offsets that have drifted for ``age_s``, each gauge by itself.

    matrix: (m, 3, n), without the gauges left out. The drift rate is the standard deviation of a rate that stays.
    """
    drifted = np.square(calibration.tare_drift_strain_per_s * age_s)
    covariance: FloatArray = drifted[:, np.newaxis, np.newaxis] * (matrix @ matrix.transpose(0, 2, 1))
    return covariance
