"""One .dbc for a hand of nodes, from the table: a message per TPDO and node, and the CANopen services."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from canopen_device.core import codes
from tipforce.dictionary import signals, table
from tipforce.dictionary.service_texts import EMCY_CODES, NMT_COMMANDS, NMT_STATES
from tipforce.errors import InputError

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.namedsignalvalue import NamedSignalValue

HOST = "HOST"
_CHOICES = {
    ("NMT", "command"): NMT_COMMANDS,
    ("NMT", "node"): {0: "all"},
    ("EMCY", "error_code"): EMCY_CODES,
    ("Heartbeat", "state"): NMT_STATES,
    ("Command", "command"): {
        table.COMMAND_TARE: "tare", table.COMMAND_CLEAR_TARE: "clear tare", table.COMMAND_ZERO: "zero gauges",
    },
}  # fmt: skip
"""By message and signal."""


def dbc_text(node_ids: Iterable[int] = range(1, 16), n: int = 3) -> str:
    """The .dbc of these nodes, all with ``n`` gauges and the default COB-IDs; lines end with LF. Raises InputError for
    a node-id outside 1..127 or given twice, and for an ``n`` outside 3..8."""
    from cantools.database.can import Database, Node  # 0.3 s, and nothing else here needs it

    ids = list(node_ids)
    for node_id in ids:
        if not 1 <= node_id <= 127 or ids.count(node_id) > 1:
            raise InputError(f"node-id {node_id}: allowed are 1 to 127, each once")
    names = [f"TIP{node_id:02d}" for node_id in ids]
    command = _number("command", 0, 8, "NMT command (CiA 301, 7.2.8.3.1)")
    node = _number("node", 8, 8, "node-id, 0 for all nodes", 127)
    text = "network management: changes the state of nodes"
    messages = [_message(codes.NMT_COB_ID, "NMT", 2, (command, node), HOST, names, text)]
    text = "all PDOs of one SYNC carry the same sample and counter"
    messages.append(_message(codes.SYNC_COB_ID, "SYNC", 0, (), HOST, names, text))
    for node_id, name in zip(ids, names, strict=True):
        messages += _of_node(node_id, name, n)
    messages.sort(key=lambda message: message.frame_id)
    nodes = [Node(HOST, "the computer that reads the sensors")]
    nodes += [Node(name, f"fingertip with node-id {k}, {n} gauges") for k, name in zip(ids, names, strict=True)]
    database = Database(messages, nodes, version=table.SOFTWARE_VERSION)
    text = database.as_dbc_string(sort_signals=None, sort_attribute_signals=None).replace("\r\n", "\n")
    return text.rstrip("\n") + "\n"  # cantools ends with empty lines, one per kind of entry that there is not


def _of_node(node_id: int, name: str, n: int) -> list[Message]:
    messages = []
    for pdo in signals.tpdo_messages(n) + signals.rpdo_messages():
        if pdo.cob_id_base:
            sender, receiver = (name, HOST) if pdo.kind == "tpdo" else (HOST, name)
            when = "at every SYNC" if pdo.transmission_type == 1 else "event-driven"
            if pdo.event_timer_ms:
                when = f"every {pdo.event_timer_ms} ms"
            text = f"{pdo.kind.upper()}{pdo.number}, {when}" + ("" if pdo.enabled else "; disabled by default")
            can_id, title = pdo.cob_id_base + node_id, f"{name}_{pdo.name}"
            messages.append(_message(can_id, title, pdo.length_bytes, pdo.signals, sender, [receiver], text))
    emcy = [
        _number("error_code", 0, 16, "emergency error code"),
        _number("error_register", 16, 8, "object 1001h: bit 0 is set with any error"),
        *(_number(f"manufacturer_{k}", 16 + 8 * k, 8, f"byte {k} of 5 that tell more") for k in range(1, 6)),
    ]
    heartbeat = [_number("state", 0, 7, "NMT state (CiA 301, 7.2.8.3.2)")]
    heartbeat.append(_number("toggle", 7, 1, "node guarding alternates it, a heartbeat has 0"))
    for base, title, length, parts, text in (
        (codes.EMCY_BASE, "EMCY", 8, emcy, "emergency: an error came or went"),
        (codes.HEARTBEAT_BASE, "Heartbeat", 1, heartbeat, "heartbeat, boot-up and node guarding"),
    ):
        messages.append(_message(base + node_id, f"{name}_{title}", length, parts, name, [HOST], text))
    return messages


def _number(name: str, start: int, bits: int, text: str, highest: int = 0) -> signals.Signal:
    return signals.Signal(name, start, bits, False, 1, "", 0, highest or (1 << bits) - 1, None, text, 0, 0)


def _message(
    can_id: int, name: str, length: int, parts: Sequence[signals.Signal], sender: str, receivers: list[str], text: str
) -> Message:
    from cantools.database.can import Message, Signal
    from cantools.database.conversion import BaseConversion

    converted = []
    for part in parts:
        choices = _CHOICES.get((name.rpartition("_")[2], part.name), {})
        if part.unknown is not None:
            choices = {part.unknown: "unknown"}
        named = OrderedDict[int, "str | NamedSignalValue"](choices) or None
        signal = Signal(
            part.name, part.start_bit, part.bits, is_signed=part.signed, minimum=part.minimum, maximum=part.maximum,
            conversion=BaseConversion.factory(scale=part.scale, offset=0, choices=named, is_float=part.real),
            unit=part.unit or None, comment=part.description, receivers=receivers,
        )  # fmt: skip
        converted.append(signal)
    return Message(can_id, name, length, converted, comment=text, senders=[sender], strict=True)
