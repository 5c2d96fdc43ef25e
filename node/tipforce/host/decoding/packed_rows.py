"""Decode single messages of one layout: an expression per signal, compiled once, gives a packed row.

For the few frames of a live batch this costs less than a numpy call per signal (columns.py); the values are equal bit
by bit.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from itertools import groupby

import numpy as np

from tipforce.dictionary.signals import Signal
from tipforce.host.decoding.columns import divisor_of, is_plain

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
