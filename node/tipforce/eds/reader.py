"""Read an EDS or DCF completely: general sections, objects, and the checks between them."""

from __future__ import annotations

from pathlib import Path

from tipforce.eds import values
from tipforce.eds.checks import check
from tipforce.eds.compact_pdo import add_compact_pdos
from tipforce.eds.description import Description
from tipforce.eds.objects import read_objects
from tipforce.eds.sections import EdsFile, Section, read
from tipforce.eds.standard import add_mandatory
from tipforce.errors import InputError

_COMMISSIONING = ("devicecomissioning", "devicecommissioning")  # CiA 306 spells it with one m
_BIT_RATES_KBIT_S = (10, 20, 50, 125, 250, 500, 800, 1000)
_CONFIGURED = (".dcf", ".xdc")  # of one node
_UNCONFIGURED, _LAST_NODE_ID = 255, 127
_FIRST_DUMMY, _LAST_DUMMY = 1, 0x1B


def read_eds(path: str | Path, node_id: int | None = None) -> Description:
    """Return the device that an EDS, DCF, XDD or XDC describes, as node ``node_id`` (default: that of the DCF).

    ``Description.warnings`` says, by line, where the file leaves CiA 306-1, contradicts itself, or is incomplete, and
    how it is read there. Raises InputError for a file that cannot be read, is no EDS, has no object, or, without
    ``node_id``, names no node.
    """
    file = read(path)
    content = file.text.encode() if file.is_xml else Path(path).read_bytes()
    return describe(file, Path(path), content, node_id)


def describe(file: EdsFile, path: Path, content: bytes, node_id: int | None) -> Description:
    """Return the description of the sections of a file. Raises InputError as ``read_eds``."""
    found = Description(path, 0, findings=file.findings, content=content)
    commissioning = next((file.sections[name] for name in _COMMISSIONING if name in file.sections), None)
    found.is_dcf = commissioning is not None or path.suffix.lower() in _CONFIGURED
    if found.is_dcf and commissioning is None:
        found.add(0, "no section [DeviceComissioning], as a DCF has")
    found.node_id = _node_id(found, commissioning, node_id)
    _read_device_info(file.sections.get("deviceinfo"), found)
    if commissioning is not None:
        _read_commissioning(commissioning, found)
    _read_dummies(file.sections.get("dummyusage"), found)
    read_objects(file, found)
    if not found.objects:
        raise InputError(f"{path}: no object in it; an EDS has a section for each, such as [1000] and [1018sub1]")
    add_mandatory(found)
    add_compact_pdos(file, found)
    check(file, found)
    return found


def _node_id(found: Description, section: Section | None, given: int | None) -> int:
    text = (section.get("NodeID") if section is not None else None) or ""
    own = values.integer(text).value if text else None
    valid = own is not None and (1 <= own <= _LAST_NODE_ID or own == _UNCONFIGURED)
    if section is not None and text and not valid:
        found.findings.append(section.finding("NodeID", f"allowed are 1 to {_LAST_NODE_ID}"))
    if given is None:
        if own is None or not valid:
            raise InputError(f"{found.path}: names no node-id; give one, 1 to {_LAST_NODE_ID}")
        return own
    if (
        isinstance(given, bool)
        or not isinstance(given, int)
        or not (1 <= given <= _LAST_NODE_ID or given == _UNCONFIGURED)
    ):
        raise InputError(f"node-id {given!r}: allowed are 1 to {_LAST_NODE_ID}, and {_UNCONFIGURED} for none yet")
    if section is not None and valid and own != given:
        told = f"loaded as node {given}; values without $NODEID stay those of node {own}"
        found.findings.append(section.finding("NodeID", told))
    return given


def _read_device_info(section: Section | None, found: Description) -> None:
    if section is None:
        found.add(0, "no section [DeviceInfo]")
        return
    found.vendor_name = section.get("VendorName") or ""
    found.product_name = section.get("ProductName") or ""
    found.order_code = section.get("OrderCode") or ""
    rates = []
    for rate in _BIT_RATES_KBIT_S:
        if _flag(section, f"BaudRate_{rate}", found):
            rates.append(1000 * rate)
    found.bit_rates = tuple(rates)
    if section.get("LSS_Supported"):
        found.lss = _flag(section, "LSS_Supported", found)


def _flag(section: Section, key: str, found: Description) -> bool:
    text = section.get(key)
    if not text:
        return False
    value, _, remark = values.integer(text)
    if remark or value not in (0, 1):
        found.findings.append(section.finding(key, remark or "allowed are 0 and 1"))
    return bool(value)


def _read_commissioning(section: Section, found: Description) -> None:
    found.node_name = section.get("NodeName") or ""
    text = section.get("Baudrate")
    if text:
        rate, _, remark = values.integer(text)
        if rate in _BIT_RATES_KBIT_S:
            found.bit_rate = 1000 * rate if rate else None
        else:
            allowed = ", ".join(map(str, _BIT_RATES_KBIT_S))
            found.findings.append(section.finding("Baudrate", remark or f"allowed, in kbit/s, are {allowed}"))
    serial = section.get("LSS_SerialNumber")
    if serial:
        number, _, remark = values.integer(serial)
        if remark:
            found.findings.append(section.finding("LSS_SerialNumber", remark))
        found.serial = number or None  # 0: none is given


def _read_dummies(section: Section | None, found: Description) -> None:
    if section is None:
        return
    used = set()
    for key, text in section.keys.items():
        number = key.removeprefix("dummy")
        if number == key or not number.isalnum() or values.integer("0x" + number).value is None:
            found.findings.append(section.finding(key, "the form is Dummy0005=1; skipped"))
        elif values.integer(text).value:
            used.add(int(number, 16))
    outside = sorted(code for code in used if not _FIRST_DUMMY <= code <= _LAST_DUMMY)
    if outside:
        found.add(section.line, f"[{section.name}]: 0x{outside[0]:04X} is no data type; skipped")
    found.dummies = frozenset(used) - frozenset(outside)
