"""What is wrong with an EDS or DCF, by the rules of CiA 306-1 and by what readers trip over.

Each complaint names the section, the key, its value and what is allowed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from dictionary import eds_lint_pdo as lint_pdo
from tipforce.device import communication
from tipforce.dictionary import signals, types
from tipforce.eds.sections import EdsFile, Section, parse
from tipforce.errors import InputError

MAX_NAME = 241  # characters, CiA 306-1, 4.6.2
ACCESS = ("ro", "wo", "rw", "const", "rww", "rwr")
VAR_TYPES, LIST_TYPES, OTHER_TYPES = (0x2, 0x7), (0x8, 0x9), (0x0, 0x5, 0x6)
_LISTS = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")
_OTHER_CODES = {0x0C, 0x0D, 0x10, 0x12, 0x13, 0x14, 0x16, 0x18, 0x19, 0x1A}  # TIME, INTEGER24, ...: no value rules
_KNOWN = re.compile(
    r"fileinfo|deviceinfo|dummyusage|comments|devicecomissioning|tools|tool\d+|dynamicchannels|supportedmodules"
    r"|(mandatory|optional|manufacturer)objects|[0-9a-f]{4}(sub[0-9a-f]{1,2}|name|value|denotation|objectlinks)?"
    r"|m\d+.*"
)
_DATE, _TIME = re.compile(r"(0\d|1[0-2])-([0-2]\d|3[01])-\d{4}"), re.compile(r"(0?\d|1[0-2]):[0-5]\d(AM|PM)")
_NODE_ID = re.compile(r"\+?\$NODEID\+?", re.IGNORECASE)


def lint_eds(text: str) -> list[str]:
    """Every complaint about the text of an EDS or DCF, in the order of the file's parts; [] is clean."""
    eds = parse(text)
    found = [*eds.complaints, *_general(eds), *_lists(eds), *_names(eds)]
    for index in sorted(eds.objects.keys() | eds.subs.keys()):
        found += _object(eds, index)
    return [*found, *lint_pdo.lint_pdos(eds)]


def _general(eds: EdsFile) -> Iterator[str]:
    for key, section in eds.sections.items():
        if not _KNOWN.fullmatch(key):
            yield f"[{section.name}]: not a section of CiA 306"
    yield from _file_info(eds.sections.get("fileinfo"))
    yield from _device_info(eds)
    dummy = eds.sections.get("dummyusage")
    if dummy is None:
        yield "[DummyUsage]: the section is missing"
    else:
        for k in range(1, 8):
            if dummy.get(f"Dummy{k:04d}") not in ("0", "1"):
                yield dummy.complaint(f"Dummy{k:04d}", "allowed are 0 and 1; canopen wants all seven")
    comments = eds.sections.get("comments")
    if comments is not None and comments.get("Lines") != str(len(comments.keys) - 1):
        yield comments.complaint("Lines", f"the section has {len(comments.keys) - 1} lines")


def _file_info(section: Section | None) -> Iterator[str]:
    if section is None:
        yield "[FileInfo]: the section is missing"
        return
    if not section.get("FileName"):
        yield section.complaint("FileName", "needed")
    if section.get("EDSVersion") not in ("3.0", "4.0"):
        yield section.complaint("EDSVersion", "allowed are 3.0 and 4.0")
    for key, form, shown in (
        ("CreationDate", _DATE, "mm-dd-yyyy"),
        ("ModificationDate", _DATE, "mm-dd-yyyy"),
        ("CreationTime", _TIME, "hh:mmAM or hh:mmPM"),
        ("ModificationTime", _TIME, "hh:mmAM or hh:mmPM"),
    ):
        value = section.get(key)
        if value and not form.fullmatch(value):
            yield section.complaint(key, f"the form is {shown}")


