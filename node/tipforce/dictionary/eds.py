"""The electronic data sheet of a node and its device configuration file, from the table (CiA 306-1).

The text is the same at each run: the dates are constants. Lines end with LF; CiA 306 tools read both.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from canopen_device import types
from canopen_device.core import communication
from tipforce.dictionary import table
from tipforce.dictionary.entries import Entry, Object, entries, objects
from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.dictionary.table import Converter

CREATION_TIME, CREATION_DATE = "12:00AM", "01-01-2025"  # the form of CiA 306-1, 4.5.2: hh:mmAM, mm-dd-yyyy
CREATED_BY = "tipforce.dictionary.eds"
BIT_RATES_KBIT_S = (10, 20, 50, 125, 250, 500, 800, 1000)
DEFAULT_BIT_RATE_KBIT_S = 1000
DUMMY_TYPES = 7  # data types 0001h to 0007h: canopen wants all of them named

_REFUSE_WRITE, _REFUSE_READ = 1, 2  # ObjFlags: not to be written on download, not to be read on scan

Values = Mapping[tuple[int, int], types.Value]
_Lines = list[str]


def file_name(n: int = 3, simulated: bool = False, suffix: str = "eds", bits: int = 16) -> str:
    """The name under which the file of this node is kept, such as ``tipforce-3.eds``; ``bits`` of its converter."""
    return f"{_kind(n, simulated, bits)}.{suffix}"


def _kind(n: int, simulated: bool, bits: int) -> str:
    return f"tipforce-{n}" + (f"-{bits}bit" if bits > 16 else "") + ("-simulated" if simulated else "")


def eds_text(
    n: int = 3, simulated: bool = False, converter: Converter = table.CONVERTER_16, programs: bool = False
) -> str:
    """The EDS of a node with ``n`` gauges; ``programs``: with program slots.

    Raises InputError for an ``n`` outside 3..8.
    """
    declared = objects(n, simulated, converter, programs)
    lines = _file_info(n, simulated, "eds", converter) + _device_info(n, simulated, converter)
    lines += _dummy_usage() + _comments(n)
    return "\n".join(lines + _object_lists(declared) + _sections(declared, None))


def dcf_text(
    n: int,
    node_id: int,
    values: Values,
    simulated: bool = False,
    *,
    bit_rate_kbit_s: int = DEFAULT_BIT_RATE_KBIT_S,
    node_name: str = "",
    last_eds: str | None = None,
    converter: Converter = table.CONVERTER_16,
    programs: bool = False,
) -> str:
    """The DCF of node ``node_id`` (1..127): its EDS with a ParameterValue for each (index, sub) of ``values``.

    Raises InputError for an entry that the node does not have or that is not of its type or limits.
    """
    if not 1 <= node_id <= 127:
        raise InputError(f"node-id {node_id}: allowed are 1 to 127")
    if bit_rate_kbit_s not in BIT_RATES_KBIT_S:
        raise InputError(f"bit rate {bit_rate_kbit_s} kbit/s: allowed are {BIT_RATES_KBIT_S}")
    known = entries(n, simulated, programs)
    for place, value in values.items():
        _check(known.get(place), place, value, n)
    declared = objects(n, simulated, converter, programs)
    lines = _file_info(n, simulated, "dcf", converter)
    lines.insert(-1, f"LastEDS={last_eds or file_name(n, simulated, bits=converter[0])}")
    lines += _device_info(n, simulated, converter) + _commissioning(node_id, bit_rate_kbit_s, node_name)
    lines += _dummy_usage() + _comments(n) + _object_lists(declared) + _sections(declared, values)
    return "\n".join(lines)


def value_text(letter: str, value: types.Value) -> str:
    """A value as CiA 306 writes it: UNSIGNED32 in hex, other integers and REAL32 in decimal, bytes as hex.

    Signed defaults stay decimal: hex ones are read as unsigned by canopen.
    """
    if letter == "I" and isinstance(value, int):
        return f"0x{value:08X}"
    text = types.format_value(letter, value)
    return text.replace(" ", "") if letter in "Do" else text


def lely_dialect(text: str) -> str:
    """An EDS or DCF with each REAL32 value as its bits in hexadecimal, as Lely's dcfgen needs it."""
    lines, is_real = [], False
    for line in text.split("\n"):
        key, equal, value = line.partition("=")
        if line.startswith("["):
            is_real = False
        elif key == "DataType":
            is_real = int(value, 0) == types.data_type("f").code
        elif is_real and value and key in ("DefaultValue", "LowLimit", "HighLimit", "ParameterValue"):
            value = f"0x{int.from_bytes(types.encode('f', float(value)), 'little'):08X}"
        lines.append(key + equal + value)
    return "\n".join(lines)


