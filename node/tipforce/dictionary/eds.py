"""The EDS of a node and its DCF, from the table (CiA 306-1): lines end with LF, the dates are constants."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from canopen_device import types
from canopen_device.eds.sections import BIT_RATES_KBIT_S, lists_of
from tipforce.dictionary import table
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import entries, objects
from tipforce.errors import InputError, placed

if TYPE_CHECKING:
    from tipforce.dictionary.table import Converter

_DUMMY_TYPES = 7  # data types 0001h to 0007h: canopen wants all of them named
_REFUSE_WRITE, _REFUSE_READ = 1, 2  # ObjFlags: not to be written on download, not to be read on scan

Values = Mapping[tuple[int, int], types.Value]


def file_name(n: int = 3, simulated: bool = False, suffix: str = "eds", bits: int = 16) -> str:
    """The name under which the file of this node is kept, such as ``tipforce-3.eds``; ``bits`` of its converter."""
    return f"tipforce-{n}{f'-{bits}bit' if bits > 16 else ''}{'-simulated' if simulated else ''}.{suffix}"


def eds_text(
    n: int = 3, simulated: bool = False, converter: Converter = table.CONVERTER_16, programs: bool = False
) -> str:
    """The EDS of a node with ``n`` gauges (3..8, or InputError is raised); ``programs``: with program slots."""
    return _text(n, simulated, converter, programs, None, {})


def dcf_text(
    n: int, node_id: int, values: Values, simulated: bool = False, *, converter: Converter = table.CONVERTER_16,
    programs: bool = False,
) -> str:  # fmt: skip
    """The DCF of node ``node_id`` (1..127): its EDS with a ParameterValue for each (index, sub) of ``values``. Raises
    InputError for an entry that the node does not have or that is not of its type or limits."""
    if not 1 <= node_id <= 127:
        raise InputError(f"node-id {node_id}: allowed are 1 to 127")
    known = entries(n, simulated, programs)
    for (index, sub), value in values.items():
        entry, place = known.get((index, sub)), f"0x{index:04X}:{sub:02X}"
        if entry is None:
            raise InputError(f"{place}: no such object with {n} gauges")
        with placed(f"{place} ({entry.name})"):
            types.encode(entry.type, value)
            low, high = entry.low, entry.high
            if isinstance(value, int | float) and not (  # NaN is within no limits
                (low is None or value >= low) and (high is None or value <= high)
            ):
                raise InputError(f"{value}, allowed are {low} to {high}")
    return _text(n, simulated, converter, programs, node_id, values)


def value_text(letter: str, value: types.Value) -> str:
    """A value as CiA 306 has it: UNSIGNED32 and bytes in hex, others decimal, as canopen reads hex as unsigned."""
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


def _text(n: int, simulated: bool, converter: Converter, programs: bool, node_id: int | None, values: Values) -> str:
    lines = _general(n, simulated, converter, node_id)
    declared = objects(n, simulated, converter, programs)
    for name, listed in lists_of(each.index for each in declared).items():
        lines += [f"[{name}]", f"SupportedObjects={len(listed)}"]
        lines += [*(f"{k}=0x{index:04X}" for k, index in enumerate(listed, 1)), ""]
    for each in declared:
        if each.code == table.VAR:
            lines += [f"[{each.index:04X}]", *_entry(each.entries[0], values)]
            continue
        lines += [f"[{each.index:04X}]", f"ParameterName={each.name}", f"ObjectType=0x{each.code:X}"]
        lines += [f"SubNumber={len(each.entries)}", ""]
        for entry in each.entries:
            lines += [f"[{entry.index:04X}sub{entry.sub:X}]", *_entry(entry, values)]
    return "\n".join(lines)


def _general(n: int, simulated: bool, converter: Converter, node_id: int | None) -> list[str]:
    bits, note = converter[0], ", simulated" if simulated else ""
    time, date = "12:00AM", "01-01-2025"  # the form of CiA 306-1, 4.5.2: hh:mmAM, mm-dd-yyyy
    eds, own = file_name(n, simulated, "eds", bits), file_name(n, simulated, "dcf", bits)
    lines = [
        "[FileInfo]", f"FileName={eds if node_id is None else own}", "FileVersion=1", "FileRevision=0",
        "EDSVersion=4.0", f"Description=Fingertip force sensor with {n} strain gauges{note}",
        f"CreationTime={time}", f"CreationDate={date}", f"CreatedBy={__name__}",
        f"ModificationTime={time}", f"ModificationDate={date}", f"ModifiedBy={__name__}",
        *([] if node_id is None else [f"LastEDS={eds}"]), "",
        "[DeviceInfo]", "VendorName=tipforce", "VendorNumber=0x00000000",  # never blank: canopen can't read that
        f"ProductName=tipforce fingertip, {n} gauges{f', {bits} bits' if bits > 16 else ''}{note}",
        f"ProductNumber=0x{table.product_code(n, simulated, converter):08X}",
        f"RevisionNumber=0x{table.REVISION:08X}", f"OrderCode={eds.removesuffix('.eds')}",
        *(f"BaudRate_{rate}=1" for rate in BIT_RATES_KBIT_S),
        "SimpleBootUpMaster=0", "SimpleBootUpSlave=1", "Granularity=8", "DynamicChannelsSupported=0", "CompactPDO=0",
        "GroupMessaging=0", f"NrOfRXPDO={len(table.rpdos())}", f"NrOfTXPDO={len(table.tpdos(n))}",
        "LSS_Supported=1", "",
    ]  # fmt: skip
    if node_id is not None:
        lines += [
            "[DeviceComissioning]",  # spelt so in CiA 306
            f"NodeID=0x{node_id:02X}", f"NodeName=TIP{node_id:02d}", f"Baudrate={BIT_RATES_KBIT_S[-1]}", "NetNumber=1",
            "NetworkName=", "CANopenManager=0", "LSS_SerialNumber=0", "",
        ]  # fmt: skip
    lines += ["[DummyUsage]", *(f"Dummy{k:04d}=0" for k in range(1, _DUMMY_TYPES + 1)), "", "[Comments]", "Lines=3"]
    return [
        *lines,
        "Line1=Generated from the one object table of tipforce: change that, not this file.",
        f"Line2=CiA 404 analogue input channels: 1 to {n} gauges, then F1, F2, F3, P, phi, theta.",
        "Line3=Unknown is 0x8000 in INTEGER16, 0x80000000 in INTEGER32, 0xFFFF in UNSIGNED16, NaN in REAL32.",
        "",
    ]


def _entry(entry: Entry[Any], values: Values) -> list[str]:
    # Commands and states are not to be downloaded from a DCF; what is write-only can't be scanned.
    flags = _REFUSE_WRITE if entry.flags & table.NOT_STORED or entry.access == "wo" else 0
    flags |= _REFUSE_READ if entry.access == "wo" else 0
    keys = {
        "ParameterName": entry.title,
        "ObjectType": f"0x{table.VAR:X}",
        "DataType": f"0x{types.data_type(entry.type).code:04X}",
        "AccessType": access_text(entry),
        "DefaultValue": default_text(entry),
        "LowLimit": None if entry.low is None else value_text(entry.type, entry.low),
        "HighLimit": None if entry.high is None else value_text(entry.type, entry.high),
        "PDOMapping": int(entry.mappable),
        "ObjFlags": f"0x{flags:X}" if flags else None,
        "ParameterValue": value_text(entry.type, values[entry.key]) if entry.key in values else None,
    }
    return [*(f"{key}={text}" for key, text in keys.items() if text is not None), ""]
