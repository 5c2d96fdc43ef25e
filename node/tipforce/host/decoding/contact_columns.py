"""Contact from gauges by the host's calibration, with standard uncertainties: of a log, and of `tipforce estimate`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.measurements import MODES, Measurements
from tipforce.host.decoding import judged
from tipforce.host.decoding.estimator import Before, Contacts, Estimator, estimate
from tipforce.host.decoding.health import lost_gauges
from tipforce.host.decoding.judged import Judge, Readings, frozen_gauges
from tipforce.host.decoding.sample_table import NODE_BITS, Table, Values, computed, flag, in_order, missing_of
from tipforce.samples import reasons
from tipforce.samples.reasons import Status

NEEDED_FLAGS = ("stale", "fault", "saturated")
"""The node's own word that a gauge reading is none."""
VALUES = (
    computed("P", "N"), computed("phi", "degree"), computed("theta", "degree"),
    computed("u_P", "N"), computed("u_phi", "degree"), computed("u_theta", "degree"),
)  # fmt: skip
FLAGS = reasons.COMPUTED
COLUMNS = (*VALUES, *(flag(name) for name in FLAGS))
"""The columns that this adds."""


def read_calibrations(texts: Iterable[str]) -> dict[int | None, Calibration]:
    """By node-id the calibrations that `5=thumb.toml` names; None for one without a node. Raises InputError."""
    found: dict[int | None, Calibration] = {}
    for text in texts:
        node_text, equals, path = text.partition("=")
        node = None
        if equals:
            try:
                node = int(node_text, 0)
            except ValueError:
                node = 0
            if not 1 <= node <= 127:
                raise InputError(f"--calibration {text}: write CAL.toml, or NODE=CAL.toml with a node-id from 1 to 127")
        if node in found:
            raise InputError(f"--calibration {text}: {'all nodes have' if node is None else f'node {node} has'} one")
        found[node] = Calibration.read(path if equals else text)
    return found


class ContactColumns:
    """Fills the contact of each sample that has all its gauges; nodes without a calibration keep what they sent."""

    def __init__(self, calibrations: Mapping[int | None, Calibration], asked: tuple[str, ...] | None) -> None:
        self._estimators = {node: Estimator(calibration) for node, calibration in calibrations.items()}
        self._asked = asked
        self._before: dict[int, Before] = {}
        self._first_ns: dict[int, int] = {}
        self._temperature_degC: dict[int, float] = {}

    def tables(self, tables: Iterable[Table]) -> Iterator[Table]:
        """Each table with its contact columns."""
        for table in tables:
            columns = {column.name: column for column in (*table.columns, *COLUMNS)}
            values = dict(table.values)
            for column in COLUMNS:
                before = values.get(column.name)
                values[column.name] = missing_of(column, len(table)) if before is None else before.copy()
            absent = {name: rows for name, rows in table.absent.items() if name not in {c.name for c in COLUMNS}}
            for key in np.unique(table.key).tolist():
                node = key & ((1 << NODE_BITS) - 1)
                estimator = self._estimators.get(node, self._estimators.get(None))
                if estimator is not None:
                    self._fill(estimator, key, np.flatnonzero(table.key == key), table, values)
            shown = [c for c in columns.values() if self._asked is None or c.signal in self._asked]
            ordered = in_order(shown, self._asked)
            yield replace(table, columns=ordered, values={c.name: values[c.name] for c in ordered}, absent=absent)

    def _fill(
        self, estimator: Estimator, key: int, rows: npt.NDArray[np.intp], table: Table, values: dict[str, Values]
    ) -> None:
        for column in COLUMNS:
            values[column.name][rows] = missing_of(column, len(rows))
        names = [f"SG{k + 1}_ue" for k in range(estimator.gauges)]
        if not set(names) <= set(table.values):
            return
        strain = np.stack([table.values[name][rows] for name in names], axis=-1) * 1e-6
        good = np.isfinite(strain).all(axis=1)
        for name in NEEDED_FLAGS[:2]:
            if name in table.values:
                good &= table.values[name][rows] != 1
        temperature = self._temperature(key, rows, table)
        lost = lost_gauges({name: table.values[name][rows] for name in table.values}, strain.shape)
        if "saturated" in table.values:
            # A gauge that the node left out and whose reading does not show why: which one, TPDO4 or EMCY told, or
            # nothing did.
            by_end = Readings(strain, lost=judged.at_end(1e6 * strain))
            shown = estimator.judge.judge(by_end, False).faults & judged.GAUGES
            good &= (table.values["saturated"][rows] != 1) | (lost != 0) | (shown != 0)
        rows, strain, temperature, lost = rows[good], strain[good], temperature[good], lost[good]
        if not len(rows):
            return
        first_ns = self._first_ns.setdefault(key, int(table.t_ns[rows[0]]))  # a log does not say when the node tared
        age_s = np.asarray(table.t_ns[rows] - first_ns, dtype=np.float64) * 1e-9
        given = Readings(strain, temperature, lost | judged.at_end(1e6 * strain), age_s=age_s)
        contacts, status, self._before[key] = estimator.rows(given, self._before.get(key, Before()))
        for column, column_values in zip(VALUES, contacts.values.T, strict=True):
            values[column.name][rows] = column_values
        for name, bit in FLAGS.items():
            values[name][rows] = status & bit != 0

    def _temperature(self, key: int, rows: npt.NDArray[np.intp], table: Table) -> FloatArray:
        """The temperature of each sample as the node sent it last, degC; NaN before it did."""
        if "temperature" not in table.values:
            return np.full(len(rows), self._temperature_degC.get(key, np.nan))
        found = judged.last_known(table.values["temperature"][rows], self._temperature_degC.get(key, np.nan))
        if len(found):
            self._temperature_degC[key] = float(found[-1])
        return found


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


def signals_needed(
    asked: Iterable[str] | None, calibrations: Mapping[int | None, Calibration]
) -> tuple[str, ...] | None:
    """What has to be decoded for what is asked: gauges and flags for the contact, and what else a frame carries.

    Temperature where a calibration depends on it, or says for which it holds.
    """
    if asked is None:
        return None
    kept = [name for name in asked if name not in {column.signal for column in COLUMNS}]
    temperature = any(
        tip.offset_temperature_strain_per_K.any()
        or tip.gain_temperature_per_K != 0.0
        or tip.temperature_min_degC != tip.temperature_max_degC
        for tip in calibrations.values()
    )
    gauges = [f"SG{k + 1}" for k in range(gauges_of(calibrations))]
    wanted = (*gauges, *NEEDED_FLAGS, *(("temperature",) if temperature else ()))
    return (*kept, *(name for name in wanted if name not in kept))


def is_computed(name: str) -> str | None:
    """The signal that a name of a computed column means, if it is one."""
    return next((column.signal for column in COLUMNS if name in {column.name, column.signal}), None)


def gauges_of(calibrations: Mapping[int | None, Calibration]) -> int:
    """The most gauges that a calibration has."""
    return max(tip.gauges for tip in calibrations.values())


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
    from tipforce.sensor.calibration.regressors import tare_groups  # not where a log is read

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
