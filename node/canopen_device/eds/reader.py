"""Read an EDS or DCF completely: general sections, objects, and the checks between them."""

from pathlib import Path

from canopen_device.eds import values
from canopen_device.eds.description import Description
from canopen_device.eds.objects import read_objects
from canopen_device.eds.sections import BIT_RATES_KBIT_S, MOST_BYTES, EdsFile, Section, decoded, parse, read_key
from canopen_device.eds.standard import add_compact_pdos, add_mandatory, check
from canopen_device.errors import InputError

_COMMISSIONING = ("devicecomissioning", "devicecommissioning")  # CiA 306 spells it with one m
_CONFIGURED = (".dcf", ".xdc")  # of one node
_UNCONFIGURED, _LAST_NODE_ID = 255, 127
_NODE_IDS = (*range(1, _LAST_NODE_ID + 1), _UNCONFIGURED)
_FIRST_DUMMY, _LAST_DUMMY = 1, 0x1B


def read_eds(path: str | Path, node_id: int | None = None) -> Description:
    """Return the device that an EDS, DCF, XDD or XDC describes, as node ``node_id`` (default: of the DCF), with
    ``warnings``. Raises InputError for a file that is no EDS, has no object, or, without ``node_id``, names no node."""
    return describe(read(path), node_id)


def read(path: str | Path) -> EdsFile:
    """Return the sections of an EDS, DCF, XDD or XDC. Raises InputError for what cannot be read, or has none at all."""
    try:
        content = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    if len(content) > MOST_BYTES:
        raise InputError(f"{path}: {len(content)} bytes; an EDS or DCF has at most {MOST_BYTES}")
    if decoded(content)[0].lstrip().startswith("<"):
        from canopen_device.eds.xdd import read_xdd

        return read_xdd(path, content)
    file = parse(content, path)
    if not file.sections:
        raise InputError(
            f"{path}: no [section] in it; an EDS or DCF (CiA 306) has [FileInfo], [DeviceInfo], [1000], ..."
        )
    return file


def describe(file: EdsFile, node_id: int | None) -> Description:
    """Return the description of the sections of a file. Raises InputError as ``read_eds``."""
    path = Path(file.path)
    described = Description(path, 0, findings=file.findings, content=file.content)
    commissioning = next((file.sections[name] for name in _COMMISSIONING if name in file.sections), None)
    described.is_dcf = commissioning is not None or path.suffix.lower() in _CONFIGURED
    if described.is_dcf and commissioning is None:
        described.add(0, "no section [DeviceComissioning], as a DCF has")
    described.node_id = _node_id(described, commissioning, node_id)
    info = file.sections.get("deviceinfo")
    if info is None:
        described.add(0, "no section [DeviceInfo]")
    else:
        described.vendor_name, described.product_name, described.order_code, described.lss = (
            read_key(info, key) for key in ("VendorName", "ProductName", "OrderCode", "LSS_Supported")
        )
        described.bit_rates = tuple(1000 * rate for rate in BIT_RATES_KBIT_S if read_key(info, f"BaudRate_{rate}"))
    if commissioning is not None:
        described.node_name = read_key(commissioning, "NodeName")
        described.bit_rate = read_key(commissioning, "Baudrate")
        described.serial = read_key(commissioning, "LSS_SerialNumber") or None  # 0: none is given
    if "dummyusage" in file.sections:
        _read_dummies(file.sections["dummyusage"], described)
    read_objects(file, described)
    if not described.objects:
        raise InputError(f"{path}: no object in it; an EDS has a section for each, such as [1000] and [1018sub1]")
    add_mandatory(described)
    add_compact_pdos(file, described)
    check(file, described)
    return described


def _node_id(described: Description, section: Section | None, given: int | None) -> int:
    text = (section.get("NodeID") if section is not None else None) or ""
    own = values.integer(text).value if text else None
    valid = own in _NODE_IDS
    if section is not None and text and not valid:
        section.say("NodeID", f"allowed are 1 to {_LAST_NODE_ID}")
    if given is None:
        if own is None or not valid:
            raise InputError(f"{described.path}: names no node-id; give one, 1 to {_LAST_NODE_ID}")
        return own
    if isinstance(given, bool) or not isinstance(given, int) or given not in _NODE_IDS:
        raise InputError(f"node-id {given!r}: allowed are 1 to {_LAST_NODE_ID}, and {_UNCONFIGURED} for none yet")
    if section is not None and valid and own != given:
        section.say("NodeID", f"loaded as node {given}; values without $NODEID stay those of node {own}")
    return given


def _read_dummies(section: Section, described: Description) -> None:
    used = set()
    for key, text in section.keys.items():
        number = key.removeprefix("dummy")
        if number == key or not number.isalnum() or values.integer("0x" + number).value is None:
            section.say(key, "the form is Dummy0005=1; skipped")
        elif values.integer(text).value:
            used.add(int(number, 16))
    outside = sorted(code for code in used if not _FIRST_DUMMY <= code <= _LAST_DUMMY)
    if outside:
        described.add(section.line, f"[{section.name}]: 0x{outside[0]:04X} is no data type; skipped")
    described.dummies = frozenset(used) - frozenset(outside)