def _device_info(eds: EdsFile) -> Iterator[str]:
    section = eds.sections.get("deviceinfo")
    if section is None:
        yield "[DeviceInfo]: the section is missing"
        return
    for key in ("VendorNumber", "ProductNumber", "RevisionNumber"):
        if _integer("I", section.get(key)) is None:
            yield section.complaint(key, "allowed is an UNSIGNED32; canopen can't read a blank one")
    for key in ("SimpleBootUpMaster", "SimpleBootUpSlave", "LSS_Supported", "GroupMessaging"):
        if section.get(key) not in ("0", "1"):
            yield section.complaint(key, "allowed are 0 and 1")
    for key, value in section.keys.items():
        if key.startswith("baudrate_") and value not in ("0", "1"):
            yield section.complaint(key, "allowed are 0 and 1")
    product = eds.entry(communication.IDENTITY, 2)
    if product is not None and product.get("DefaultValue"):
        declared, default = _integer("I", section.get("ProductNumber")), _integer("I", product.get("DefaultValue"))
        if declared != default:
            yield section.complaint("ProductNumber", f"[1018sub2] says {product.get('DefaultValue')}")


def _lists(eds: EdsFile) -> Iterator[str]:
    listed: dict[int, str] = {}
    for name in _LISTS:
        section = eds.sections.get(name.lower())
        if section is None:
            yield f"[{name}]: the section is missing"
            continue
        numbered = {key: value for key, value in section.keys.items() if key.isdigit()}
        if section.get("SupportedObjects") != str(len(numbered)):
            yield section.complaint("SupportedObjects", f"{len(numbered)} objects are listed")
        if sorted(map(int, numbered)) != list(range(1, len(numbered) + 1)):
            yield f"[{name}]: the keys must count from 1 to {len(numbered)}"
        for key in numbered:
            yield from _listed(eds, section, key, name, listed)
    for index in communication.MANDATORY:
        if index not in eds.objects:
            yield f"[{index:04X}]: the object is mandatory (CiA 301) and missing"
    for index, section in eds.objects.items():
        if index not in listed:
            yield f"[{section.name}]: in none of the lists {', '.join(_LISTS)}"


def _listed(eds: EdsFile, section: Section, key: str, name: str, listed: dict[int, str]) -> Iterator[str]:
    index = _integer("H", section.get(key))
    if index is None:
        yield section.complaint(key, "allowed is an index such as 0x1000")
        return
    if index in listed:
        yield section.complaint(key, f"already listed in [{listed[index]}]")
    listed[index] = name
    if index not in eds.objects:
        yield section.complaint(key, f"there is no section [{index:04X}]")
    own = communication.FIRST_MANUFACTURER <= index <= communication.LAST_MANUFACTURER
    due = 0 if index in communication.MANDATORY else 2 if own else 1
    if name != _LISTS[due]:
        yield section.complaint(key, f"belongs in [{_LISTS[due]}]")


def _names(eds: EdsFile) -> Iterator[str]:
    """Names that occur twice hide each other where a reader looks objects up by name."""
    groups = [list(eds.objects.values()), *(list(subs.values()) for subs in eds.subs.values())]
    for group in groups:
        first: dict[str, str] = {}
        for section in group:
            name = section.get("ParameterName") or ""
            if name and name in first:
                yield section.complaint("ParameterName", f"[{first[name]}] has the same name")
            first.setdefault(name, section.name)


def _object(eds: EdsFile, index: int) -> Iterator[str]:
    section, subs = eds.objects.get(index), eds.subs.get(index, {})
    if section is None:
        yield from (f"[{sub.name}]: there is no section [{index:04X}]" for sub in subs.values())
        return
    kind = _object_type(section)
    if kind in VAR_TYPES:
        yield from _entry(section)
        yield from (f"[{sub.name}]: [{section.name}] is no ARRAY or RECORD" for sub in subs.values())
    elif kind in LIST_TYPES:
        yield from _name(section)
        for sub in subs.values():
            yield from _entry(sub)
        if not section.get("CompactSubObj"):
            yield from _sub_numbers(section, index, subs)
    elif kind not in OTHER_TYPES:
        yield section.complaint("ObjectType", "allowed are 0x2, 0x5, 0x6, 0x7, 0x8, 0x9")


