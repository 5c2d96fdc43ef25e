"""What is where in a PDO: the layout of each message, and of any other mapping, as signals (CiA 301, 7.5.2.36)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain, count
from typing import Any

from canopen_device import types
from canopen_device.core import communication
from tipforce.dictionary import indices, table
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import entries
from tipforce.errors import InputError

MAX_BITS = 64
FIRST_OBJECT = communication.FIRST  # below are the data types: mapped, they are gaps (CiA 301, 7.4.7, dummy mapping)

_UNCERTAINTIES = (("u_P", "N"), ("u_phi", "degree"), ("u_theta", "degree"))
_MEASURED = {
    indices.TEMPERATURE: ("temperature", 0.01, "degC", "temperature of the fingertip"),
    indices.U_P: ("u_P", 0.001, "N", "standard uncertainty of P"),
}


@dataclass(frozen=True, slots=True)
class Signal:
    """A quantity in a message: raw x ``scale`` + ``offset``, in ``unit``, little-endian from ``start_bit``
    (``big_endian``: from the last byte's lowest bit). ``unknown``: raw value for none; None: there is none, or NaN."""

    name: str
    start_bit: int
    bits: int
    signed: bool
    scale: float
    unit: str
    minimum: float
    maximum: float
    unknown: int | None
    description: str
    index: int
    sub: int
    real: bool = False
    offset: float = 0.0
    big_endian: bool = False


@dataclass(frozen=True, slots=True)
class Message:
    """A PDO by default: COB-ID ``cob_id_base`` + node-id (0: none), ``kind`` "tpdo" or "rpdo", ``number`` from 1,
    ``mapping`` of (index, sub, bits), ``transmission_type`` by CiA 301, table 72; ``event_timer_ms`` 0 is off."""

    kind: str
    number: int
    name: str
    cob_id_base: int
    length_bytes: int
    signals: tuple[Signal, ...]
    mapping: tuple[tuple[int, int, int], ...]
    enabled: bool
    transmission_type: int
    event_timer_ms: int


@lru_cache(maxsize=8)
def tpdo_messages(n: int = 3) -> tuple[Message, ...]:
    """The default TPDOs of a node with ``n`` gauges. Raises InputError for an ``n`` outside 3..8."""
    return _messages("tpdo", table.tpdos(n), n)


@lru_cache(maxsize=1)
def rpdo_messages() -> tuple[Message, ...]:
    """The default RPDOs: the same for every number of gauges."""
    return _messages("rpdo", table.rpdos(), table.MIN_GAUGES)


def mapping_signals(mapping: Iterable[tuple[int, int, int]], n: int = 3) -> tuple[Signal, ...]:
    """The signals of a PDO that maps these (index, sub, bits), in this order. Raises InputError for an object that is
    not there or can't be mapped, a wrong length, more than 64 bits."""
    signals: list[Signal] = []
    start = 0
    for index, sub, bits in mapping:
        if index >= FIRST_OBJECT:
            entry, place = entries(n, True).get((index, sub)), f"mapping of 0x{index:04X}:{sub:02X}"
            if entry is None:
                raise InputError(f"{place}: no such object with {n} gauges")
            if not entry.mappable:
                raise InputError(f"{place}: {entry.name} can't be mapped into a PDO")
            if bits != 8 * _size(entry):
                raise InputError(f"{place}: {bits} bits, allowed is {8 * _size(entry)} ({entry.name})")
            signals += _signals_of(entry, start, n)
        start += bits
    if start > MAX_BITS:
        raise InputError(f"the mapping has {start} bits, allowed are at most {MAX_BITS}")
    return _unique(signals)


def _messages(kind: str, declared: tuple[table.Pdo, ...], n: int) -> tuple[Message, ...]:
    messages = []
    known = entries(n, True)
    for number, name, base, enabled, transmission, event_ms, mapped in declared:
        mapping = tuple((index, sub, 8 * _size(known[index, sub])) for index, sub in mapped)
        length = sum(bits for _, _, bits in mapping) // 8
        signals = mapping_signals(mapping, n)
        messages.append(Message(kind, number, name, base, length, signals, mapping, enabled, transmission, event_ms))
    return tuple(messages)


def _size(entry: Entry[Any]) -> int:
    return types.data_type(entry.type).size or 0


def _signals_of(entry: Entry[Any], start: int, n: int) -> list[Signal]:
    if entry.index == indices.STATUS:
        return [_flag(entry, start, k, *bit) for k, bit in enumerate(table.STATUS_BITS)]
    if entry.index == indices.FAULTS:
        bits = [(k, f"SG{k + 1}_fault", f"gauge {k + 1} is saturated or left out") for k in range(n)]
        bits += [(k, f"fault_{name}", text) for k, name, text in table.FAULT_BITS]
        return [_flag(entry, start, *bit) for bit in bits]
    measured = _meaning(entry, n)
    return [_plain(entry, start, n) if measured is None else _scaled(entry, start, *measured)]


def _flag(entry: Entry[Any], start: int, bit: int, name: str, description: str) -> Signal:
    return Signal(name, start + bit, 1, False, 1, "", 0, 1, None, description, entry.index, entry.sub)


def _meaning(entry: Entry[Any], n: int) -> tuple[str, float, str, str] | None:
    """Name, resolution, unit and description of a measured value."""
    if entry.index in table.forms(indices.PROCESS_VALUE):
        symbol, what, _, digits, _, unit, _, _ = table.channels(n)[entry.sub - 1]
        return symbol, 10.0**-digits, unit, what
    if entry.index in table.forms(indices.FIELD_VALUE):
        return f"SG{entry.sub}_counts", 1.0, "counts", f"field value of gauge {entry.sub}"
    if entry.index == indices.UNCERTAINTY:
        name, unit = _UNCERTAINTIES[entry.sub - 1]
        return name, 1.0, unit, f"standard uncertainty of {name[2:]}"
    return _MEASURED.get(entry.index)


def _scaled(entry: Entry[Any], start: int, name: str, scale: float, unit: str, what: str) -> Signal:
    kind = types.data_type(entry.type)
    if kind.limits is None:  # REAL32
        low, high = (0.0 if entry.index == indices.UNCERTAINTY else -3.4e38), 3.4e38
        scale, unknown, note = 1.0, None, "NaN means unknown"
    else:
        least, top = kind.limits
        unknown = least or top
        low, high = (-top * scale, top * scale) if least else (0.0, (top - 1) * scale)
        note = f"raw {unknown} means unknown"
    if unit == "degree" and entry.index != indices.UNCERTAINTY:
        low, high = -180.0, 180.0
    text, signed = f"{what}, in {unit}; {note}", kind.letter in "hif"
    low, high = (float(f"{value:.10g}") for value in (low, high))  # 3276.7000000000003, of a product, becomes 3276.7
    return Signal(
        name, start, 8 * _size(entry), signed, round(scale, 9), unit, low, high, unknown, text, entry.index, entry.sub,
        kind.python is float,
    )  # fmt: skip


def _plain(entry: Entry[Any], start: int, n: int) -> Signal:
    limits = types.data_type(entry.type).limits or (0, 0)
    name = entry.stem.replace(".", "_")
    if entry.index == indices.CHANNEL_STATUS:
        name = f"{table.channels(n)[entry.sub - 1][0]}_status"
    elif entry.is_counted:
        name = f"{name}_{entry.sub}"
    low = limits[0] if entry.low is None else entry.low
    high = limits[1] if entry.high is None else entry.high
    bits, signed = 8 * _size(entry), limits[0] < 0
    return Signal(name, start, bits, signed, 1, entry.unit, low, high, None, entry.title, entry.index, entry.sub)


def _unique(signals: list[Signal]) -> tuple[Signal, ...]:
    """Names that occur once: P mapped as INTEGER16 and as REAL32 becomes P and P_6130."""
    unique: dict[str, Signal] = {}
    for signal in signals:
        longer = f"{signal.name}_{signal.index:04X}"
        names = chain((signal.name, longer), (f"{longer}_{number}" for number in count(2)))
        name = next(name for name in names if name not in unique)
        unique[name] = replace(signal, name=name)
    return tuple(unique.values())
