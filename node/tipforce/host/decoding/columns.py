"""Extract signals from eight data bytes, for many messages of one layout at a time: by the core, or numpy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.core import core
from tipforce.dictionary.signals import Signal

Column = npt.NDArray[Any]  # (k,): float64 (measurement), bool (flag) or an integer type (counter, register)
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
        """Return each signal (k,) from the eight data bytes (k,) as one little-endian number.

        ``row`` (k,): the place of each in the columns, each once; by default in their order.
        """
        memory = np.empty(len(words) * self._bytes, dtype=np.uint8)
        columns = Columns(self, memory, slice(0, len(words)), len(words))
        if core is not None and self.names:
            core.extract(words, self._signals, memory, row)
            return columns
        for name, values in columns_of(words, self.signals).items():
            columns[name][row if len(row) else slice(None)] = values
        return columns


class Columns(Mapping[str, Column]):
    """The columns of k samples by signal name, in one block of memory: each is made an array when it is read."""

    __slots__ = ("_layout", "_memory", "_rows", "_total")

    def __init__(self, layout: Layout, memory: npt.NDArray[np.uint8], rows: slice, total: int) -> None:
        self._layout, self._memory, self._rows, self._total = layout, memory, rows, total

    def part(self, rows: slice) -> Columns:
        """Return some rows of all of them."""
        return Columns(self._layout, self._memory, rows, self._total)

    def __getitem__(self, name: str) -> Column:
        """Return a column (k,), a view. Raises KeyError for another name."""
        kind, place = self._layout.places[name]
        column: Column = np.ndarray(self._total, kind, self._memory, self._total * place)
        return column[self._rows]

    def __iter__(self) -> Iterator[str]:
        """Return the names in the order of the signals."""
        return iter(self._layout.names)

    def __len__(self) -> int:
        """Return the number of columns."""
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


def columns_of(words: Words, signals: Iterable[Signal]) -> dict[str, Column]:
    """Return each signal (k,) from the eight data bytes (k,) as one little-endian number, for any start bit."""
    flags: dict[int, npt.NDArray[np.uint8]] = {}
    columns: dict[str, Column] = {}
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


def _number(words: Words, signal: Signal) -> Column:
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


def _real(words: Words, signal: Signal) -> Column:
    shifted = words >> np.uint64(signal.start_bit)
    if signal.bits == 64:
        return shifted.view(np.float64).copy()
    return shifted.astype(np.uint32).view(np.float32).astype(np.float64)


def _integer(words: Words, signal: Signal) -> Column:
    if signal.bits in {8, 16, 32, 64}:
        kind = f"{'i' if signal.signed else 'u'}{signal.bits // 8}"
        return (words >> np.uint64(signal.start_bit)).astype(kind)  # keeps the low bits
    top = words << np.uint64(64 - signal.bits - signal.start_bit)
    down = 64 - signal.bits
    return top.view(np.int64) >> np.int64(down) if signal.signed else top >> np.uint64(down)
