"""Read an EDS or DCF (CiA 306-1): general sections, objects, records, arrays, compact arrays, and their checks."""

import os
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from canopen_device.core import communication
from canopen_device.eds import description as eds
from canopen_device.eds import standard, values
from canopen_device.eds.description import Description, Entry, Object
from canopen_device.eds.sections import BIT_RATES_KBIT_S, MOST_BYTES, EdsFile, Section, decoded, parse, read_key
from canopen_device.errors import InputError
from canopen_device.paths_below import below
from canopen_device.types import LETTER_OF_CODE, TYPES, Value

_COMMISSIONING = ("devicecomissioning", "devicecommissioning")  # CiA 306 spells it with one m
_CONFIGURED = (".dcf", ".xdc")  # of one node
_UNCONFIGURED, _LAST_NODE_ID = 255, 127
_NODE_IDS = (*range(1, _LAST_NODE_ID + 1), _UNCONFIGURED)
_FIRST_DUMMY, _LAST_DUMMY = 1, 0x1B
_OBJECT_CODES = (eds.NULL, eds.DOMAIN, eds.DEFTYPE, eds.DEFSTRUCT, eds.VAR, eds.ARRAY, eds.RECORD)
_MOST_COMPACT = 254
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_ACCESS_WORDS = {"r": "ro", "w": "wo", "read": "ro", "write": "wo", "constant": "const"}
_CODE_OF_TYPE = {kind.name.lower(): kind.code for kind in TYPES.values()}
_UNKNOWN_TYPE = "o"
_MOST_FILE_BYTES = 16 << 20


def read_eds(path: str | Path, node_id: int | None = None) -> Description:
    """Return the device of an EDS, DCF, XDD or XDC as node ``node_id`` (default: of the DCF). Raises InputError for a
    file that is no EDS, has no object, or, without ``node_id``, names no node."""
    return describe(read(path), node_id)


def read(path: str | Path) -> EdsFile:
    """Return the sections of an EDS, DCF, XDD or XDC. Raises InputError for what cannot be read, or has none at all."""
    try:
        with open(path, "rb") as stream:
            content = stream.read(min(os.fstat(stream.fileno()).st_size or MOST_BYTES, MOST_BYTES) + 1)  # 0: a pipe
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from None
    if len(content) > MOST_BYTES:
        raise InputError(f"{path}: more than {MOST_BYTES} bytes, the limit of an EDS or DCF")
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
    _read_objects(file, described)
    if not described.objects:
        raise InputError(f"{path}: no object in it; an EDS has a section for each, such as [1000] and [1018sub1]")
    standard.add_mandatory(described)
    standard.add_compact_pdos(file, described)
    standard.check(file, described)
    return described


def _node_id(described: Description, section: Section | None, given: int | None) -> int:
    text = "" if section is None else section.get("NodeID") or ""
    own = values.integer(text).value
    if section is not None and text and own not in _NODE_IDS:
        section.say("NodeID", f"allowed are 1 to {_LAST_NODE_ID}")
        own = None
    if given is None:
        if own is None:
            raise InputError(f"{described.path}: names no node-id; give one, 1 to {_LAST_NODE_ID}")
        return own
    if isinstance(given, bool) or not isinstance(given, int) or given not in _NODE_IDS:
        raise InputError(f"node-id {given!r}: allowed are 1 to {_LAST_NODE_ID}, and {_UNCONFIGURED} for none yet")
    if section is not None and own not in (None, given):
        section.say("NodeID", f"loaded as node {given}; values without $NODEID stay those of node {own}")
    return given


def _read_dummies(section: Section, described: Description) -> None:
    used = set()
    for key, text in section.keys.items():
        number = key.removeprefix("dummy")
        code = values.integer("0x" + number).value if number.isalnum() and number != key else None
        if code is None:
            section.say(key, "the form is Dummy0005=1; skipped")
        elif values.integer(text).value:
            used.add(code)
    described.dummies = frozenset(code for code in used if _FIRST_DUMMY <= code <= _LAST_DUMMY)
    if used - described.dummies:
        described.add(section.line, f"[{section.name}]: 0x{min(used - described.dummies):04X} is no data type; skipped")


def _read_objects(file: EdsFile, into: Description) -> None:
    for index in sorted(file.objects.keys() | file.subs.keys()):
        read = _Reader(file, into, index).read()
        if read is not None:
            into.objects[index] = read
    for index, lists in sorted(file.lists.items()):
        section = file.objects.get(index)
        if section is None or section.get("CompactSubObj") is None:
            for listed in lists.values():
                text = f"[{listed.name}]: object 0x{index:04X} has no CompactSubObj; the list is not applied"
                into.add(listed.line, text)


