"""A device description as XDD (CiA 311), written, and an XDD or XDC read as the sections of an EDS or DCF."""

import re
from collections.abc import Mapping
from pathlib import Path
from xml.parsers import expat
from xml.sax import saxutils

from canopen_device.core import communication
from canopen_device.core.object_dictionary import RPDO, TPDO
from canopen_device.eds.description import DOMAIN, VAR, Description, Entry, Object
from canopen_device.eds.sections import KEYS, MOST_LINES, EdsFile, Findings, Section, add_key, lists_of, open_section
from canopen_device.eds.standard import PDOS
from canopen_device.errors import InputError
from canopen_device.types import Value
from canopen_device.visible_text import visible_lines

_NAMESPACE = "http://www.canopen.org/xml/1.1"
_HEADER = """\
  <co:ISO15745Profile>
    <ProfileHeader>
      <ProfileIdentification>CANopen {} profile</ProfileIdentification>
      <ProfileRevision>1.1</ProfileRevision>
      <ProfileName/>
      <ProfileSource/>
      <ProfileClassID>{}</ProfileClassID>
      <ISO15745Reference>
        <ISO15745Part>1</ISO15745Part>
        <ISO15745Edition>1</ISO15745Edition>
        <ProfileTechnology>CANopen</ProfileTechnology>
      </ISO15745Reference>
    </ProfileHeader>
"""
_DOCUMENT = f"""\
<?xml version="1.0" encoding="UTF-8"?>
<co:ISO15745ProfileContainer xmlns:co="{_NAMESPACE}" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
{_HEADER.format("device", "Device")}\
    <ProfileBody xsi:type="co:ProfileBody_Device_CANopen" {{body}} supportedLanguages="en">
      <co:DeviceIdentity>
{{identity}}\
      </co:DeviceIdentity>
      <co:DeviceFunction>
        <co:capabilities>
          <co:characteristicsList>
            <co:characteristic>
              <co:characteristicName><label lang="en">Protocol</label></co:characteristicName>
              <co:characteristicContent><label lang="en">CANopen</label></co:characteristicContent>
            </co:characteristic>
          </co:characteristicsList>
        </co:capabilities>
      </co:DeviceFunction>
    </ProfileBody>
  </co:ISO15745Profile>
{_HEADER.format("communication network", "CommunicationNetwork")}\
    <ProfileBody xsi:type="co:ProfileBody_CommunicationNetwork_CANopen" {{body}}>
      <ApplicationLayers>
        <co:CANopenObjectList {{counts}}>
{{objects}}\
        </co:CANopenObjectList>
{{dummies}}\
      </ApplicationLayers>
      <TransportLayers>
        <PhysicalLayer>
          <baudRate defaultValue="{{highest}} Kbps">
{{rates}}\
          </baudRate>
        </PhysicalLayer>
      </TransportLayers>
      <NetworkManagement>
        <CANopenGeneralFeatures {{features}} layerSettingServiceSlave="{{lss}}"/>
{{node}}\
      </NetworkManagement>
    </ProfileBody>
  </co:ISO15745Profile>
</co:ISO15745ProfileContainer>
"""
_DATE = "2026-01-01"  # the text is the same at each run

_KBIT = 1000
_ACCESS = {
    "read": "ro", "write": "wo", "readWrite": "rw", "const": "const", "readWriteInput": "rwr",
    "readWriteOutput": "rww", "noAccess": "ro",
}  # fmt: skip
_TYPES = {
    "BOOL": 1, "SINT": 2, "INT": 3, "DINT": 4, "USINT": 5, "BYTE": 5, "UINT": 6, "WORD": 6, "UDINT": 7, "DWORD": 7,
    "REAL": 8, "STRING": 9, "BITSTRING": 0xA, "WSTRING": 0xB, "LREAL": 0x11, "LINT": 0x15, "ULINT": 0x1B, "LWORD": 0x1B,
}  # fmt: skip
_IDENTITY = ("VendorName", "VendorNumber", "ProductName", "ProductNumber", "OrderCode")
_FEATURES = ("Granularity", "NrOfRXPDO", "NrOfTXPDO", "LSS_Supported")
_KEYS = {key.xdd: name for name, key in KEYS.items() if key.xdd}
_VALUES = {
    "defaultValue": "defaultValue", "actualValue": "actualValue", "minValue": "lowLimit", "maxValue": "highLimit",
    **dict.fromkeys(_TYPES, "dataType"),
}  # fmt: skip
_FLAGS = {"true": "1", "false": "0"}
_DIGITS = re.compile(r"[0-9A-Fa-f]+")
_HEXADECIMAL = ("dataType", "objFlags")
_PDO_ACCESS = {"TPDO": "rwr", "RPDO": "rww"}
DEEPEST, MOST_ATTRIBUTES = 64, 64
"""Levels of elements, and attributes of one; CiA 311 has about 12 and 20."""

