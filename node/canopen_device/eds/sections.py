"""The text of an EDS or DCF as sections and keys, with the line of each, and what is wrong with it (CiA 306-1, 4.4).
``KEYS`` are the keys of one form: parser, default, name in an XDD (CiA 306-1, CiA 311)."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from canopen_device.core import communication
from canopen_device.eds import values
from canopen_device.errors import InputError
from canopen_device.visible_text import shortened

_OBJECT = re.compile(r"(?:0x)?([0-9a-f]{1,4})", re.IGNORECASE)
_SUB = re.compile(r"(?:0x)?([0-9a-f]{1,4})\s*sub\s*(?:0x)?([0-9a-f]{1,2})", re.IGNORECASE)
_LIST = re.compile(r"(?:0x)?([0-9a-f]{1,4})\s*(name|value|denotation)", re.IGNORECASE)
_NEAR_OBJECT = re.compile(r"(?:0x)?[0-9][0-9a-f]{3}(?!.*objectlinks$)", re.IGNORECASE)
MOST_BYTES, MOST_LINES, MOST_CHARACTERS = 32 << 20, 1_000_000, 64 << 20
"""Of a file: its bytes, its lines, and the characters of its sections, in which an XDD may repeat a parameter."""

LONGEST_TEXT = 1 << 16
"""Most characters of a name or a value; CiA 306-1 has lines of 255."""

MOST_FINDINGS = 100_000


class Findings(list[tuple[int, str]]):
    """What is wrong at a line (0: in the file as a whole), and how the file is read in spite of it."""

    def __init__(self, path: str | Path = "") -> None:
        super().__init__()
        self._path = path

    def add(self, line: int, text: str) -> None:
        """Add a finding. Raises InputError beyond MOST_FINDINGS."""
        if len(self) >= MOST_FINDINGS:
            problem = f"{MOST_FINDINGS} remarks up to here, which is the limit; the file is no EDS of a device"
            raise InputError(f"{self._path}:{line}: {problem}")
        self.append((line, text))


@dataclass(slots=True)
class Section:
    """One section; ``keys`` in lower case, ``written`` as in the file, ``lines`` by key, ``findings`` of its file."""

    name: str
    line: int
    findings: Findings = field(default_factory=Findings)
    keys: dict[str, str] = field(default_factory=dict)
    written: dict[str, str] = field(default_factory=dict)
    lines: dict[str, int] = field(default_factory=dict)

    def get(self, key: str) -> str | None:
        """The value of ``key``, in any case; None where it is missing."""
        return self.keys.get(key.lower())

    def text_lines(self) -> list[str]:
        """The lines of the section, and an empty one."""
        return [f"[{self.name}]", *(f"{self.written[key]}={value}" for key, value in self.keys.items()), ""]

    def say(self, key: str, what: str) -> str:
        """Note what is wrong with a key, at its line: ``[name] key=value: what``; nothing for an empty text. Return it
        behind its line."""
        if not what:
            return ""
        value, line = self.get(key), self.lines.get(key.lower(), self.line)
        shown = f"{key} missing" if value is None else f"{self.written[key.lower()]}={shortened(value)}"
        self.findings.add(line, f"[{self.name}] {shown}: {what}")
        return f"{line}: [{self.name}] {shown}: {what}"


@dataclass(slots=True)
class EdsFile:
    """The sections of a file by names in lower case; objects, subs and lists by number. ``lists[index]``: "name",
    "value" and "denotation" of a compact object. ``content``: bytes of the file, or of an XDD's sections."""

    sections: dict[str, Section] = field(default_factory=dict)
    objects: dict[int, Section] = field(default_factory=dict)
    subs: dict[int, dict[int, Section]] = field(default_factory=dict)
    lists: dict[int, dict[str, Section]] = field(default_factory=dict)
    findings: Findings = field(default_factory=Findings)
    path: str | Path = ""
    content: bytes = b""
    characters: int = 0

    def take(self, line: int, *texts: str) -> None:
        """Count texts of the file before they are stored. Raises InputError beyond the limits."""
        longest = max(map(len, texts))
        if longest > LONGEST_TEXT:
            raise self.error(line, f"a name or value of {longest} characters; allowed are {LONGEST_TEXT}")
        self.characters += sum(map(len, texts))
        if self.characters > MOST_CHARACTERS:
            raise self.error(line, f"more than {MOST_CHARACTERS} characters in its sections, which is the limit")

    def error(self, line: int, what: str) -> InputError:
        """The error for a file that is beyond a limit."""
        return InputError(f"{self.path}:{line}: {what}")

    def entry(self, index: int, sub: int) -> Section | None:
        """The section of an entry: that of the sub-index, or of the object itself where it has none."""
        if index in self.subs:
            return self.subs[index].get(sub)
        return self.objects.get(index) if sub == 0 else None


