"""Extract signals from eight data bytes, for many messages of one layout at a time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.dictionary.signals import Signal

Column = npt.NDArray[Any]  # (k,): float64 (measurement), bool (flag) or an integer type (counter, register)
Words = npt.NDArray[np.uint64]


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