_LONGEST_TEXT = 255  # characters of an element of _IDENTITY
Attributes = Mapping[str, str]


def quoteattr(text: str) -> str:
    """Return a text as the value of an attribute; control characters, which XML forbids, as escapes."""
    return saxutils.quoteattr(visible_lines(text))


def xdd_text(described: Description, creator: str = "canopen_device") -> str:
    """Return the XDD of a device, of a DCF the XDC; values with $NODEID are written with it. As in the schema, elements
    that it declares globally have the namespace, those below a type have none."""
    name = quoteattr(described.path.stem + ".xdd")
    body = f'formatName="CANopen" formatVersion="1.0" fileName={name} fileCreator={quoteattr(creator)}'
    vendor, product = (described.entry(communication.IDENTITY, sub) for sub in (1, 2))
    numbers = ["" if entry is None else f"0x{int(entry.default):08X}" for entry in (vendor, product)]
    identity = zip(_IDENTITY, (described.vendor_name, numbers[0], described.product_name, numbers[1]), strict=False)
    dummies = ""
    if described.dummies is not None:  # the data types that an RPDO may map as placeholders
        used = [(code, int(code in described.dummies)) for code in range(1, 8)]
        dummies = "".join(f'          <dummy entry="Dummy{code:04X}={flag}"/>\n' for code, flag in used)
        dummies = f"        <dummyUsage>\n{dummies}        </dummyUsage>\n"
    node = ""
    if described.is_dcf:
        rate = "" if described.bit_rate is None else f' actualBaudRate="{described.bit_rate // _KBIT} Kbps"'
        keys = f'nodeID="{described.node_id}" nodeName={quoteattr(described.node_name)}{rate}'
        node = f'        <deviceCommissioning {keys} networkNumber="0" networkName="" CANopenManager="false"/>\n'
    rates = [rate // _KBIT for rate in described.bit_rates or (1_000_000,)]
    rpdos, tpdos = (sum(first <= index <= last for index in described.objects) for _, first, last, *_ in PDOS)
    return _DOCUMENT.format(
        body=f'{body} fileCreationDate="{_DATE}" fileVersion="1"',
        identity="".join(f"        <co:{KEYS[k].xdd}>{quoteattr(t)[1:-1]}</co:{KEYS[k].xdd}>\n" for k, t in identity),
        counts=" ".join(f'{k[0].lower()}{k[1:]}="{len(listed)}"' for k, listed in lists_of(described.objects).items()),
        objects="".join(line for _, o in sorted(described.objects.items()) for line in _object(o, described.node_id)),
        dummies=dummies,
        highest=max(rates),
        rates="".join(f'            <supportedBaudRate value="{rate} Kbps"/>\n' for rate in rates),
        features=f'granularity="8" nrOfRxPDO="{rpdos}" nrOfTxPDO="{tpdos}" bootUpSlave="true"',
        lss=str(described.lss).lower(),
        node=node,
    )


def _object(part: Object, node_id: int) -> list[str]:
    head = f'          <CANopenObject index="{part.index:04X}" name={quoteattr(part.name)} objectType="{part.code}"'
    if set(part.entries) == {0} and part.code in (DOMAIN, VAR):
        return [f"{head}{_attributes(part.entries[0], node_id)}/>\n"]
    lines = [f'{head} subNumber="{len(part.entries)}">\n']
    for sub, entry in sorted(part.entries.items()):
        head = f'subIndex="{sub:02X}" name={quoteattr(entry.name)} objectType="7"'
        lines.append(f"            <CANopenSubObject {head}{_attributes(entry, node_id)}/>\n")
    return [*lines, "          </CANopenObject>\n"]


def _attributes(entry: Entry, node_id: int) -> str:
    has_default = entry.has_default or entry.default
    texts = {
        "DataType": f"{entry.type.code:04X}",
        "AccessType": "rw" if entry.access in ("rwr", "rww") else entry.access,
        "DefaultValue": _value(entry, entry.default, node_id) if has_default else None,
        "LowLimit": _value(entry, entry.low, 0),
        "HighLimit": _value(entry, entry.high, 0),
        "ParameterValue": _value(entry, entry.value, 0),
        "ObjFlags": f"{entry.flags:04X}" if entry.flags else None,
        "PDOMapping": {0: "no", TPDO: "TPDO", RPDO: "RPDO"}.get(entry.directions, "optional"),
    }
    return "".join(f" {KEYS[key].xdd}={quoteattr(text)}" for key, text in texts.items() if text is not None)


def _value(entry: Entry, value: Value | None, node_id: int) -> str | None:
    if value is None:
        return None
    if entry.has_node_id and node_id and isinstance(value, int):
        return f"$NODEID+0x{value - node_id:X}"
    return value.hex().upper() if isinstance(value, bytes) else repr(value) if isinstance(value, float) else str(value)


# --- reading: the sections of an EDS or DCF, with the lines of the XDD; their reader checks them ---------------


def read_xdd(path: str | Path, content: bytes) -> EdsFile:
    """Return the objects of an XDD or XDC. Raises InputError for what is no XML, has a document type of its own (so
    there are no entities), or has more than MOST_LINES elements, DEEPEST levels, or the limits of ``EdsFile.take``."""
    reader = _Reader(str(path))
    try:
        reader.parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InputError(f"{path}:{error.lineno}: no XML: {expat.ErrorString(error.code)}") from None
    except (LookupError, ValueError) as error:
        raise InputError(f"{path}:1: no XML: {error}") from None  # of the encoding that the file states
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

    def _checked(self, given: Attributes) -> dict[str, str]:
        self._depth += 1
        self._elements += 1
        if self._depth > DEEPEST:
            raise self._error(f"elements in more than {DEEPEST} levels, which is the limit")
        if self._elements > MOST_LINES:
            raise self._error(f"more than {MOST_LINES} elements, which is the limit")
        if len(given) > MOST_ATTRIBUTES:
            raise self._error(f"an element with {len(given)} attributes; allowed are {MOST_ATTRIBUTES}")
        return {key: " ".join(value.splitlines()).strip() for key, value in given.items()}

    def _start(self, tag: str, given: dict[str, str]) -> None:
        given = self._checked(given)
        name = tag.rpartition(":")[2]
        self._text = "" if _KEYS.get(name) in _IDENTITY else None
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
            if name in _VALUES:
                text = f"{_TYPES[name]:04X}" if name in _TYPES else given.get("value", "")
                self._parameter.setdefault(_VALUES[name], text)
        elif name == "dummy":
            key, _, used = given.get("entry", "").partition("=")
            self._dummies[key] = used
        elif name == "supportedBaudRate":
            self._info[f"BaudRate_{given.get('value', '').split(' ')[0]}"] = "1"
        elif name == "CANopenGeneralFeatures":
            self._info |= {_KEYS[k]: _FLAGS.get(v, v) for k, v in given.items() if _KEYS.get(k) in _FEATURES}
        elif name == "deviceCommissioning":
            self._commissioning = _commissioning(given)

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
        elif self._text and self._text.strip():
            self._info.setdefault(_KEYS[name], " ".join(self._text.split()))
        self._text = None

    def file(self) -> EdsFile:
        """Return the sections."""
        file = EdsFile(path=self._path, findings=Findings(self._path))
        _section(file, "FileInfo", {"FileName": Path(self._path).name})
        _section(file, "DeviceInfo", self._info)
        if self._dummies:
            _section(file, "DummyUsage", self._dummies)
        if self._commissioning is not None:
            _section(file, "DeviceComissioning", self._commissioning)
        for line, name, given in self._objects:
            reference = given.get("uniqueIDRef")
            if reference is not None and reference not in self._parameters:
                file.findings.add(line, f"[{name}] uniqueIDRef={reference}: no such parameter; read without")
            _section(file, name, _keys({**self._parameters.get(reference or "", {}), **given}), line)
        for name, indices in lists_of(file.objects).items():
            numbered = {str(number): f"0x{index:04X}" for number, index in enumerate(indices, 1)}
            _section(file, name, {"SupportedObjects": str(len(indices)), **numbered})
        file.content = "\n".join(line for section in file.sections.values() for line in section.text_lines()).encode()
        return file


def _section(file: EdsFile, name: str, keys: Attributes, line: int = 1) -> Section:
    section = open_section(file, name, line)
    for key, value in keys.items():
        add_key(file, section, key, value, line)
    return section


def _keys(given: Attributes) -> dict[str, str]:
    keys = {
        _KEYS[key]: f"0x{text}" if key in _HEXADECIMAL and _DIGITS.fullmatch(text) else text
        for key, text in given.items()
        if key in _KEYS
    }
    mapping = given.get("PDOmapping")
    if mapping is not None:
        keys["PDOMapping"] = str(int(mapping != "no"))
        if keys.get("AccessType") == "rw":
            keys["AccessType"] = _PDO_ACCESS.get(mapping, "rw")
    return keys


def _commissioning(given: Attributes) -> dict[str, str]:
    keys = {"NodeName": given.get("nodeName", "")}
    if given.get("nodeID", "0").strip("0"):
        keys["NodeID"] = given["nodeID"]
    rate = given.get("actualBaudRate", "").split(" ")[0]
    if rate.isascii() and rate.isdigit():
        keys["Baudrate"] = str(int(rate) // _KBIT if int(rate) > _KBIT else int(rate))
    return keys