def default_text(entry: Entry[Any]) -> str:
    """``DefaultValue`` of an entry; a COB-ID that follows the node-id is written ``$NODEID+0x180``."""
    if entry.type == "D":
        return ""
    if entry.flags & table.ADD_NODE_ID:
        return f"$NODEID+0x{int(entry.default):X}"
    return value_text(entry.type, entry.default)


def access_text(entry: Entry[Any]) -> str:
    """``AccessType``: read-write entries that only one direction of PDO may carry are rwr or rww (CiA 306-1)."""
    direction = entry.flags & (table.TPDO | table.RPDO)
    if entry.access == "rw" and direction in (table.TPDO, table.RPDO):
        return "rwr" if direction == table.TPDO else "rww"
    return entry.access


def obj_flags(entry: Entry[Any]) -> int:
    """``ObjFlags``: commands and states are not to be downloaded from a DCF; what is wo can't be scanned."""
    flags = _REFUSE_WRITE if entry.flags & table.NOT_STORED or entry.access == "wo" else 0
    return flags | (_REFUSE_READ if entry.access == "wo" else 0)


def _file_info(n: int, simulated: bool, suffix: str, converter: Converter) -> _Lines:
    return [
        "[FileInfo]",
        f"FileName={file_name(n, simulated, suffix, converter[0])}",
        "FileVersion=1",
        "FileRevision=0",
        "EDSVersion=4.0",
        f"Description=Fingertip force sensor with {n} strain gauges" + (", simulated" if simulated else ""),
        f"CreationTime={CREATION_TIME}",
        f"CreationDate={CREATION_DATE}",
        f"CreatedBy={CREATED_BY}",
        f"ModificationTime={CREATION_TIME}",
        f"ModificationDate={CREATION_DATE}",
        f"ModifiedBy={CREATED_BY}",
        "",
    ]


def _device_info(n: int, simulated: bool, converter: Converter) -> _Lines:
    wide = f", {converter[0]} bits" if converter[0] > 16 else ""
    return [
        "[DeviceInfo]",
        "VendorName=tipforce",
        "VendorNumber=0x00000000",  # never blank: canopen can't read that
        f"ProductName=tipforce fingertip, {n} gauges{wide}" + (", simulated" if simulated else ""),
        f"ProductNumber=0x{table.product_code(n, simulated, converter):08X}",
        f"RevisionNumber=0x{table.REVISION:08X}",
        f"OrderCode={_kind(n, simulated, converter[0])}",
        *(f"BaudRate_{rate}=1" for rate in BIT_RATES_KBIT_S),
        "SimpleBootUpMaster=0",
        "SimpleBootUpSlave=1",
        "Granularity=8",
        "DynamicChannelsSupported=0",
        "CompactPDO=0",
        "GroupMessaging=0",
        f"NrOfRXPDO={len(table.rpdos())}",
        f"NrOfTXPDO={len(table.tpdos(n))}",
        "LSS_Supported=1",
        "",
    ]


def _commissioning(node_id: int, bit_rate_kbit_s: int, node_name: str) -> _Lines:
    return [
        "[DeviceComissioning]",  # spelt so in CiA 306
        f"NodeID=0x{node_id:02X}",
        f"NodeName={node_name or f'TIP{node_id:02d}'}",
        f"Baudrate={bit_rate_kbit_s}",
        "NetNumber=1",
        "NetworkName=",
        "CANopenManager=0",
        "LSS_SerialNumber=0",
        "",
    ]


