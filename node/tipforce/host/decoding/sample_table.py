"""Signals of many messages as columns, by the core or numpy; rows of samples, which the parts of a decode exchange."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray
from tipforce.core import core
from tipforce.dictionary.signals import Signal

Values = npt.NDArray[Any]  # (k,): float64 (measurement), bool (flag) or an integer type (counter, register)

NO_COUNTER = -1
NO_FLAG = -1
NO_INTEGER = np.iinfo(np.int64).min
_MISSING = {"flag": np.int8(NO_FLAG), "integer": np.int64(NO_INTEGER), "counter": np.int64(NO_COUNTER), "real": np.nan}
NODE_BITS = 7
"""A key is channel << NODE_BITS | node-id: it separates nodes of two buses."""

_SUFFIX = {"N": "_N", "degree": "_deg", "microstrain": "_ue", "degC": "_degC"}
_FIRST = ("P", "phi", "theta", "u_P", "u_phi", "u_theta", "F1", "F2", "F3")
_GAUGE, _NUMBER, _FLAG, _COUNT = 20, 40, 60, 80


def node_of(key: int) -> int:
    """Return the node-id of a key."""
    return key & ((1 << NODE_BITS) - 1)


def place_of(channels: Sequence[str], key: int) -> tuple[str, int]:
    """Return the channel and the node-id of a key."""
    return channels[key >> NODE_BITS], node_of(key)


@dataclass(frozen=True, slots=True)
class Column:
    """``kind``: "real", "flag" or "integer"; ``digits`` after the point (None: as needed); ``rank``: its place."""

    name: str
    signal: str
    kind: str
    digits: int | None
    unit: str
    rank: int

    @property
    def angle(self) -> bool:
        """True if values a full turn apart are equal."""
        return self.unit == "degree"


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """k samples by their first frames, (k,): ``t_ns``; ``key`` channel and node; ``counter`` or NO_COUNTER; ``cyclic``:
    with a PDO that follows SYNC; ``values`` by column (NaN, NO_FLAG, NO_INTEGER); ``absent``: carried by no frame."""

    t_ns: npt.NDArray[np.int64]
    key: npt.NDArray[np.uint16]
    counter: npt.NDArray[np.int64]
    cyclic: BoolArray
    columns: tuple[Column, ...] = ()
    values: dict[str, Values] = field(default_factory=dict)
    absent: dict[str, BoolArray] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    timed: bool = True
    moduli: tuple[tuple[str, int], ...] = ()
    """Of the counters, by channel; 256 for one that it lacks."""

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def node(self) -> npt.NDArray[np.uint8]:
        """(k,) the node-ids; 0 for messages of a DBC that belong to no node."""
        return (self.key & ((1 << NODE_BITS) - 1)).astype(np.uint8)

    @property
    def channel(self) -> npt.NDArray[np.intp]:
        """(k,) indices into ``channels``."""
        return (self.key >> NODE_BITS).astype(np.intp)

    def with_columns(self, columns: Iterable[Column], channels: tuple[str, ...]) -> Table:
        """Return the table with further columns, empty in all rows, and further channels."""
        new = [column for column in columns if column.name not in self.values]
        values = self.values | {column.name: missing_of(column, len(self)) for column in new}
        absent = self.absent | {column.name: np.ones(len(self), dtype=np.bool_) for column in new}
        return replace(self.of_columns(in_order((*self.columns, *new)), values, absent), channels=channels)

    def of_columns(
        self, columns: Iterable[Column], values: Mapping[str, Values], absent: Mapping[str, BoolArray]
    ) -> Table:
        """Return the table with these columns, in their order, in place of its own."""
        shown = {column.name: values[column.name] for column in columns}
        nowhere = {name: rows for name, rows in absent.items() if name in shown and rows.any()}
        return replace(self, columns=tuple(columns), values=shown, absent=nowhere)

    def renumbered(self, numbers: Sequence[int], channels: tuple[str, ...], timed: bool) -> Table:
        """Return the table with other ``numbers`` of its channels, and without times unless ``timed``."""
        key = np.array(numbers, dtype=np.uint16)[self.channel] << NODE_BITS | self.node
        return replace(self, key=key.astype(np.uint16), channels=channels, timed=self.timed and timed)

    def take(self, rows: npt.NDArray[Any]) -> Table:
        """Return some of the rows."""
        values, absent = ({name: of[rows] for name, of in columns.items()} for columns in (self.values, self.absent))
        same = self.columns, values, absent, self.channels, self.timed, self.moduli
        return Table(self.t_ns[rows], self.key[rows], self.counter[rows], self.cyclic[rows], *same)


def column_of(signal: Signal) -> Column:
    """Return the column for a signal."""
    if signal.bits == 1 and signal.unknown is None:
        return Column(signal.name, signal.name, "flag", 0, "", _rank(signal.name, _FLAG))
    name = signal.name + ("" if signal.index == 0 else _SUFFIX.get(signal.unit, ""))
    plain = signal.unknown is None and signal.scale == 1 and not signal.offset and not signal.real
    if plain and (signal.bits < 64 or signal.signed):
        return Column(name, signal.name, "integer", 0, signal.unit, _rank(signal.name, _NUMBER))
    digits = None
    if not signal.real and 0 < signal.scale <= 1 and not signal.offset:
        digits = -math.floor(math.log10(signal.scale) + 1e-9)
        if abs(signal.scale * 10**digits - round(signal.scale * 10**digits)) > 1e-6 or digits > 9:
            digits = None
    return Column(name, signal.name, "real", digits, signal.unit, _rank(signal.name, _NUMBER))


def computed(name: str, unit: str, digits: int | None = 6) -> Column:
    """Return a column of numbers that no frame carried."""
    return Column(name + _SUFFIX.get(unit, ""), name, "real", digits, unit, _rank(name, _NUMBER))


def counted(name: str) -> Column:
    """Return a column of integers that no frame carried."""
    return Column(name, name, "integer", 0, "", _COUNT)


def flag(name: str) -> Column:
    """Return a column of flags that no frame carried."""
    return Column(name, name, "flag", 0, "", _rank(name, _FLAG))


def _rank(name: str, otherwise: int) -> int:
    if name in _FIRST:
        return _FIRST.index(name)
    return _GAUGE if name.startswith("SG") and name[2:].isdigit() else otherwise


def in_order(columns: Iterable[Column], asked: Sequence[str] | None = None) -> tuple[Column, ...]:
    """Return columns in display order: contact, forces, gauges, other numbers, flags; or in the requested order."""
    if asked is not None:
        place = {name: number for number, name in enumerate(asked)}
        return tuple(sorted(columns, key=lambda column: place.get(column.signal, len(place))))
    return tuple(sorted(columns, key=lambda column: column.rank))


def missing_of(column: Column, count: int) -> Values:
    """Return ``count`` missing values."""
    return np.full(count, _MISSING[column.kind])


def is_missing(column: Column, values: Values) -> BoolArray:
    """Return which values are missing."""
    return np.isnan(values) if column.kind == "real" else np.asarray(values == _MISSING[column.kind])


Words = npt.NDArray[np.uint64]
_IN_ORDER = np.zeros(0, dtype=np.int64)

SIGNAL = np.dtype([
    ("scale", "<f8"), ("offset", "<f8"), ("divisor", "<f8"), ("unknown", "<u8"), ("start", "u1"), ("bits", "u1"),
    ("kind", "u1"), ("size", "u1"), ("is_signed", "u1"), ("has_unknown", "u1"), ("big_endian", "u1"), ("spare", "u1"),
])  # fmt: skip
"""A signal for the compiled core. ``kind``: 0 flag, 1 integer, 2 number in a unit, 3 float; ``size``: of a value."""


class Layout:
    """The signals of a message, for the extraction of its columns."""

    def __init__(self, signals: Iterable[Signal], *, wide: bool = False) -> None:
        """``wide``: integers become int64, where they fit."""
        self.signals = tuple(signals)
        self.names = tuple(signal.name for signal in self.signals)
        nothing = columns_of(np.zeros(0, dtype=np.uint64), self.signals)
        kinds = {name: column.dtype for name, column in nothing.items()}
        for signal in self.signals if wide else ():
            if kinds[signal.name].kind in "iu" and (signal.bits < 64 or signal.signed):
                kinds[signal.name] = np.dtype(np.int64)
        larger_first = sorted(self.signals, key=lambda signal: -kinds[signal.name].itemsize)
        self._signals = np.array([_signal_row(one, kinds[one.name].itemsize) for one in larger_first], dtype=SIGNAL)
        places = np.cumsum([0, *(kinds[signal.name].itemsize for signal in larger_first)]).tolist()
        place_of = {signal.name: place for signal, place in zip(larger_first, places, strict=False)}
        self.places = {name: (kinds[name], place_of[name]) for name in self.names}
        """By name the type of a column, and its place: bytes per row of the columns before it in memory."""
        self._bytes = places[-1]

    def columns(self, words: Words, row: npt.NDArray[np.int64] = _IN_ORDER) -> Columns:
        """Return each signal (k,) from the eight data bytes (k,) as one little-endian number. ``row`` (k,): the place
        of each in the columns, each once; by default in their order."""
        memory = np.empty(len(words) * self._bytes, dtype=np.uint8)
        columns = Columns(self, memory, slice(0, len(words)), len(words))
        if core is not None and self.names:
            core.extract(words, self._signals, memory, row)
            return columns
        for name, values in columns_of(words, self.signals).items():
            columns[name][row if len(row) else slice(None)] = values
        return columns


class Columns(Mapping[str, Values]):
    """The columns of k samples by signal name, in one block of memory: each is made an array when it is read."""

    __slots__ = ("_layout", "_memory", "_rows", "_total")

    def __init__(self, layout: Layout, memory: npt.NDArray[np.uint8], rows: slice, total: int) -> None:
        self._layout, self._memory, self._rows, self._total = layout, memory, rows, total

    def part(self, rows: slice) -> Columns:
        """Return some rows of all of them."""
        return Columns(self._layout, self._memory, rows, self._total)

    def __getitem__(self, name: str) -> Values:
        """Return a column (k,), a view. Raises KeyError for another name."""
        kind, place = self._layout.places[name]
        column: Values = np.ndarray(self._total, kind, self._memory, self._total * place)
        return column[self._rows]

    def __iter__(self) -> Iterator[str]:
        return iter(self._layout.names)

    def __len__(self) -> int:
        return len(self._layout.names)


def _signal_row(signal: Signal, size: int) -> tuple[Any, ...]:
    flag = signal.bits == 1 and is_plain(signal)
    plain = signal.unknown is None and signal.scale == 1 and not signal.offset
    kind = 0 if flag else 3 if signal.real else 1 if plain else 2
    unknown = 0 if signal.unknown is None else signal.unknown & (1 << 64) - 1
    return (
        signal.scale, signal.offset, divisor_of(signal), unknown, signal.start_bit, signal.bits, kind, size,
        signal.signed and kind in {1, 2}, signal.unknown is not None, signal.big_endian, 0,
    )  # fmt: skip


def columns_of(words: Words, signals: Iterable[Signal]) -> dict[str, Values]:
    """Return each signal (k,) from the eight data bytes (k,) as one little-endian number, for any start bit."""
    flags: dict[int, npt.NDArray[np.uint8]] = {}
    columns: dict[str, Values] = {}
    for signal in signals:
        if signal.bits == 1 and is_plain(signal):
            byte = signal.start_bit // 8
            if byte not in flags:
                flags[byte] = (words >> np.uint64(8 * byte)).astype(np.uint8)
            columns[signal.name] = (flags[byte] & np.uint8(1 << signal.start_bit % 8)).astype(np.bool_)
        else:
            columns[signal.name] = _number(words, signal)
    return columns


def is_plain(signal: Signal) -> bool:
    """Return whether the raw number is the value."""
    return signal.unknown is None and signal.scale == 1 and not signal.offset and not signal.big_endian


def divisor_of(signal: Signal) -> int:
    """Return 1000 for a scale of 0.001, 0 where it is no such number: 474 / 1000 is the double nearest to 0.474."""
    divisor = round(1 / signal.scale) if 0 < signal.scale < 1 else 0
    return divisor if abs(signal.scale * divisor - 1) < 1e-9 else 0


def _number(words: Words, signal: Signal) -> Values:
    if signal.big_endian:
        words = words.byteswap()
    if signal.real:
        with np.errstate(invalid="ignore", over="ignore"):  # any bits may come from the wire
            values = _real(words, signal)
            return values if signal.scale == 1 and not signal.offset else values * signal.scale + signal.offset
    raw = _integer(words, signal)
    if signal.unknown is None and signal.scale == 1 and not signal.offset:
        return raw
    values = raw.astype(np.float64)
    divisor = divisor_of(signal)
    if divisor:
        values /= divisor
    elif signal.scale != 1:
        values *= signal.scale
    if signal.offset:
        values += signal.offset
    if signal.unknown is not None:
        unknown = raw == signal.unknown
        if unknown.any():
            values[unknown] = np.nan
    return values


def _real(words: Words, signal: Signal) -> Values:
    shifted = words >> np.uint64(signal.start_bit)
    if signal.bits == 64:
        return shifted.view(np.float64).copy()
    return shifted.astype(np.uint32).view(np.float32).astype(np.float64)


def _integer(words: Words, signal: Signal) -> Values:
    if signal.bits in {8, 16, 32, 64}:
        kind = f"{'i' if signal.signed else 'u'}{signal.bits // 8}"
        return (words >> np.uint64(signal.start_bit)).astype(kind)  # keeps the low bits
    top = words << np.uint64(64 - signal.bits - signal.start_bit)
    down = 64 - signal.bits
    return top.view(np.int64) >> np.int64(down) if signal.signed else top >> np.uint64(down)
