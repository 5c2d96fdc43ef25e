"""The keys of an EDS or DCF that have one form: parser, default, name in an XDD (CiA 306-1, CiA 311).

Keys whose value depends on others (DataType, AccessType, the values and limits of an entry) are read in ``objects``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from canopen_device.eds import values
from canopen_device.eds.sections import Section

BIT_RATES_KBIT_S = (10, 20, 50, 125, 250, 500, 800, 1000)
LONGEST_NAME = 255  # CiA 306-1 has 241
_CODES = {"domain": 2, "var": 7, "array": 8, "record": 9}  # of ObjectType, in words
_MAPPABLE = ("optional", "default", "tpdo", "rpdo", "on", "y")  # in words, as an XDD has it

Parsed = tuple[Any, str]
"""A value, None for what is none, and a remark, "" where the text is as CiA 306-1 has it."""


def _text(text: str) -> Parsed:
    return text, ""


def _name(text: str) -> Parsed:
    return text[:LONGEST_NAME], f"cut to {LONGEST_NAME} characters" if len(text) > LONGEST_NAME else ""


def _number(text: str) -> Parsed:
    value, _, remark = values.integer(text)
    return value, remark


def _code(text: str) -> Parsed:
    code = _CODES.get(text.lower())
    return _number(text) if code is None else (code, f"the form is a number; read as 0x{code:X}")


def _flag(text: str) -> Parsed:
    value, remark = _number(text)
    return bool(value), remark or ("" if value in (0, 1) else "allowed are 0 and 1")


def _mapping(text: str) -> Parsed:
    if text in ("0", "1"):
        return text == "1", ""
    value, remark = _number(text)
    if value is None:
        value = int(text.lower() in _MAPPABLE)
        remark = f"the form is 0 or 1; read as {value}"
    return bool(value), remark


def _bit_rate(text: str) -> Parsed:
    rate, remark = _number(text)
    if rate in BIT_RATES_KBIT_S:
        return 1000 * rate, ""
    return None, remark or f"allowed, in kbit/s, are {', '.join(map(str, BIT_RATES_KBIT_S))}"


class Key(NamedTuple):
    """How a key is read, its value where it is missing or nothing can be read, and its name in an XDD."""

    parse: Callable[[str], Parsed] = _text
    default: Any = ""
    xdd: str = ""


KEYS = {
    # of an entry
    "ParameterName": Key(_name, xdd="name"),
    "ObjectType": Key(_code, None, "objectType"),
    "SubNumber": Key(_number, None, "subNumber"),
    "DataType": Key(xdd="dataType"),
    "AccessType": Key(xdd="accessType"),
    "DefaultValue": Key(xdd="defaultValue"),
    "ParameterValue": Key(xdd="actualValue"),
    "LowLimit": Key(xdd="lowLimit"),
    "HighLimit": Key(xdd="highLimit"),
    "PDOMapping": Key(_mapping, False, "PDOmapping"),
    "ObjFlags": Key(_number, 0, "objFlags"),
    "Denotation": Key(xdd="denotation"),
    "CompactSubObj": Key(_number, 0),
    # of [DeviceInfo]
    "VendorName": Key(xdd="vendorName"),
    "VendorNumber": Key(xdd="vendorID"),
    "ProductName": Key(xdd="productName"),
    "ProductNumber": Key(xdd="productID"),
    "OrderCode": Key(xdd="orderNumber"),
    "LSS_Supported": Key(_flag, True, "layerSettingServiceSlave"),
    "NrOfRXPDO": Key(xdd="nrOfRxPDO"),
    "NrOfTXPDO": Key(xdd="nrOfTxPDO"),
    "Granularity": Key(xdd="granularity"),
    **{f"BaudRate_{rate}": Key(_flag, False) for rate in BIT_RATES_KBIT_S},
    # of [DeviceComissioning]
    "NodeName": Key(),
    "Baudrate": Key(_bit_rate, None),
    "LSS_SerialNumber": Key(_number, None),
}


def read_key(section: Section, name: str) -> Any:
    """Return the value of a key of KEYS; what is wrong with its text becomes a finding."""
    key, text = KEYS[name], section.get(name)
    if not text:
        return key.default
    value, remark = key.parse(text)
    if remark:
        section.say(name, remark)
    return key.default if value is None else value