def _sub_numbers(section: Section, index: int, subs: dict[int, Section]) -> Iterator[str]:
    if _integer("B", section.get("SubNumber")) != len(subs):
        yield section.complaint("SubNumber", f"there are {len(subs)} sections [{section.name}subN]")
    count = subs.get(0)
    if count is None:
        yield f"[{section.name}]: sub-index 0 is missing"
        return
    value, highest = _integer("B", count.get("DefaultValue")), max(subs)
    if index == communication.ERROR_HISTORY or signals.is_mapping(index):
        if value is None or value > highest:
            yield count.complaint("DefaultValue", f"allowed are 0 to the highest sub-index {highest}")
    elif value != highest:
        yield count.complaint("DefaultValue", f"the highest sub-index is {highest}")


def _name(section: Section) -> Iterator[str]:
    if not 1 <= len(section.get("ParameterName") or "") <= MAX_NAME:
        yield section.complaint("ParameterName", f"needed, at most {MAX_NAME} characters")


def _entry(section: Section) -> Iterator[str]:
    yield from _name(section)
    if _object_type(section) not in VAR_TYPES:
        yield section.complaint("ObjectType", "an entry is 0x7 (VAR) or 0x2 (DOMAIN)")
    if (section.get("AccessType") or "").lower() not in ACCESS:
        yield section.complaint("AccessType", f"allowed are {', '.join(ACCESS)}")
    if section.get("PDOMapping") not in (None, "0", "1", "0x0", "0x1"):
        yield section.complaint("PDOMapping", "allowed are 0 and 1")
    if section.get("ObjFlags") is not None and _integer("I", section.get("ObjFlags")) is None:
        yield section.complaint("ObjFlags", "allowed is an UNSIGNED32")
    code = _integer("H", section.get("DataType"))
    letter = types.LETTER_OF_CODE.get(code or 0)
    if letter is None and code not in _OTHER_CODES:
        yield section.complaint("DataType", "not a data type of CiA 301")
    if letter is not None:
        yield from _values(section, letter)


def _values(section: Section, letter: str) -> Iterator[str]:
    kind = types.data_type(letter)
    if section.get("PDOMapping") == "1" and kind.size is None:
        yield section.complaint("PDOMapping", f"{kind.name} has no length that a PDO could carry")
    numbers: dict[str, float] = {}
    for key in ("LowLimit", "HighLimit", "DefaultValue", "ParameterValue"):
        text = section.get(key)
        if not text:
            continue
        try:
            value = types.parse_value(letter, _NODE_ID.sub("", text))
            types.encode(letter, value)
        except InputError as error:
            yield section.complaint(key, str(error))
            continue
        if isinstance(value, int | float):
            numbers[key] = value
    low, high = numbers.get("LowLimit", float("-inf")), numbers.get("HighLimit", float("inf"))
    if low > high:
        yield section.complaint("LowLimit", f"above HighLimit={section.get('HighLimit')}")
        return
    for key in ("DefaultValue", "ParameterValue"):
        if key in numbers and not low <= numbers[key] <= high and numbers[key] == numbers[key]:
            yield section.complaint(key, f"allowed are {low:.15g} to {high:.15g}")


def _object_type(section: Section) -> int | None:
    """Missing means VAR (CiA 306-1, 4.6.3.2)."""
    return 0x7 if section.get("ObjectType") is None else _integer("B", section.get("ObjectType"))


def _integer(letter: str, text: str | None) -> int | None:
    if not text:
        return None
    try:
        value = types.parse_value(letter, text)
    except InputError:
        return None
    return value if isinstance(value, int) else None
