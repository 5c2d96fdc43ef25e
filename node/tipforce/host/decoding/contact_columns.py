"""Contact from gauges by the host's calibration, with standard uncertainties: of a log, and of `tipforce estimate`."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray, occurring
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.measurements import MODES, Measurements
from tipforce.host.decoding import judged
from tipforce.host.decoding.estimator import FEW, Before, Contacts, Estimator
from tipforce.host.decoding.health import lost_gauges
from tipforce.host.decoding.judged import Judge, Readings, Still, frozen_gauges
from tipforce.host.decoding.sample_table import Table, Values, computed, flag, in_order, missing_of, node_of
from tipforce.samples import reasons
from tipforce.samples.reasons import Status, status_of

NEEDED_FLAGS = ("stale", "fault", "saturated")
"""The node's own word that a gauge reading is none."""
_NO_READING = np.uint16(Status.NO_ANSWER | Status.STALE | Status.FAULT)
VALUES = (
    computed("P", "N"), computed("phi", "degree"), computed("theta", "degree"),
    computed("u_P", "N"), computed("u_phi", "degree"), computed("u_theta", "degree"),
)  # fmt: skip
FLAGS = reasons.COMPUTED
COLUMNS = (*VALUES, *(flag(name) for name in FLAGS))
"""The columns that this adds."""


def read_calibrations(texts: Iterable[str]) -> dict[int | None, Calibration]:
    """By node-id the calibrations that `5=thumb.toml` names; None for one without a node. Raises InputError."""
    calibrations: dict[int | None, Calibration] = {}
    for text in texts:
        node_text, equals, path = text.partition("=")
        node = None
        if equals:
            with suppress(ValueError):
                node = int(node_text, 0)
            if node is None or not 1 <= node <= 127:
                raise InputError(f"--calibration {text}: write CAL.toml, or NODE=CAL.toml with a node-id from 1 to 127")
        if node in calibrations:
            raise InputError(f"--calibration {text}: {'all nodes have' if node is None else f'node {node} has'} one")
        calibrations[node] = Calibration.read(path if equals else text)
    return calibrations


class ContactColumns:
    """Fills the contact of each sample that has all its gauges; nodes without a calibration keep what they sent."""

    def __init__(self, calibrations: Mapping[int | None, Calibration], asked: tuple[str, ...] | None) -> None:
        self._estimators = {node: Estimator(calibration) for node, calibration in calibrations.items()}
        self._asked = asked
        self._history: dict[int, History] = {}

    def tables(self, tables: Iterable[Table]) -> Iterator[Table]:
        """Each table with its contact columns."""
        for table in tables:
            columns = {column.name: column for column in (*table.columns, *COLUMNS)}
            own = {column.name: missing_of(column, len(table)) for column in COLUMNS}
            own |= {name: table.values[name].copy() for name in own.keys() & table.values.keys()}
            for key in occurring(table.key):
                estimator = self._estimators.get(node_of(key), self._estimators.get(None))
                if estimator is not None:
                    self._fill(estimator, key, np.flatnonzero(table.key == key), table, own)
            shown = [c for c in columns.values() if self._asked is None or c.signal in self._asked]
            values, absent = table.values | own, {name: of for name, of in table.absent.items() if name not in own}
            yield table.of_columns(in_order(shown, self._asked), values, absent)

    def _fill(
        self, estimator: Estimator, key: int, rows: npt.NDArray[np.intp], table: Table, values: dict[str, Values]
    ) -> None:
        for column in COLUMNS:
            values[column.name][rows] = missing_of(column, len(rows))
        names = [f"SG{k + 1}_ue" for k in range(estimator.gauges)]
        if not set(names) <= set(table.values):
            return
        microstrain = np.stack([table.values[name][rows] for name in names], axis=-1)
        columns = {column.signal: table.values[column.name][rows] for column in table.columns}
        history = self._history.setdefault(key, History(still=Still(estimator.judge.calibration)))
        status = status_of(columns, (len(rows),))
        held, contacts = of_samples(estimator, columns, microstrain, status, history, table.t_ns[rows])
        # Of a saturated sample without a force nothing is said but what TPDO4 or EMCY told.
        told = lost_gauges(columns, microstrain.shape) != 0
        said = np.isfinite(contacts.P_newtons) | (status & Status.SATURATED == 0)[held] | told[held]
        at = rows[held[said]]
        for column, column_values in zip(VALUES, contacts.values.T, strict=True):
            values[column.name][at] = column_values[said]
        for name, bit in FLAGS.items():
            values[name][at] = contacts.status[said] & bit != 0


