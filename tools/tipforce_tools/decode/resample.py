"""The steps on tables between the logs and the output: contact by a calibration, and a uniform grid."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray
from tipforce.errors import InputError
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.decoding.sample_table import NO_COUNTER, Column, Table, counted, in_order, is_missing, node_of
from tipforce_tools.cli import log_choice

COUNT = "count"
MOST_EMPTY = 10_000_000
"""More intervals without a sample in one block of the log are a jump of the clock or a wrong rate, not a pause."""
_ROWS = 100_000  # of a table: empty intervals need no more memory than samples
_NO_DIRECTION = 1e-9  # length of a mean of unit vectors that cancel: it has no direction
_MORE_DIGITS = 3  # additional digits of a mean


class _Groups(NamedTuple):
    """g intervals of nodes, by node and time. ``sums`` (g, c, 3) of c columns: count, sum or sine, cosine."""

    key: npt.NDArray[np.uint16]
    interval: IntArray
    samples: IntArray
    sums: FloatArray

    def take(self, rows: npt.NDArray[np.intp] | npt.NDArray[np.bool_]) -> _Groups:
        return _Groups._make(column[rows] for column in self)


class Resampler:
    """Make tables with the means of each interval of 1 / ``rate_hz`` from a node's first sample to its last, of angles
    by their directions; `count`: its samples, `n_P_N` the values in the mean; of a flag the share where it was set."""

    def __init__(self, rate_hz: float, asked: Sequence[str] | None = None) -> None:
        """``asked``: signals in the order of the columns. Raises InputError for a rate that is not 1e-9 to 1e9."""
        if not 1e-9 <= rate_hz <= 1e9:
            raise InputError(f"--resample {rate_hz:g}: allowed is 1e-9 to 1e9, in Hz")
        self._rate_hz = rate_hz
        self._asked = asked
        self._columns: dict[str, Column] = {}
        self._channels: tuple[str, ...] = ()
        self._open = _Groups(np.zeros(0, np.uint16), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 0, 3)))

    def tables(self, tables: Iterable[Table]) -> Iterator[Table]:
        """Yield the intervals complete after each table. Raises InputError for a log without times."""
        for table in tables:
            if not table.timed:
                raise InputError("--resample: the log has no timestamps")
            self._channels = table.channels
            self._columns |= {column.name: column for column in table.columns}
            groups = _summed(self._joined(self._grouped(table)))
            last = np.append(groups.key[1:] != groups.key[:-1], True)
            self._open = groups.take(last)
            yield from self._rows(groups, ~last)
        yield from self._rows(self._open, np.ones(len(self._open.key), dtype=np.bool_))

    def _grouped(self, table: Table) -> _Groups:
        interval = self._intervals(table.t_ns)
        if len(self._open.key):  # a late sample counts in the interval that is still open
            place = np.minimum(np.searchsorted(self._open.key, table.key), len(self._open.key) - 1)
            known = self._open.key[place] == table.key
            interval = np.where(known, np.maximum(interval, self._open.interval[place]), interval)
        sums = np.zeros((len(table), len(self._columns), 3))
        for number, column in enumerate(self._columns.values()):
            if column.name in table.values:
                sums[:, number] = _contributions(column, table.values[column.name])
        return _Groups(table.key, interval, np.ones(len(table), dtype=np.int64), sums)

    def _intervals(self, t_ns: IntArray) -> IntArray:
        period = 1e9 / self._rate_hz
        if period == round(period):
            return np.asarray(t_ns // round(period))
        seconds, rest = np.divmod(t_ns, 1_000_000_000)
        whole = np.floor(seconds * self._rate_hz)
        within = (seconds * self._rate_hz - whole) + rest * 1e-9 * self._rate_hz
        return np.asarray(whole + np.floor(within + 1e-9)).astype(np.int64)

    def _joined(self, new: _Groups) -> _Groups:
        more = new.sums.shape[1] - self._open.sums.shape[1]
        old = self._open._replace(sums=np.pad(self._open.sums, ((0, 0), (0, more), (0, 0))))
        pairs: Iterator[tuple[Any, Any]] = zip(old, new, strict=True)
        return _Groups._make(map(np.concatenate, pairs))

    def _rows(self, groups: _Groups, done: npt.NDArray[np.bool_]) -> Iterator[Table]:
        """Return rows of the complete intervals, and of empty ones between them."""
        if not done.any():
            return
        empty = np.zeros(len(done), dtype=np.int64)
        follows = groups.key[1:] == groups.key[:-1]
        empty[:-1][follows] = (np.diff(groups.interval) - 1)[follows]
        self._check_empty(groups, empty)
        repeats = np.where(done, 1 + empty, 0)
        source = np.repeat(np.arange(len(done)), repeats)
        step = np.arange(len(source)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        order = np.lexsort((groups.key[source], groups.interval[source] + step))
        for first in range(0, len(order), _ROWS):
            rows = order[first : first + _ROWS]
            key, interval, count, sums = groups.take(source[rows])
            is_full = step[rows] == 0
            sums[~is_full] = 0.0
            yield self._table(_Groups(key, interval + step[rows], np.where(is_full, count, 0), sums))

    def _check_empty(self, groups: _Groups, empty: IntArray) -> None:
        if empty.sum() > MOST_EMPTY:
            node = node_of(int(groups.key[int(np.argmax(empty))]))
            raise InputError(
                f"--resample {self._rate_hz:g}: {empty.sum()} intervals without a sample, most of node {node}: "
                "choose a lower rate, or a part of the log with --from and --to"
            )

    def _table(self, groups: _Groups) -> Table:
        values: dict[str, npt.NDArray[Any]] = {COUNT: groups.samples}
        columns, sums = [counted(COUNT)], dict(zip(self._columns, np.moveaxis(groups.sums, 1, 0), strict=True))
        for column in in_order(self._columns.values(), self._asked):
            digits = None if column.digits is None else column.digits + _MORE_DIGITS
            columns.append(Column(column.name, column.signal, "real", digits, column.unit, column.rank))
            values[column.name] = _mean(column, sums[column.name])
            if column.kind != "flag":
                columns.append(counted(f"n_{column.name}"))
                values[columns[-1].name] = sums[column.name][:, 0].astype(np.int64)
        period = 1e9 / self._rate_hz
        t_ns = groups.interval * round(period)
        if period != round(period):
            seconds, rest = np.divmod(groups.interval, self._rate_hz)
            t_ns = seconds.astype(np.int64) * 1_000_000_000 + np.rint(rest * period).astype(np.int64)
        no_counter = np.full(len(t_ns), NO_COUNTER, dtype=np.int64)
        cyclic = np.ones(len(t_ns), dtype=np.bool_)
        return Table(t_ns, groups.key, no_counter, cyclic, tuple(columns), values, {}, self._channels)


def _summed(groups: _Groups) -> _Groups:
    order = np.lexsort((groups.interval, groups.key))
    key, interval = groups.key[order], groups.interval[order]
    starts = np.flatnonzero(np.append(True, (key[1:] != key[:-1]) | (interval[1:] != interval[:-1])))
    count, sums = (np.add.reduceat(values[order], starts, axis=0) for values in (groups.samples, groups.sums))
    return _Groups(key[starts], interval[starts], count, sums)


def _contributions(column: Column, values: npt.NDArray[Any]) -> FloatArray:
    """Return (k, 3): 1 for a value, the value (of angles the sine), of angles the cosine; zeros for missing values."""
    valid = ~is_missing(column, values)
    if column.kind == "real":
        valid &= np.isfinite(values)
    numbers = np.where(valid, values, 0).astype(np.float64)
    if not _circular(column):
        return np.stack([valid, numbers, np.zeros(len(values))], axis=-1)
    angle = np.radians(numbers)
    return np.stack([valid, np.where(valid, np.sin(angle), 0.0), np.where(valid, np.cos(angle), 0.0)], axis=-1)


def _circular(column: Column) -> bool:
    return column.kind == "real" and column.angle and not column.signal.startswith("u_")


def _mean(column: Column, sums: FloatArray) -> FloatArray:
    count = sums[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(count > 0, sums[:, 1] / count, np.nan)
        if _circular(column):
            cosine = sums[:, 2] / count
            length = np.hypot(mean, cosine)
            mean = np.where(length > _NO_DIRECTION, np.degrees(np.arctan2(mean, cosine)), np.nan)
    return np.asarray(mean)


Step = Callable[[Iterable[Table]], Iterable[Table]]


def steps_of(args: Namespace) -> tuple[Layouts, tuple[str, ...] | None, Step, Step]:
    """Return the layouts and signals to read, and two steps: contact by a calibration, and a grid. Raises InputError. A
    step that is not asked for returns the tables as they are."""
    names = log_choice.names_of(args.signals)
    layouts, calibrations = log_choice.layouts(args)
    contact: Step = iter
    if calibrations:
        from tipforce.host.decoding import contact_columns

        computed = {name: contact_columns.is_computed(name) for name in names or ()}
        rest = log_choice.checked_signals(layouts, tuple(name for name, signal in computed.items() if not signal))
        left = iter(rest or ())
        asked = None if names is None else tuple(computed[name] or next(left, "") for name in names)
        contact = contact_columns.ContactColumns(calibrations, asked).tables
        signals = contact_columns.signals_needed(asked, calibrations)
    else:
        asked = signals = log_choice.checked_signals(layouts, names)
    return layouts, signals, contact, iter if args.resample is None else Resampler(args.resample, asked).tables