def _dummy_usage() -> _Lines:
    return ["[DummyUsage]", *(f"Dummy{k:04d}=0" for k in range(1, DUMMY_TYPES + 1)), ""]


def _comments(n: int) -> _Lines:
    notes = (
        "Generated from the one object table of tipforce: change that, not this file.",
        f"CiA 404 analogue input channels: 1 to {n} gauges, then F1, F2, F3, P, phi, theta.",
        "Unknown is 0x8000 in INTEGER16, 0x80000000 in INTEGER32, 0xFFFF in UNSIGNED16, NaN in REAL32.",
    )
    numbered = (f"Line{k}={note}" for k, note in enumerate(notes, 1))
    return ["[Comments]", f"Lines={len(notes)}", *numbered, ""]


def _object_lists(declared: tuple[Object, ...]) -> _Lines:
    indices = [o.index for o in declared]
    manufacturer = [i for i in indices if communication.FIRST_MANUFACTURER <= i <= communication.LAST_MANUFACTURER]
    mandatory = [i for i in indices if i in communication.MANDATORY]
    optional = [i for i in indices if i not in communication.MANDATORY and i not in manufacturer]
    lines: _Lines = []
    for name, listed in (("Mandatory", mandatory), ("Optional", optional), ("Manufacturer", manufacturer)):
        lines += [f"[{name}Objects]", f"SupportedObjects={len(listed)}"]
        lines += [f"{k}=0x{index:04X}" for k, index in enumerate(listed, 1)]
        lines.append("")
    return lines


def _sections(declared: tuple[Object, ...], values: Values | None) -> _Lines:
    lines: _Lines = []
    for each in declared:
        if each.code == table.VAR:
            lines += [f"[{each.index:04X}]", *_entry(each.entries[0], values)]
            continue
        lines += [
            f"[{each.index:04X}]",
            f"ParameterName={each.name}",
            f"ObjectType=0x{each.code:X}",
            f"SubNumber={len(each.entries)}",
            "",
        ]
        for entry in each.entries:
            lines += [f"[{entry.index:04X}sub{entry.sub:X}]", *_entry(entry, values)]
    return lines


def _entry(entry: Entry[Any], values: Values | None) -> _Lines:
    lines = [
        f"ParameterName={entry.title}",
        f"ObjectType=0x{table.VAR:X}",
        f"DataType=0x{types.data_type(entry.type).code:04X}",
        f"AccessType={access_text(entry)}",
        f"DefaultValue={default_text(entry)}",
    ]
    if entry.low is not None:
        lines.append(f"LowLimit={value_text(entry.type, entry.low)}")
    if entry.high is not None:
        lines.append(f"HighLimit={value_text(entry.type, entry.high)}")
    lines.append(f"PDOMapping={int(entry.mappable)}")
    if obj_flags(entry):
        lines.append(f"ObjFlags=0x{obj_flags(entry):X}")
    if values is not None and (entry.index, entry.sub) in values:
        lines.append(f"ParameterValue={value_text(entry.type, values[entry.index, entry.sub])}")
    return [*lines, ""]


def _check(entry: Entry[Any] | None, place: tuple[int, int], value: types.Value, n: int) -> None:
    where = f"0x{place[0]:04X}:{place[1]:02X}"
    if entry is None:
        raise InputError(f"{where}: no such object with {n} gauges")
    try:
        types.encode(entry.type, value)
    except InputError as error:
        raise InputError(f"{where} ({entry.name}): {error}") from None
    if isinstance(value, int | float) and not _within(entry, value):
        raise InputError(f"{where} ({entry.name}): {value}, allowed are {entry.low} to {entry.high}")


def _within(entry: Entry[Any], value: float) -> bool:
    """NaN is within no limits."""
    return (entry.low is None or value >= entry.low) and (entry.high is None or value <= entry.high)