def decoded(content: bytes) -> tuple[str, int, str]:
    """Return the text of a file's bytes, with line and remark if it is neither ASCII nor UTF-8, else 0 and ""."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff") or 0 in content[:2]:
        # Without a byte order mark, a character of ASCII in 16 bits shows the order.
        order = "utf-16" if 0 not in content[:2] else "utf-16-be" if content[0] == 0 else "utf-16-le"
        return content.decode(order, "replace"), 1, "UTF-16: CiA 306 has ASCII"
    try:
        return content.decode("utf-8-sig"), 0, ""
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        problem = f"byte 0x{content[error.start]:02X} is not UTF-8; the file is read as Windows-1252"
        return content.decode("cp1252", "replace"), line, problem


def parse(content: bytes, path: str | Path = "") -> EdsFile:
    """Read the sections of an EDS or DCF in UTF-8, UTF-16, or Windows-1252. Lines that are no part of an EDS, and what
    occurs twice, become findings. Raises InputError beyond the limits."""
    file = EdsFile(path=path, content=content, findings=Findings(path))
    section: Section | None = None
    text, line_decoded, remark = decoded(content)
    if remark:
        file.findings.add(line_decoded, remark)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if (count := text.count("\n")) > MOST_LINES:
        raise file.error(count, f"{count} lines; allowed are {MOST_LINES}")
    for number, raw in enumerate(text.split("\n"), 1):
        line = raw.strip(" \t\x00\x1a\ufeff")
        if not line or line.startswith((";", "#")):
            continue
        if line.startswith("["):
            section = open_section(file, _heading(file, line, number), number)
        elif section is None:
            file.findings.add(number, f"{_shown(line)}: a key needs a [section] above it; skipped")
        elif "=" in line or ":" in line:
            if "=" not in line:
                file.findings.add(number, f"{_shown(line)}: the form is key=value; read so")
            key, _, value = line.partition("=" if "=" in line else ":")
            add_key(file, section, key.strip(), value, number)
        else:
            file.findings.add(number, f"{_shown(line)}: allowed are [section], key=value and ; comment; skipped")
    return file


def _heading(file: EdsFile, line: str, number: int) -> str:
    name, closed, behind = line[1:].partition("]")
    if not closed:
        file.findings.add(number, f"{_shown(line)}: ] is missing; read as a section")
    elif behind and not behind.lstrip().startswith(";"):
        file.findings.add(number, f"{_shown(line)}: the text after ] is taken as a comment")
    return name.partition(";")[0].strip()


def _shown(line: str) -> str:
    return repr(shortened(line))


def open_section(file: EdsFile, name: str, number: int) -> Section:
    """Add a section that begins at a line; a second one of its name is reported, and not applied."""
    file.take(number, name)
    section = Section(name, number, file.findings)
    key = "".join(name.lower().split())
    if key in file.sections:
        problem = f"the section is already there at line {file.sections[key].line}; the first one applies"
        file.findings.add(number, f"[{shortened(name)}]: {problem}")
        return section
    known = section
    if match := _OBJECT.fullmatch(name):
        known = file.objects.setdefault(int(match[1], 16), section)
    elif match := _SUB.fullmatch(name):
        known = file.subs.setdefault(int(match[1], 16), {}).setdefault(int(match[2], 16), section)
    elif match := _LIST.fullmatch(name):
        known = file.lists.setdefault(int(match[1], 16), {}).setdefault(match[2].lower(), section)
    elif _NEAR_OBJECT.match(name):
        file.findings.add(number, f"[{shortened(name)}]: the forms are [2000] and [2000sub1]; the section is skipped")
    if known is section:
        file.sections[key] = section
    else:  # [018] and [0018]
        file.findings.add(number, f"[{name}]: the same as [{known.name}] at line {known.line}; the first one applies")
    return section


def add_key(file: EdsFile, section: Section, name: str, value: str, number: int) -> None:
    """Add a key of a line; a second one of its name is reported, and not applied."""
    file.take(number, name, value)
    key = "".join(name.lower().split())
    if key != name.lower():
        file.findings.add(number, f"[{section.name}] {shortened(name)}: a key has no blanks; read without")
    if key in section.keys:
        problem = f"the key is already there at line {section.lines.get(key, section.line)}; the first one applies"
        file.findings.add(number, f"[{section.name}] {name}: {problem}")
        return
    section.keys[key] = value.strip()
    section.written[key] = name
    section.lines[key] = number


def lists_of(objects: Iterable[int]) -> dict[str, list[int]]:
    """Return the indices by the section that lists them, ascending."""
    own = range(communication.FIRST_MANUFACTURER, communication.LAST_MANUFACTURER + 1)
    groups: dict[str, list[int]] = {"MandatoryObjects": [], "OptionalObjects": [], "ManufacturerObjects": []}
    for index in sorted(objects):
        name = "MandatoryObjects" if index in communication.MANDATORY else "OptionalObjects"
        groups["ManufacturerObjects" if index in own else name].append(index)
    return groups


# --- the keys that have one form -------------------------------------------------------------------------------
# Those whose value depends on others (DataType, AccessType, values and limits of an entry) are read in ``reader``.

BIT_RATES_KBIT_S = (10, 20, 50, 125, 250, 500, 800, 1000)
LONGEST_NAME = 255  # CiA 306-1 has 241
_CODES = {"domain": 2, "var": 7, "array": 8, "record": 9}  # of ObjectType, in words
_MAPPABLE = ("optional", "default", "tpdo", "rpdo", "on", "y")  # in words, as an XDD has it

Parsed = tuple[Any, str]
"""A value, None for what is none, and a remark, "" where the text is as CiA 306-1 has it."""


def _name(text: str) -> Parsed:
    return text[:LONGEST_NAME], f"cut to {LONGEST_NAME} characters" if len(text) > LONGEST_NAME else ""


def _number(text: str) -> Parsed:
    return values.integer(text)[::2]


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

    parse: Callable[[str], Parsed] = lambda text: (text, "")
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
    section.say(name, remark)
    return key.default if value is None else value