class _Reader:
    def __init__(self, file: EdsFile, into: Description, index: int) -> None:
        self._file, self._into, self._index = file, into, index
        self._subs = file.subs.get(index, {})
        self._section = file.objects.get(index)
        self._own = self._section or self._subs[min(self._subs)]  # for its line

    def read(self) -> Object | None:
        code = self._code()
        if code in (eds.NULL, eds.DEFTYPE, eds.DEFSTRUCT):
            if self._index >= communication.FIRST and code != eds.NULL:
                self._own.say("ObjectType", "a type definition has no value; left out")
            return None
        name = f"{self._index:04X}h"
        if self._section is not None:
            name = self._name(self._section, name)
        made = Object(self._index, name, code, self._own.line)
        if code in (eds.VAR, eds.DOMAIN):
            entry = made.entries[0] = self._into.take(self._entry(0, self._own, name, code == eds.DOMAIN))
            made.code = eds.VAR if entry.type.size is not None else code
            return made
        if self._compact:
            self._read_compact(made, self._own, self._compact)
        for sub, section in sorted(self._subs.items()):
            name = self._name(section, f"{made.name} {sub}")
            code = read_key(section, "ObjectType") if section.get("ObjectType") else eds.VAR
            if code not in (eds.VAR, eds.DOMAIN):
                section.say("ObjectType", "a sub-index is a VAR; read as one")
            made.entries[sub] = self._into.take(self._entry(sub, section, name, code == eds.DOMAIN, self._section))
        self._check_count(made)
        return made if made.entries else None

    def _name(self, section: Section, default: str) -> str:
        name: str = read_key(section, "ParameterName")
        if not name:
            section.say("ParameterName", f"called {default!r}")
        return name or default

    def _code(self) -> int:
        section = self._section
        if section is None:
            self._into.add(self._own.line, f"[{self._own.name}]: no section [{self._index:04X}]; read as a RECORD")
            return eds.RECORD
        code: int | None = read_key(section, "ObjectType")
        if code is not None and code not in _OBJECT_CODES:
            section.say("ObjectType", "allowed are 0x0, 0x2, 0x5 to 0x9")
            code = None
        if self._subs or self._compact:
            if code in (None, eds.VAR, eds.DOMAIN):
                section.say("ObjectType", "the object has sub-indices; read as a RECORD")
                return eds.RECORD
        elif code in (eds.ARRAY, eds.RECORD):
            if section.get("DataType"):
                section.say("ObjectType", "the object has no sub-index; read as a VAR")
                return eds.VAR
            section.say("SubNumber", "the object has no section of a sub-index; left out")
            return eds.NULL
        return eds.VAR if code is None else code  # the default of CiA 306-1

    @cached_property
    def _compact(self) -> int:
        given = 0 if self._section is None else read_key(self._section, "CompactSubObj")
        count = min(max(given, 0), _MOST_COMPACT)
        if count and count != given:
            self._own.say("CompactSubObj", f"allowed are 1 to {_MOST_COMPACT}; read as {count}")
        return count

    def _read_compact(self, made: Object, section: Section, count: int) -> None:
        lists = self._file.lists.get(self._index, {})
        texts = {name: listed(section) for name, section in lists.items()}
        read: dict[str | None, Entry] = {}  # by the type that CiA 301 has, where it has one
        for sub in range(1, count + 1):
            name = texts.get("name", {}).get(sub) or f"{made.name}{sub}"
            letter = standard.standard_letter(self._index, sub)
            if letter not in read:
                said = len(self._into.findings)
                read[letter] = self._entry(sub, section, name, False)
                if sub > 1:
                    del self._into.findings[said:]  # said of the first entry
            entry = self._into.take(replace(read[letter], sub=sub, name=name))
            entry.denotation = texts.get("denotation", {}).get(sub) or ""
            text = texts.get("value", {}).get(sub)
            if text is not None:
                value, has_node_id, remark, entry.is_other = values.typed(entry.type, text, self._into.node_id)
                entry.remark = lists["value"].say(str(sub), remark)
                if self._into.is_dcf:
                    entry.value = value
                else:
                    entry.default, entry.has_node_id, entry.has_default = value, has_node_id, True
            made.entries[sub] = entry
        for part in lists.values():
            self._check_list(part, count)
        zero = Entry(self._index, 0, "Number of entries", "B", "ro", count, line=section.line, has_default=False)
        # CiA 306-1; where CiA 301 has it writable, it is as the entries are.
        if self._index == communication.ERROR_HISTORY:
            zero.access, zero.default = "rw", 0
        elif communication.is_mapping(self._index):
            zero.access = "rw" if made.entries[1].access.startswith("rw") else "ro"
            zero.default = max((sub for sub, entry in made.entries.items() if entry.initial), default=0)
        made.entries[0] = zero

    def _check_list(self, section: Section, count: int) -> None:
        listed = [(key, sub) for key in section.keys if (sub := _sub_of(key)) is not None]
        given = next((section.get(key) for key in ("NrOfEntries", "NrOfObjects") if section.get(key)), None)
        if given is not None and values.integer(given).value != len(listed):
            self._into.add(section.line, f"[{section.name}] NrOfEntries={given}: the list has {len(listed)}; all apply")
        for key, sub in listed:
            if not 1 <= sub <= count:
                section.say(key, f"CompactSubObj is {count}; not applied")

    def _check_count(self, made: Object) -> None:
        index, highest = self._index, max(made.entries)
        if 0 not in made.entries:
            self._into.add(made.line, f"[{index:04X}]: no sub-index 0; added as UNSIGNED8 ro with the value {highest}")
            made.entries[0] = Entry(index, 0, "Highest sub-index supported", "B", "ro", highest, line=made.line)
        if self._section is not None and self._section.get("SubNumber") and not self._compact:
            number = read_key(self._section, "SubNumber")
            if number != len(self._subs):
                self._own.say("SubNumber", f"the file has {len(self._subs)} sections of sub-indices; all apply")
        zero = made.entries[0]
        if zero.type.python is not int:
            self._into.add(zero.line, f"[{index:04X}sub0]: {zero.type.name}; CiA 301 has UNSIGNED8; the type stays")
        elif communication.is_mapping(index) or index == communication.ERROR_HISTORY or 0 not in self._subs:
            return
        elif not zero.has_default:
            zero.default = highest
        elif zero.initial != highest and highest < 0xFF:
            self._subs[0].say("DefaultValue", f"the highest sub-index is {highest}; the value stays")

    def _entry(self, sub: int, section: Section, name: str, is_domain: bool, parent: Section | None = None) -> Entry:
        letter = self._letter(sub, section, is_domain, parent)
        entry = Entry(
            self._index, sub, name, letter, self._access(sub, section, parent), 0, line=section.line,
            unit=section.get("Unit") or section.get("Units") or "", denotation=section.get("Denotation") or "",
            mappable=read_key(section, "PDOMapping"), flags=read_key(section, "ObjFlags"),
        )  # fmt: skip
        if is_domain and entry.type.size is not None:
            section.say("ObjectType", f"a DOMAIN has DataType 0x000F; read as a VAR of {entry.type.name}")
        self._read_values(entry, section)
        self._read_limits(entry, section)
        return entry

    def _letter(self, sub: int, section: Section, is_domain: bool, parent: Section | None) -> str:
        expected = standard.standard_letter(self._index, sub)
        own = section.get("DataType") or ""
        text = own or ("" if sub == 0 or parent is None else parent.get("DataType") or "")
        code = _CODE_OF_TYPE.get(text.lower())
        if code is not None:
            section.say("DataType", f"the form is a number; read as 0x{code:04X}")
        elif text:
            code, _, remark, _ = values.integer(text)
            if code is not None and remark and own:
                section.say("DataType", remark)
        letter = LETTER_OF_CODE.get(code or 0) or self._defined(code)
        if letter is None and is_domain and not text:
            return "D"
        if letter is None:
            letter = expected or ("B" if sub == 0 and parent is not None else _UNKNOWN_TYPE)
            wrong = "no type of CiA 301, 7.4.7" if text else "no DataType"
            how = f"{TYPES[letter].name} of CiA 301" if expected else f"{TYPES[letter].name}, its bytes as they come"
            section.say("DataType", f"{wrong}; read as {how}")
        elif expected is not None and (
            # The services of the device compute with it.
            (expected not in "sD" and ((TYPES[letter].limits or (1,))[0] != 0 or letter == "?"))
            or (sub == 0 and letter != expected and communication.is_mapping(self._index))  # the device counts to it
            or (self._index == communication.STORED_EDS and TYPES[letter].size is not None)
        ):
            section.say("DataType", f"CiA 301 has {TYPES[expected].name}; read as it")
            return expected
        elif expected is not None and expected != letter and expected not in "sD":
            section.say("DataType", f"CiA 301 has {TYPES[expected].name}; the type stays")
        return letter

    def _defined(self, code: int | None) -> str | None:
        section = self._file.objects.get(code or 0)
        text = section.get("DataType") if section is not None and (code or 0) < communication.FIRST else None
        return LETTER_OF_CODE.get(values.integer(text).value or 0) if text else None

    def _access(self, sub: int, section: Section, parent: Section | None) -> str:
        text = section.get("AccessType") or ""
        if not text and parent is not None and sub:
            text = parent.get("AccessType") or ""
        plain, remark = values.uncommented(text)
        access = plain.lower()
        if access in _ACCESS:
            section.say("AccessType", remark)
            return access
        word = access.replace(" ", "").replace("only", "")
        access = _ACCESS_WORDS.get(word, "ro" if sub == 0 and parent is not None else "rw")
        section.say("AccessType", f"allowed are {', '.join(_ACCESS)}; read as {access}")
        return access

    def _read_values(self, entry: Entry, section: Section) -> None:
        # Editors of some vendors write the default of a device as ParameterValue, also in an EDS.
        key = "DefaultValue" if section.get("DefaultValue") or self._into.is_dcf else "ParameterValue"
        entry.has_default = bool(section.get(key))
        entry.default, entry.has_node_id = self._value(entry, section, key)
        if section.get("ParameterValue") and self._into.is_dcf:
            entry.value, _ = self._value(entry, section, "ParameterValue")
        for key in ("UploadFile", "DownloadFile"):
            name = section.get(key)
            if name and entry.type.python is bytes:
                content, wrong = file_content(self._into.path, name)
                section.say(key, wrong)
                if content is not None:
                    entry.value, entry.is_other = content, False
            elif name:
                section.say(key, f"only a DOMAIN has a file, not {entry.type.name}; not read")

    def _value(self, entry: Entry, section: Section, key: str) -> tuple[Value, bool]:
        text = section.get(key) or ""
        value, has_node_id, remark, entry.is_other = values.typed(entry.type, text, self._into.node_id)
        entry.remark = section.say(key, remark)
        return value, has_node_id

    def _read_limits(self, entry: Entry, section: Section) -> None:
        if entry.type.python not in (int, float):
            return
        limits: list[int | float | None] = []
        for key in ("LowLimit", "HighLimit"):
            text = section.get(key)
            limit, remark = values.limit(entry.type, text, self._into.node_id) if text else (None, "")
            section.say(key, remark)
            limits.append(limit)
        low, high = limits
        if low is not None and high is not None and (low > high or low == high == 0):
            why = "above HighLimit" if low > high else "HighLimit, too, is 0: no other value were allowed"
            section.say("LowLimit", f"{why}; neither limit applies")
            return
        entry.low, entry.high = low, high
        for key, value in (("DefaultValue", entry.default), ("ParameterValue", entry.value)):
            if not section.get(key) or not isinstance(value, int | float):
                continue
            if (low is not None and value < low) or (high is not None and value > high):
                shown = " to ".join("any" if limit is None else str(limit) for limit in limits)
                section.say(key, f"outside the limits {shown}; the value stays, a write of it is rejected")


def file_content(path: Path, name: str) -> tuple[bytes | None, str]:
    """Return (bytes of the file beside the DCF, "") or (None, why not): a device serves them to anyone on its bus."""
    try:
        file = below(path.resolve().parent, name.replace("\\", "/"))
        if file.stat().st_size > _MOST_FILE_BYTES:
            return None, f"larger than {_MOST_FILE_BYTES >> 20} MiB; not read"
        return file.read_bytes(), ""
    except (OSError, InputError) as error:
        return None, f"{getattr(error, 'strerror', None) or error}; not read"


def _sub_of(key: str) -> int | None:
    return values.integer(key).value if key[:1].isdigit() else None


def listed(section: Section) -> dict[int, str]:
    """Return the texts of a list by sub-index; ``1`` applies before ``0x1``, else the first."""
    texts: dict[int, str] = {}
    for key, text in section.keys.items():
        sub = _sub_of(key)
        if sub is not None and (sub not in texts or key == str(sub)):
            texts[sub] = text
    return texts
