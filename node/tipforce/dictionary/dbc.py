"""One .dbc for a hand of nodes, from the table: a message per TPDO and node, and the CANopen services."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from typing import TYPE_CHECKING

from canopen_device.core import codes, emcy
from tipforce.dictionary import signals, table
from tipforce.errors import InputError

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal
    from cantools.database.namedsignalvalue import NamedSignalValue

HOST = "HOST"
EMCY_CODES = {
    emcy.NO_ERROR: "no error",
    table.EMCY_TEMPERATURE: "temperature",
    table.EMCY_GAUGE_SATURATED: "gauge saturated",
    table.EMCY_OVERLOAD: "overload",
    table.EMCY_FRONT_END: "front end",
    table.EMCY_CALIBRATION_INVALID: "stored calibration invalid",
    emcy.CAN_OVERRUN: "CAN overrun",
    emcy.ERROR_PASSIVE: "CAN error passive",
    emcy.HEARTBEAT_LOST: "heartbeat lost",
    emcy.BUS_OFF_RECOVERED: "recovered from bus-off",
    emcy.COB_ID_COLLISION: "COB-ID collision",
    emcy.PDO_LENGTH: "PDO length",
    emcy.SYNC_LENGTH: "SYNC length",
    emcy.RPDO_TIMEOUT: "RPDO timeout",
    emcy.WEAR_BUDGET_EMPTY: "too many stores or erases",
}
NMT_STATES = {
    codes.INITIALISING: "boot-up",
    codes.STOPPED: "stopped",
    codes.OPERATIONAL: "operational",
    codes.PRE_OPERATIONAL: "pre-operational",
}
NMT_COMMANDS = {
    codes.NMT_START: "start",
    codes.NMT_STOP: "stop",
    codes.NMT_ENTER_PRE_OPERATIONAL: "enter pre-operational",
    codes.NMT_RESET_NODE: "reset node",
    codes.NMT_RESET_COMMUNICATION: "reset communication",
}
_RPDO_COMMANDS = {
    table.COMMAND_TARE: "tare",
    table.COMMAND_CLEAR_TARE: "clear tare",
    table.COMMAND_ZERO: "zero gauges",
}


def node_name(node_id: int) -> str:
    """The name of a node in the .dbc: TIP05."""
    return f"TIP{node_id:02d}"


def dbc_text(node_ids: Iterable[int] = range(1, 16), n: int = 3) -> str:
    """The .dbc of these nodes, all with ``n`` gauges and the default COB-IDs; lines end with LF.

    Raises InputError for a node-id outside 1..127 or given twice, and for an ``n`` outside 3..8.
    """
    from cantools.database.can import Database, Node  # 0.3 s, and nothing else here needs it

    ids = list(node_ids)
    for node_id in ids:
        if not 1 <= node_id <= 127 or ids.count(node_id) > 1:
            raise InputError(f"node-id {node_id}: allowed are 1 to 127, each once")
    messages = _network(ids)
    for node_id in ids:
        messages += _node(node_id, n)
    messages.sort(key=lambda message: message.frame_id)
    nodes = [Node(HOST, "the computer that reads the sensors")]
    nodes += [Node(node_name(k), f"fingertip with node-id {k}, {n} gauges") for k in ids]
    database = Database(messages, nodes, version=table.SOFTWARE_VERSION)
    text = database.as_dbc_string(sort_signals=None, sort_attribute_signals=None).replace("\r\n", "\n")
    return text.rstrip("\n") + "\n"  # cantools ends with empty lines, one per kind of entry that there is not


def _network(ids: list[int]) -> list[Message]:
    nodes = [node_name(k) for k in ids]
    command = _signal("command", 0, 8, nodes, 0, 255, "NMT command (CiA 301, 7.2.8.3.1)", choices=NMT_COMMANDS)
    node = _signal("node", 8, 8, nodes, 0, 127, "node-id, 0 for all nodes", choices={0: "all"})
    return [
        _message(codes.NMT_COB_ID, "NMT", 2, [command, node], HOST, "network management: changes the state of nodes"),
        _message(codes.SYNC_COB_ID, "SYNC", 0, [], HOST, "all PDOs of one SYNC carry the same sample and counter"),
    ]


def _node(node_id: int, n: int) -> list[Message]:
    name = node_name(node_id)
    pdos = [m for m in signals.tpdo_messages(n) + signals.rpdo_messages() if m.cob_id_base]
    return [*(_pdo(pdo, node_id) for pdo in pdos), _emcy(name, node_id), _heartbeat(name, node_id)]


def _pdo(pdo: signals.Message, node_id: int) -> Message:
    name = node_name(node_id)
    sender, receiver = (name, HOST) if pdo.kind == "tpdo" else (HOST, name)
    when = "at every SYNC" if pdo.transmission_type == 1 else "event-driven"
    if pdo.event_timer_ms:
        when = f"every {pdo.event_timer_ms} ms"
    text = f"{pdo.kind.upper()}{pdo.number}, {when}" + ("" if pdo.enabled else "; disabled by default")
    return _message(
        pdo.cob_id_base + node_id, f"{name}_{pdo.name}", pdo.length_bytes,
        [_pdo_signal(signal, receiver) for signal in pdo.signals], sender, text,
    )  # fmt: skip


def _pdo_signal(signal: signals.Signal, receiver: str) -> Signal:
    choices = {} if signal.unknown is None else {signal.unknown: "unknown"}
    if signal.name == "command":
        choices = _RPDO_COMMANDS
    return _signal(
        signal.name, signal.start_bit, signal.bits, [receiver], signal.minimum, signal.maximum,
        signal.description, signed=signal.signed, scale=signal.scale, unit=signal.unit, choices=choices,
        real=signal.real,
    )  # fmt: skip


def _emcy(name: str, node_id: int) -> Message:
    parts = [
        _signal("error_code", 0, 16, [HOST], 0, 0xFFFF, "emergency error code", choices=EMCY_CODES),
        _signal("error_register", 16, 8, [HOST], 0, 0xFF, "object 1001h: bit 0 is set with any error"),
    ]
    parts += [
        _signal(f"manufacturer_{k + 1}", 24 + 8 * k, 8, [HOST], 0, 0xFF, f"byte {k + 1} of 5 that tell more")
        for k in range(5)
    ]
    return _message(codes.EMCY_BASE + node_id, f"{name}_EMCY", 8, parts, name, "emergency: an error came or went")


def _heartbeat(name: str, node_id: int) -> Message:
    parts = [
        _signal("state", 0, 7, [HOST], 0, 127, "NMT state (CiA 301, 7.2.8.3.2)", choices=NMT_STATES),
        _signal("toggle", 7, 1, [HOST], 0, 1, "node guarding alternates it, a heartbeat has 0"),
    ]
    comment = "heartbeat, boot-up and node guarding"
    return _message(codes.HEARTBEAT_BASE + node_id, f"{name}_Heartbeat", 1, parts, name, comment)


def _message(frame_id: int, name: str, length: int, parts: list[Signal], sender: str, comment: str) -> Message:
    from cantools.database.can import Message

    return Message(frame_id, name, length, parts, comment=comment, senders=[sender], strict=True)


def _signal(
    name: str,
    start: int,
    bits: int,
    receivers: list[str],
    minimum: float,
    maximum: float,
    comment: str,
    *,
    signed: bool = False,
    scale: float = 1,
    unit: str = "",
    choices: dict[int, str] | None = None,
    real: bool = False,
) -> Signal:
    from cantools.database.can import Signal
    from cantools.database.conversion import BaseConversion

    named = OrderedDict[int, "str | NamedSignalValue"](choices or {}) or None
    conversion = BaseConversion.factory(scale=scale, offset=0, choices=named, is_float=real)
    return Signal(
        name, start, bits, is_signed=signed, conversion=conversion, minimum=minimum, maximum=maximum,
        unit=unit or None, comment=comment, receivers=receivers,
    )  # fmt: skip
