"""PDO layouts from sources other than the dictionary: a DCF, a node over SDO, a DBC."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from canopen_device.core import communication
from canopen_device.core.codes import COB_ID_INVALID, EXTENDED_FLAG, EXTENDED_MASK
from tipforce.dictionary import table
from tipforce.dictionary.entries import gauges_of
from tipforce.dictionary.signals import Message, Signal, tpdo_messages
from tipforce.errors import InputError
from tipforce.host.decoding.decoder import MAX_COB_ID, Decoder, Key
from tipforce.host.decoding.health import SERVICES

if TYPE_CHECKING:
    from cantools.database.can import Message as DbcMessage
    from cantools.database.can import Signal as DbcSignal

    from canopen_device.eds.sections import EdsFile
    from tipforce.host.network.sdo import SdoChannel


_OUR_NAME = re.compile(r"TIP(\d+)_(\w+)")
_UNKNOWN = "unknown"
_MOST_MAPPED = 64  # CiA 301, 7.5.2.34


@dataclass(frozen=True, slots=True)
class NodeLayout:
    """The TPDOs of one node: by message name (can_id, 0 for disabled, and the mapping as (index, sub, bits))."""

    node_id: int
    gauges: int
    pdos: dict[str, tuple[int, tuple[tuple[int, int, int], ...]]]


def layout_decoder(layouts: Iterable[NodeLayout]) -> Decoder:
    """Return a decoder of only these nodes. Raises InputError as ``with_layouts`` and ``Decoder.remap``."""
    given = list(layouts)
    return with_layouts(Layouts(nodes=tuple(layout.node_id for layout in given)), given).decoder()


def dcf_layout(path: str | Path, node_id: int | None = None) -> NodeLayout:
    """Return the layout in a DCF (or an EDS, with ``node_id``). Raises InputError for a file without one."""
    from canopen_device.eds.reader import read

    found = read(path)
    section = found.sections.get("devicecomissioning")  # this is the spelling of CiA 306
    text = section.get("NodeID") if section is not None else None
    if node_id is None and text is None:
        raise InputError(
            f"{path}: no NodeID in [DeviceComissioning], as the DCF of a node has; `tipforce config save` writes one"
        )
    node = _number(path, "NodeID", text or "", 0) if node_id is None else node_id
    return _layout(str(path), node, lambda index, sub: _value(found, path, index, sub, node))


def node_layout(sdo: SdoChannel) -> NodeLayout:
    """Read the layout of a node. Raises as ``SdoChannel.upload``, and InputError for a node that is not a fingertip."""
    return _layout(
        f"node {sdo.node_id}", sdo.node_id, lambda index, sub: int.from_bytes(sdo.upload(index, sub), "little")
    )


def _layout(place: str, node_id: int, number: Callable[[int, int], int | None]) -> NodeLayout:
    """Return the layout that ``number`` gives by index and sub-index."""
    product = number(communication.IDENTITY, 2) or 0
    if not (gauges := gauges_of(product)):
        ours = f"0x{table.PRODUCT:08X} + gauges"
        raise InputError(f"{place}: product code 0x{product:08X} is not that of a tipforce node ({ours})")
    pdos = {}
    for position, message in enumerate(tpdo_messages(gauges)):
        mapping, cob_id = communication.TPDO_MAPPING + position, number(communication.TPDO + position, 1)
        if cob_id is None:
            continue
        count = number(mapping, 0) or 0
        if not 0 <= count <= _MOST_MAPPED:
            raise InputError(f"{place}: 0x{mapping:04X}:00 = {count}: allowed are 0 to {_MOST_MAPPED} mapped objects")
        pdos[message.name] = _pdo(place, cob_id, [number(mapping, sub) or 0 for sub in range(1, count + 1)])
    return NodeLayout(node_id, gauges, pdos)


def dbc_messages(path: str | Path, say: Callable[[str], object] = str) -> dict[Key, tuple[int, Message]]:
    """Return the messages of a DBC for ``Decoder.of_messages``: tipforce's TIP05_Contact has the key (5, "Contact"),
    any other (0, name). "unknown" becomes NaN; ``say`` gets what is left out, multiplexed signals and messages over 8
    bytes. Raises InputError."""
    import cantools

    try:
        database = cantools.database.load_file(path)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except Exception as error:  # each of its parsers has its own errors
        raise InputError(f"{path}: not a database that cantools reads: {error}") from error
    messages = getattr(database, "messages", None)
    if messages is None or not hasattr(database, "get_message_by_frame_id"):
        raise InputError(f"{path}: contains no CAN messages")
    alike: dict[Message, Message] = {}  # one object per layout, so that nodes are decoded together
    left_out = [s.name for m in messages if m.length <= 8 for s in m.signals if s.multiplexer_ids]
    left_out += [message.name for message in messages if message.length > 8]
    if left_out:
        shown = f"{', '.join(left_out[:3])}{', ...' if len(left_out) > 3 else ''}"
        say(f"{path}: {len(left_out)} left out (multiplexed signals, messages over 8 bytes): {shown}")
    layouts = (_dbc_message(path, message) for message in messages if message.length <= 8)
    return {key: (can_id, alike.setdefault(layout, layout)) for key, can_id, layout in layouts}


def _pdo(place: str, cob_id: int, words: list[int]) -> tuple[int, tuple[tuple[int, int, int], ...]]:
    can_id = 0 if cob_id & COB_ID_INVALID else cob_id & EXTENDED_MASK
    if can_id > MAX_COB_ID:
        raise InputError(f"{place}: COB-ID 0x{cob_id:08X} of a TPDO: allowed are identifiers to 0x{MAX_COB_ID:X}")
    return can_id, tuple((word >> 16, word >> 8 & 0xFF, word & 0xFF) for word in words)


def _value(found: EdsFile, path: str | Path, index: int, sub: int, node_id: int) -> int | None:
    section = found.entry(index, sub)
    text = None if section is None else section.get("ParameterValue") or section.get("DefaultValue")
    return None if not text else _number(path, f"0x{index:04X}:{sub:02X}", text, node_id)


def _number(path: str | Path, place: str, text: str, node_id: int) -> int:
    from canopen_device.eds.values import integer

    number, _, remark, _ = integer(text, node_id)
    if number is None:
        raise InputError(f"{path}: {place} = {text!r}: {remark}")
    return number


def _dbc_message(path: str | Path, message: DbcMessage) -> tuple[Key, int, Message]:
    match = _OUR_NAME.fullmatch(message.name)
    key = (int(match[1]), match[2]) if match else (0, message.name)
    can_id = message.frame_id | EXTENDED_FLAG if message.is_extended_frame else message.frame_id
    signals = tuple(_dbc_signal(path, message, signal) for signal in message.signals if not signal.multiplexer_ids)
    layout = Message("tpdo", 0, key[1], 0, message.length, signals, (), True, 255, 0)
    return key, can_id, layout


def _dbc_signal(path: str | Path, message: DbcMessage, signal: DbcSignal) -> Signal:
    big_endian = signal.byte_order == "big_endian"
    start = signal.start
    if big_endian:  # a DBC gives the highest bit; here the lowest counts, from the end of the eighth byte
        start = 63 - (8 * (start // 8) + 7 - start % 8) - (signal.length - 1)
    if not 0 <= start <= 64 - signal.length:
        raise InputError(f"{path}: signal {signal.name} of {message.name} is not within eight bytes")
    unknown = [raw for raw, text in (signal.choices or {}).items() if str(text) == _UNKNOWN]
    return Signal(
        signal.name, start, signal.length, signal.is_signed, float(signal.scale), signal.unit or "",
        float(signal.minimum or 0), float(signal.maximum or 0), int(unknown[0]) if unknown else None,
        signal.comment or "", 0, 0, signal.is_float, float(signal.offset), big_endian,
    )  # fmt: skip


EdsFiles: TypeAlias = tuple[tuple[int, str], ...]
"""Of devices of any manufacturer: (node-id, EDS or DCF)."""

_SUFFIXES = ("_N", "_deg", "_ue", "_degC")


@dataclass(frozen=True, slots=True)
class Layouts:
    """A description for another process. ``nodes``: None for all; ``pdos``: (message, can_id, mapping) by node-id where
    not the default; ``eds``: (node-id, file) of devices of any manufacturer, whose PDOs alone are decoded then."""

    gauges: int = 3
    nodes: tuple[int, ...] | None = None
    dbc: str | None = None
    pdos: tuple[tuple[int, tuple[tuple[str, int, tuple[tuple[int, int, int], ...]], ...]], ...] = ()
    eds: EdsFiles = ()

    def decoder(self, services: bool = False, say: Callable[[str], object] = str) -> Decoder:
        """Return a separate decoder for each bus. Raises InputError for incompatible layouts. ``services``: of EMCY and
        heartbeats too (``health``), except for a DBC. ``say``: see ``dbc_messages``."""
        if self.dbc is not None:
            given = dbc_messages(self.dbc, say)
            return Decoder.of_messages({k: v for k, v in given.items() if self.nodes is None or k[0] in self.nodes})
        nodes = range(1, 128) if self.nodes is None else self.nodes
        if self.eds:
            from tipforce.host.decoding.eds_decoder import EdsDecoder

            return EdsDecoder((node, path) for node, path in self.eds if node in nodes)
        decoder = Decoder(self.gauges, nodes, SERVICES if services else ())
        for node, name, can_id, mapping in ((node, *pdo) for node, pdos in self.pdos if node in nodes for pdo in pdos):
            decoder.remap(node, name, can_id, mapping)
        return decoder


def with_layouts(layouts: Layouts, nodes: Iterable[NodeLayout]) -> Layouts:
    """Use the PDOs of these nodes. Raises InputError for a repeated node-id, and for different numbers of gauges."""
    given = list(nodes)
    ids, gauges = [layout.node_id for layout in given], {layout.gauges for layout in given}
    if len(set(ids)) < len(ids):
        raise InputError(f"node-ids {ids}: each node has one layout")
    if len(gauges) > 1:
        raise InputError(f"nodes with {sorted(gauges)} gauges: one decode needs nodes with the same number")
    pdos = tuple((n.node_id, tuple((name, i, mapping) for name, (i, mapping) in n.pdos.items())) for n in given)
    return replace(layouts, gauges=gauges.pop() if gauges else layouts.gauges, pdos=layouts.pdos + pdos)


def signals_named(decoder: Decoder, names: Iterable[str]) -> tuple[str, ...]:
    """Return the signals for some names: `P` and `P_N` are the same. Raises InputError for an unknown name."""

    def signal(name: str) -> str:
        bare = next((name.removesuffix(suffix) for suffix in _SUFFIXES if name.endswith(suffix)), name)
        return name if bare == name or has_signal(decoder, name) else bare

    signals = tuple(dict.fromkeys(map(signal, names)))
    decoder.plan(signals)
    return signals


def has_signal(decoder: Decoder, name: str) -> bool:
    """Return whether any message of the decoder has a signal."""
    messages = {id(message): message for _, message in decoder.messages().values()}  # one for many nodes
    return any(signal.name == name for message in messages.values() for signal in message.signals)
