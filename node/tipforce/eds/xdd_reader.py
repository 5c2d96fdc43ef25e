"""An XDD or XDC (CiA 311) as the sections of an EDS or DCF, with its lines: the reader of those checks it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from xml.parsers import expat

from tipforce.device import communication
from tipforce.eds.sections import MOST_LINES, EdsFile, Findings, Section, add_key, open_section
from tipforce.errors import InputError

_ACCESS = {
    "read": "ro", "write": "wo", "readWrite": "rw", "const": "const", "readWriteInput": "rwr",
    "readWriteOutput": "rww", "noAccess": "ro",
}  # fmt: skip
_TYPES = {
    "BOOL": 1, "SINT": 2, "INT": 3, "DINT": 4, "USINT": 5, "BYTE": 5, "UINT": 6, "WORD": 6, "UDINT": 7, "DWORD": 7,
    "REAL": 8, "STRING": 9, "BITSTRING": 0xA, "WSTRING": 0xB, "LREAL": 0x11, "LINT": 0x15, "ULINT": 0x1B, "LWORD": 0x1B,
}  # fmt: skip
_LIMITS = {"minValue": "lowLimit", "maxValue": "highLimit"}
_IDENTITY = {
    "vendorName": "VendorName", "vendorID": "VendorNumber", "productName": "ProductName", "productID": "ProductNumber",
    "orderNumber": "OrderCode",
}  # fmt: skip
_FEATURES = {
    "granularity": "Granularity", "nrOfRxPDO": "NrOfRXPDO", "nrOfTxPDO": "NrOfTXPDO",
    "layerSettingServiceSlave": "LSS_Supported",
}  # fmt: skip
_FLAGS = {"true": "1", "false": "0"}
_KEYS = {
    "name": "ParameterName", "objectType": "ObjectType", "subNumber": "SubNumber", "dataType": "DataType",
    "accessType": "AccessType", "defaultValue": "DefaultValue", "actualValue": "ParameterValue",
    "lowLimit": "LowLimit", "highLimit": "HighLimit", "PDOmapping": "PDOMapping", "objFlags": "ObjFlags",
    "denotation": "Denotation",
}  # fmt: skip
_DIGITS = re.compile(r"[0-9A-Fa-f]+")
_HEXADECIMAL = ("dataType", "objFlags")
_PDO_ACCESS = {"TPDO": "rwr", "RPDO": "rww"}
_KBIT = 1000
DEEPEST, MOST_ATTRIBUTES = 64, 64
"""Levels of elements, and attributes of one; CiA 311 has about 12 and 20."""

_LONGEST_TEXT = 255  # characters of an element of _IDENTITY
Attributes = Mapping[str, str]


def read_xdd(path: str | Path, content: bytes) -> EdsFile:
    """Return the objects of an XDD or XDC.

    Raises InputError for what is no XML, has a document type of its own (so there are no entities), or has more than
    MOST_LINES elements, DEEPEST levels, or the limits of ``EdsFile.take``.
    """
    reader = _Reader(str(path))
    try:
        reader.parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InputError(f"{path}:{error.lineno}: no XML: {expat.ErrorString(error.code)}") from None
    return reader.file()


class _Reader:
    def __init__(self, path: str) -> None:
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._characters
        self.parser.StartDoctypeDeclHandler = self._doctype
        self._path = path
        self._info: dict[str, str] = {}
        self._dummies: dict[str, str] = {}
        self._commissioning: dict[str, str] | None = None
        self._parameters: dict[str, dict[str, str]] = {}
        self._parameter: dict[str, str] | None = None
        self._objects: list[tuple[int, str, Attributes]] = []
        self._index = ""
        self._text: str | None = None  # of an element of _IDENTITY
        self._depth = self._elements = 0

    def _doctype(self, *_: object) -> None:
        raise self._error("a document type of its own (DOCTYPE); an XDD has none")

    def _error(self, what: str) -> InputError:
        return InputError(f"{self._path}:{self.parser.CurrentLineNumber}: {what}")

    def _check_limits(self, given: Attributes) -> None:
        self._depth += 1
        self._elements += 1
        if self._depth > DEEPEST:
            raise self._error(f"elements in more than {DEEPEST} levels, which is the limit")
        if self._elements > MOST_LINES:
            raise self._error(f"more than {MOST_LINES} elements, which is the limit")
        if len(given) > MOST_ATTRIBUTES:
            raise self._error(f"an element with {len(given)} attributes; allowed are {MOST_ATTRIBUTES}")

    def _start(self, tag: str, given: dict[str, str]) -> None:
        self._check_limits(given)
        given = {key: " ".join(value.splitlines()).strip() for key, value in given.items()}
        name = tag.rpartition(":")[2]
        self._text = "" if name in _IDENTITY else None
        line = self.parser.CurrentLineNumber
        if name == "CANopenObject":
            self._index = given.get("index", "")
            self._objects.append((line, self._index, given))
        elif name == "CANopenSubObject":
            self._objects.append((line, f"{self._index}sub{given.get('subIndex', '')}", given))
        elif name == "parameter":
            self._parameter = self._parameters.setdefault(given.get("uniqueID", ""), {})
            self._parameter["accessType"] = _ACCESS.get(given.get("access", ""), given.get("access", ""))
        elif self._parameter is not None:
            self._start_in_parameter(name, given, self._parameter)
        elif name == "dummy":
            key, _, used = given.get("entry", "").partition("=")
            self._dummies[key] = used
        elif name == "supportedBaudRate":
            self._info[f"BaudRate_{given.get('value', '').split(' ')[0]}"] = "1"
        elif name == "CANopenGeneralFeatures":
            self._info |= {_FEATURES[k]: _FLAGS.get(v, v) for k, v in given.items() if k in _FEATURES}
        elif name == "deviceCommissioning":
            self._commissioning = _commissioning(given)

    def _start_in_parameter(self, name: str, given: Attributes, parameter: dict[str, str]) -> None:
        if name in ("defaultValue", "actualValue", *_LIMITS):
            parameter.setdefault(_LIMITS.get(name, name), given.get("value", ""))
        elif name in _TYPES:
            parameter.setdefault("dataType", f"{_TYPES[name]:04X}")

    def _characters(self, text: str) -> None:
        if self._text is not None:
            self._text += text
            if len(self._text) > _LONGEST_TEXT:
                raise self._error(f"a name of more than {_LONGEST_TEXT} characters, which is the limit")

    def _end(self, tag: str) -> None:
        self._depth -= 1
        name = tag.rpartition(":")[2]
        if name == "parameter":
            self._parameter = None
        elif name in _IDENTITY and self._text and self._text.strip():
            self._info.setdefault(_IDENTITY[name], " ".join(self._text.split()))
        self._text = None

    def file(self) -> EdsFile:
        """Return the sections."""
        found = EdsFile(is_xml=True, path=self._path, findings=Findings(self._path))
        _section(found, "FileInfo", {"FileName": Path(self._path).name})
        _section(found, "DeviceInfo", self._info)
        if self._dummies:
            _section(found, "DummyUsage", self._dummies)
        if self._commissioning is not None:
            _section(found, "DeviceComissioning", self._commissioning)
        for line, name, given in self._objects:
            reference = given.get("uniqueIDRef")
            if reference is not None and reference not in self._parameters:
                found.add(line, f"[{name}] uniqueIDRef={reference}: no such parameter; read without")
            _section(found, name, _keys({**self._parameters.get(reference or "", {}), **given}), line)
        for name, indices in _lists(found):
            _section(found, name, {"SupportedObjects": str(len(indices)), **_numbered(indices)})
        return found


def _section(found: EdsFile, name: str, keys: Attributes, line: int = 1) -> Section:
    section = open_section(found, name, line)
    for key, value in keys.items():
        add_key(found, section, key, value, line)
    return section


def _keys(given: Attributes) -> dict[str, str]:
    """Return the keys of an EDS for the attributes of an object."""
    found = {
        _KEYS[key]: f"0x{text}" if key in _HEXADECIMAL and _DIGITS.fullmatch(text) else text
        for key, text in given.items()
        if key in _KEYS
    }
    mapping = given.get("PDOmapping")
    if mapping is not None:
        found["PDOMapping"] = str(int(mapping != "no"))
        if found.get("AccessType") == "rw":
            found["AccessType"] = _PDO_ACCESS.get(mapping, "rw")
    return found


def _commissioning(given: Attributes) -> dict[str, str]:
    found = {"NodeName": given.get("nodeName", "")}
    if given.get("nodeID", "0").strip("0"):
        found["NodeID"] = given["nodeID"]
    rate = given.get("actualBaudRate", "").split(" ")[0]
    if rate.isascii() and rate.isdigit():
        found["Baudrate"] = str(int(rate) // _KBIT if int(rate) > _KBIT else int(rate))
    return found


def _lists(found: EdsFile) -> list[tuple[str, list[int]]]:
    own = range(communication.FIRST_MANUFACTURER, communication.LAST_MANUFACTURER + 1)
    groups: dict[str, list[int]] = {"MandatoryObjects": [], "OptionalObjects": [], "ManufacturerObjects": []}
    for index in sorted(found.objects):
        name = "MandatoryObjects" if index in communication.MANDATORY else "OptionalObjects"
        groups["ManufacturerObjects" if index in own else name].append(index)
    return list(groups.items())


def _numbered(indices: list[int]) -> dict[str, str]:
    return {str(number): f"0x{index:04X}" for number, index in enumerate(indices, 1)}