@dataclass(slots=True)
class History:
    """What the samples of a node leave for those that follow; ``still``: where they come table by table."""

    before: Before = field(default_factory=Before)
    still: Still | None = None
    temperature_degC: float = float("nan")
    first_ns: int | None = None

    def temperatures(self, columns: Mapping[str, npt.NDArray[Any]], k: int) -> FloatArray | None:
        """The temperature of k samples as the node sent it last, degC; NaN before it did; None: it never did."""
        if "temperature" not in columns and np.isnan(self.temperature_degC):
            return None
        found = judged.last_known(columns.get("temperature", np.full(k, np.nan)), self.temperature_degC)
        self.temperature_degC = float(found[-1]) if k else self.temperature_degC
        return found

    def frozen(self, calibration: Calibration, strain: FloatArray, rows: npt.NDArray[np.intp]) -> IntArray | None:
        """Bits of the gauges that stand still in these rows of strain (k, n): (k,); None: none does."""
        still = frozen_gauges(calibration, strain[rows]) if self.still is None else self.still.frozen(strain[rows])
        if still is None:
            return None
        bits = np.zeros(len(strain), dtype=np.int64)
        bits[rows] = still
        return bits


def of_samples(
    estimator: Estimator, columns: Mapping[str, npt.NDArray[Any]], microstrain: FloatArray,
    status: npt.NDArray[np.uint16], history: History, t_ns: npt.NDArray[np.int64] | None = None,
) -> tuple[npt.NDArray[np.intp], Contacts]:  # fmt: skip
    """The rows of k samples whose gauges can be read, (m,), and their contacts; history goes on. ``microstrain``: (k,
    n); ``t_ns``: for the tare's age. A sample without a gauge, where nothing shows which, has no row."""
    calibration, k = estimator.judge.calibration, len(status)
    temperature = history.temperatures(columns, k)
    lost = lost_gauges(columns, microstrain.shape) | judged.at_end(microstrain)
    rows = np.flatnonzero((status & _NO_READING == 0) & np.isfinite(microstrain).all(axis=1))
    saturated = status & np.uint16(Status.SATURATED) != 0
    ages = t_ns if len(rows) and calibration.tare_drift_strain_per_s > 0.0 else None
    is_few = history.still is None and ages is None and len(rows) <= FEW  # too few to stand still
    given = Readings(microstrain * 1e-6, temperature, lost)
    if not is_few:
        given = given._replace(frozen=history.frozen(calibration, given.strain, rows))
    if ages is not None:
        history.first_ns = int(ages[rows[0]]) if history.first_ns is None else history.first_ns
        given = given._replace(age_s=np.asarray(ages - history.first_ns, dtype=np.float64) * 1e-9)
    while True:
        if is_few:
            degC = np.full(k, np.nan) if temperature is None else temperature
            contacts, before = estimator.few(microstrain[rows], degC[rows], lost[rows], history.before)
        else:
            contacts, before = estimator.table(given.part(rows), history.before)
        holds = ~saturated[rows] | contacts.has(Status.SATURATED | Status.FAULT)
        if holds.all():
            history.before = before
            return rows, contacts
        rows = rows[holds]


def signals_needed(
    asked: Iterable[str] | None, calibrations: Mapping[int | None, Calibration]
) -> tuple[str, ...] | None:
    """What has to be decoded for what is asked: gauges and flags for the contact, and what else a frame carries.
    Temperature where a calibration depends on it, or says for which it holds."""
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
    return tuple(dict.fromkeys([*kept, *gauges, *NEEDED_FLAGS, *(["temperature"] if temperature else [])]))


