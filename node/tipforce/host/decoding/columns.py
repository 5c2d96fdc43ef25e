"""Extract signals from eight data bytes, for many messages of one layout at a time."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from itertools import groupby
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


TIME, ROW = " t_ns", " row"  # no signal has such a name
PackRow = Callable[[int, int, int], bytes]  # t_ns, row and the eight data bytes as a little-endian number


def packed_row(signals: Iterable[Signal]) -> tuple[PackRow, np.dtype[np.void]]:
    """Return the function that packs a message, and the dtype of its rows: ``TIME``, ``ROW``, then each signal.

    The fields have the types of ``columns_of``. Larger fields come first, so that all are aligned.
    """
    given = tuple(signals)
    flags = sorted((s for s in given if _is_flag(s)), key=lambda signal: signal.start_bit)
    numbers = [s for s in given if not _is_flag(s)]
    formats = {signal.name: _format(signal) for signal in numbers}
    numbers.sort(key=lambda signal: -struct.calcsize(formats[signal.name]))
    names: dict[str, object] = {"real32": _real32, "real64": _real64, "swapped": _swapped, "nan": math.nan}
    fields = [(TIME, "<i8"), (ROW, "<i8"), *((s.name, f"<{_NUMPY[formats[s.name]]}") for s in numbers)]
    codes = ["q", "q", *(formats[signal.name] for signal in numbers)]
    values = ["t_ns", "row", *(_expression(signal) for signal in numbers)]
    for byte, members in groupby(flags, key=lambda signal: signal.start_bit // 8):
        of_byte = list(members)
        bits = [signal.start_bit % 8 for signal in of_byte]
        names[f"flags_{byte}"] = [bytes(state >> bit & 1 for bit in bits) for state in range(256)]
        values.append(f"flags_{byte}[word >> {8 * byte} & 0xFF]")
        codes.append(f"{len(bits)}s")
        fields += [(signal.name, "?") for signal in of_byte]
    padding = -struct.calcsize("<" + "".join(codes)) % 8
    if padding:
        codes.append(f"{padding}x")
        fields.append((" padding", f"V{padding}"))
    names["pack"] = struct.Struct("<" + "".join(codes)).pack
    # The text contains nothing but numbers of the signals: no name, no unit.
    pack: PackRow = eval(f"lambda t_ns, row, word: pack({', '.join(values)})", names)
    return pack, np.dtype(fields)


_NUMPY = {"q": "i8", "Q": "u8", "d": "f8", "b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4"}
_INTEGERS = {8: "b", 16: "h", 32: "i"}


def _is_flag(signal: Signal) -> bool:
    return signal.bits == 1 and is_plain(signal)


def _is_integer(signal: Signal) -> bool:
    return not signal.real and signal.unknown is None and signal.scale == 1 and not signal.offset


def _format(signal: Signal) -> str:
    if not _is_integer(signal):
        return "d"
    code = _INTEGERS.get(signal.bits, "q")
    return code if signal.signed else code.upper()


def _expression(signal: Signal) -> str:
    """Return the value of ``word`` as Python text, with the operations of columns.py in their order."""
    word = "swapped(word)" if signal.big_endian else "word"
    mask = (1 << signal.bits) - 1
    raw = f"({word} >> {signal.start_bit} & {mask})"
    if signal.real:
        value = f"real{signal.bits}{raw}"
        plain = signal.scale == 1 and not signal.offset
        return value if plain else f"{value} * {signal.scale!r} + {signal.offset!r}"
    if signal.signed:
        sign = 1 << signal.bits - 1
        raw = f"(({raw} ^ {sign}) - {sign})"
    if _is_integer(signal):
        return raw
    divisor = divisor_of(signal)
    value = "float(raw)" if signal.unknown is not None else f"float{raw}"
    if divisor:
        value += f" / {divisor}"
    elif signal.scale != 1:
        value += f" * {signal.scale!r}"
    if signal.offset:
        value += f" + {signal.offset!r}"
    return value if signal.unknown is None else f"nan if (raw := {raw}) == {signal.unknown} else {value}"


def _real32(raw: int) -> float:
    value: float = struct.unpack("<f", raw.to_bytes(4, "little"))[0]
    return value


def _real64(raw: int) -> float:
    value: float = struct.unpack("<d", raw.to_bytes(8, "little"))[0]
    return value


def _swapped(word: int) -> int:
    return int.from_bytes(word.to_bytes(8, "little"), "big")