def is_computed(name: str) -> str | None:
    """The signal that a name of a computed column means, if it is one."""
    return next((column.signal for column in COLUMNS if name in {column.name, column.signal}), None)


def gauges_of(calibrations: Mapping[int | None, Calibration]) -> int:
    """The most gauges that a calibration has."""
    return max(tip.gauges for tip in calibrations.values())


def estimates(
    calibration: Calibration, data: Measurements, saturation_microstrain: float | None = None
) -> Iterator[tuple[int, list[float], str]]:
    """Yield (line, [P_N, phi_deg, theta_deg, u_P_N, u_phi_deg, u_theta_deg], status) of each good row; NaN: unknown, as
    on a node. With ``calibration.parameter_covariance`` the uncertainty includes the calibration's."""
    weight = np.ones(len(data.line)) if data.weight is None else data.weight
    if saturation_microstrain is not None:
        own = calibration.converter_limit_strain
        limit = np.minimum(np.where(own > 0.0, own, np.inf), 1e-6 * saturation_microstrain)
        calibration = replace(calibration, converter_limit_strain=limit)
    frozen = frozen_gauges(calibration, data.strain, weight)
    tares = _tares(data, weight, calibration, 0 if frozen is None else frozen) if data.unloaded.any() else None
    if tares is not None and calibration.parameter_covariance is not None:
        blocks = calibration.parameter_covariance.copy()
        blocks[:, 3] = blocks[:, :, :, 3] = 0.0  # the tares give the offset, with a noise of their own
        calibration = replace(calibration, parameter_covariance=blocks)
    estimator = Estimator(calibration)
    # Without tares the age counts from the first row, the first that is known.
    age_s = None if data.t_s is None else data.t_s - data.t_s[:1]
    offset, noise, age, lost = tares or (None, 0.0, age_s, None)
    given = Readings(
        data.strain, data.temperature_degC, lost, frozen, data.unloaded, offset, 1.0 / weight + noise,
        None if data.t_s is None else age,
        None if data.mode is None else np.where(data.mode < 0, calibration.pull, data.mode == MODES.index("pull")),
    )  # fmt: skip
    contacts, status, _ = estimator.rows(given, Before())
    words = {value: reasons.of_estimate(value) for value in np.unique(status).tolist()}
    for line, values, value in zip(data.line.tolist(), contacts.values.tolist(), status.tolist(), strict=True):
        yield line, values, words[value]


def _tares(
    data: Measurements, weight: FloatArray, calibration: Calibration, frozen: IntArray | int
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """From the unloaded readings: the offset of each row (m, n), interpolated, its noise in variances of one reading,
    the time, or rows, to the nearest tare, and bits of the gauges without a tare, (m,) each. A gauge that is saturated
    or frozen has no tare there."""
    from tipforce.sensor.calibration.regressors import tare_groups  # not where a log is read

    m, n = data.strain.shape
    clock = data.t_s if data.t_s is not None else np.arange(m, dtype=np.float64)
    strain = Judge(calibration).compensated(data.strain, data.temperature_degC)
    offset, noise, age, lost = np.zeros((m, n)), np.zeros(m), np.zeros(m), np.zeros(m, dtype=np.int64)
    for k, limit in enumerate(calibration.converter_limit_strain.tolist()):
        live = (np.abs(data.strain[:, k]) < (limit or np.inf)) & ((frozen >> k & 1) == 0)
        groups = tare_groups(data.unloaded, live | ~data.unloaded)
        if not groups:
            lost |= 1 << k
            continue
        at, tare = (np.array([np.average(x[g], weights=weight[g]) for g in groups]) for x in (clock, strain[:, k]))
        readings = np.array([weight[group].sum() for group in groups])
        place = np.interp(clock, at, np.arange(len(at)))
        before = place.astype(np.int64)
        after, share = np.minimum(before + 1, len(at) - 1), place - before
        offset[:, k] = tare[before] * (1.0 - share) + tare[after] * share
        noise = np.maximum(noise, (1.0 - share) ** 2 / readings[before] + share**2 / readings[after])
        age = np.maximum(age, np.minimum(np.abs(clock - at[before]), np.abs(clock - at[after])))
    return offset, noise, age, lost
