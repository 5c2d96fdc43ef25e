"""Object sections of an EDS or DCF as entries: records, arrays, compact arrays with their lists (CiA 306-1)."""

from __future__ import annotations

from tipforce.device import communication
from tipforce.dictionary.types import LETTER_OF_CODE, TYPES, Value
from tipforce.eds import description as eds
from tipforce.eds import standard, values
from tipforce.eds.description import Description, Entry, Object
from tipforce.eds.sections import EdsFile, Section
from tipforce.eds.uploads import file_content

_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_OBJECT_CODES = (eds.NULL, eds.DOMAIN, eds.DEFTYPE, eds.DEFSTRUCT, eds.VAR, eds.ARRAY, eds.RECORD)
_MOST_COMPACT = 254
_CODE_OF_WORD = {"domain": eds.DOMAIN, "var": eds.VAR, "array": eds.ARRAY, "record": eds.RECORD}
_CODE_OF_TYPE = {kind.name.lower(): kind.code for kind in TYPES.values()}
_UNKNOWN_TYPE = "o"
_BIT_FLAGS = ("0", "1")
_MAPPABLE = ("optional", "default", "tpdo", "rpdo", "on", "y")  # in words, as an XDD has it
_ACCESS_WORDS = {"r": "ro", "w": "wo", "read": "ro", "write": "wo", "constant": "const"}


def read_objects(file: EdsFile, into: Description) -> None:
    """Add every object of the file to ``into.objects``, and what is wrong with it to ``into.findings``."""
    for index in sorted(file.objects.keys() | file.subs.keys()):
        found = _Object(file, into, index).read()
        if found is not None:
            into.objects[index] = found
    for index, lists in sorted(file.lists.items()):
        section = file.objects.get(index)
        if section is None or section.get("CompactSubObj") is None:
            for one in lists.values():
                into.add(one.line, f"[{one.name}]: object 0x{index:04X} has no CompactSubObj; the list is not applied")


class _Object:
    """The sections of one index."""

    def __init__(self, file: EdsFile, into: Description, index: int) -> None:
        self._file, self._into, self._index = file, into, index
        self._subs = file.subs.get(index, {})
        self._section = file.objects.get(index)
        self._own = self._section or self._subs[min(self._subs)]  # for its line

    def read(self) -> Object | None:
        code = self._code()
        if code in (eds.NULL, eds.DEFTYPE, eds.DEFSTRUCT):
            if self._index >= communication.FIRST and code != eds.NULL:
                self._say("ObjectType", "a type definition has no value; left out")
            return None
        name = self._own.get("ParameterName") if self._section is not None else None
        if not name:
            name = f"{self._index:04X}h"
            if self._section is not None:
                self._say("ParameterName", f"called {name!r}")
        found = Object(self._index, name, code, self._own.line)
        if code in (eds.VAR, eds.DOMAIN):
            found.entries[0] = self._entry(0, self._own, name, code == eds.DOMAIN)
        else:
            self._read_list(found)
        return found if found.entries else None

    def _code(self) -> int:
        section = self._section
        if section is None:
            self._into.add(self._own.line, f"[{self._own.name}]: no section [{self._index:04X}]; read as a RECORD")
            return eds.RECORD
        code = self._object_type(section)
        compact = bool(self._compact())
        if code is not None and code not in _OBJECT_CODES:
            self._say("ObjectType", "allowed are 0x0, 0x2, 0x5 to 0x9")
            code = None
        if code is None:
            if self._subs or compact:
                self._say("ObjectType", "the object has sub-indices; read as a RECORD")
                return eds.RECORD
            return eds.VAR  # the default of CiA 306-1
        if code in (eds.VAR, eds.DOMAIN) and (self._subs or compact):
            self._say("ObjectType", "the object has sub-indices; read as a RECORD")
            return eds.RECORD
        if code in (eds.ARRAY, eds.RECORD) and not self._subs and not compact:
            if section.get("DataType"):
                self._say("ObjectType", "the object has no sub-index; read as a VAR")
                return eds.VAR
            self._say("SubNumber", "the object has no section of a sub-index; left out")
            return eds.NULL
        return code

    def _object_type(self, section: Section) -> int | None:
        """Return the object code, also where the file has its name."""
        text = section.get("ObjectType") or ""
        code = _CODE_OF_WORD.get(text.lower())
        if code is not None:
            self._into.findings.append(section.finding("ObjectType", f"the form is a number; read as 0x{code:X}"))
            return code
        return self._number(section, "ObjectType") if text else None

    def _compact(self) -> int:
        section = self._section
        if section is None or not section.get("CompactSubObj"):
            return 0
        count = self._number(section, "CompactSubObj") or 0
        if not 0 <= count <= _MOST_COMPACT:
            return _MOST_COMPACT if count > 0 else 0
        return count

    def _read_list(self, found: Object) -> None:
        compact = self._compact()
        if compact and self._section is not None:
            given = self._number(self._section, "CompactSubObj")
            if given != compact:
                self._say("CompactSubObj", f"allowed are 1 to {_MOST_COMPACT}; read as {compact}")
            self._read_compact(found, self._section, compact)
        inherited = None if self._section is None else self._section
        for sub in sorted(self._subs):
            section = self._subs[sub]
            name = section.get("ParameterName") or ""
            if not name:
                name = f"{found.name} {sub}"
                self._into.findings.append(section.finding("ParameterName", f"called {name!r}"))
            code = self._object_type(section) if section.get("ObjectType") else eds.VAR
            if code not in (eds.VAR, eds.DOMAIN):
                self._into.findings.append(section.finding("ObjectType", "a sub-index is a VAR; read as one"))
            found.entries[sub] = self._entry(sub, section, name, code == eds.DOMAIN, inherited)
        self._check_count(found)

    def _read_compact(self, found: Object, section: Section, count: int) -> None:
        lists = self._file.lists.get(self._index, {})
        for sub in range(1, count + 1):
            name = _listed(lists.get("name"), sub) or f"{found.name}{sub}"
            entry = self._entry(sub, section, name, False, quiet=sub > 1)
            entry.denotation = _listed(lists.get("denotation"), sub) or ""
            text = _listed(lists.get("value"), sub)
            if text is not None and "value" in lists:
                self._apply_listed(entry, lists["value"], text)
            found.entries[sub] = entry
        for one in lists.values():
            self._check_list(one, count)
        filled = (
            [sub for sub in found.entries if found.entries[sub].initial] if standard.is_mapping(self._index) else []
        )
        default = max(filled, default=0) if standard.is_mapping(self._index) else count
        access = "ro"  # CiA 306-1; where CiA 301 has it writable, it is as the entries are
        if self._index == communication.ERROR_HISTORY:
            access, default = "rw", 0
        elif standard.is_mapping(self._index) and found.entries[1].access.startswith("rw"):
            access = "rw"
        found.entries[0] = Entry(
            self._index, 0, "Number of entries", "B", access, default, line=section.line, has_default=False
        )

    def _apply_listed(self, entry: Entry, section: Section, text: str) -> None:
        value, has_node_id, remark = values.typed(entry.type, text, self._into.node_id)
        if remark:
            self._into.findings.append(section.finding(str(entry.sub), remark))
        if self._into.is_dcf:
            entry.value = value
        else:
            entry.default, entry.has_node_id, entry.has_default = value, has_node_id, True

    def _check_list(self, section: Section, count: int) -> None:
        listed = [key for key in section.keys if _sub_of(key) is not None]
        told = next((section.get(key) for key in ("NrOfEntries", "NrOfObjects") if section.get(key)), None)
        if told is not None and values.integer(told).value != len(listed):
            self._into.add(section.line, f"[{section.name}] NrOfEntries={told}: the list has {len(listed)}; all apply")
        for key in listed:
            sub = _sub_of(key) or 0
            if not 1 <= sub <= count:
                self._into.findings.append(section.finding(key, f"CompactSubObj is {count}; not applied"))

    def _check_count(self, found: Object) -> None:
        index, subs = self._index, sorted(found.entries)
        highest = subs[-1]
        if 0 not in found.entries:
            self._into.add(found.line, f"[{index:04X}]: no sub-index 0; added as UNSIGNED8 ro with the value {highest}")
            found.entries[0] = Entry(index, 0, "Highest sub-index supported", "B", "ro", highest, line=found.line)
        told = self._section.get("SubNumber") if self._section is not None else None
        if told and not self._compact() and self._section is not None:
            number = self._number(self._section, "SubNumber")
            if number != len(self._subs):
                self._say("SubNumber", f"the file has {len(self._subs)} sections of sub-indices; all apply")
        zero = found.entries[0]
        free = standard.is_mapping(index) or index == communication.ERROR_HISTORY
        if zero.type.python is not int:
            self._into.add(zero.line, f"[{index:04X}sub0]: {zero.type.name}; CiA 301 has UNSIGNED8; the type stays")
            return
        if not zero.has_default and not free and 0 in self._subs:
            zero.default = highest
        elif zero.initial != highest and 0 in self._subs and not free and highest < 0xFF:
            self._into.findings.append(
                self._subs[0].finding("DefaultValue", f"the highest sub-index is {highest}; the value stays")
            )

    # --- one entry ------------------------------------------------------------------------------------------

    def _entry(
        self, sub: int, section: Section, name: str, is_domain: bool, parent: Section | None = None, quiet: bool = False
    ) -> Entry:
        remarks = len(self._into.findings)
        letter = self._letter(sub, section, is_domain, parent)
        entry = Entry(self._index, sub, name, letter, self._access(sub, section, parent), 0, line=section.line)
        entry.unit = section.get("Unit") or section.get("Units") or ""
        entry.denotation = section.get("Denotation") or ""
        entry.mappable = self._mappable(section)
        if section.get("ObjFlags"):
            entry.flags = self._number(section, "ObjFlags") or 0
        self._read_values(entry, section)
        self._read_limits(entry, section)
        if quiet:
            del self._into.findings[remarks:]  # said of the first entry of a compact array
        return entry

    def _letter(self, sub: int, section: Section, is_domain: bool, parent: Section | None) -> str:
        expected = standard.standard_letter(self._index, sub)
        text = section.get("DataType") or ("" if sub == 0 or parent is None else parent.get("DataType") or "")
        code = _CODE_OF_TYPE.get(text.lower())
        if code is not None:
            self._into.findings.append(section.finding("DataType", f"the form is a number; read as 0x{code:04X}"))
        elif text:
            code = values.integer(text).value
            if code is not None and text == section.get("DataType"):
                self._number(section, "DataType")
        letter = LETTER_OF_CODE.get(code or 0) or self._defined(code)
        if letter is None and is_domain and not text:
            return "D"
        if letter is None:
            letter = expected or ("B" if sub == 0 and parent is not None else _UNKNOWN_TYPE)
            told = "no type of CiA 301, 7.4.7" if text else "no DataType"
            how = f"{TYPES[letter].name} of CiA 301" if expected else f"{TYPES[letter].name}, its bytes as they come"
            self._into.findings.append(section.finding("DataType", f"{told}; read as {how}"))
        elif expected is not None and (
            (standard.is_needed_integer(self._index, sub) and not _is_unsigned(letter))
            or (sub == 0 and letter != expected and standard.is_mapping(self._index))  # the device counts to it
            or (self._index == communication.STORED_EDS and TYPES[letter].size is not None)
        ):
            self._into.findings.append(section.finding("DataType", f"CiA 301 has {TYPES[expected].name}; read as it"))
            return expected
        elif expected not in (None, letter) and standard.is_needed_integer(self._index, sub):
            told = f"CiA 301 has {TYPES[expected].name}; the type stays"
            self._into.findings.append(section.finding("DataType", told))
        return letter

    def _defined(self, code: int | None) -> str | None:
        """Return the type behind a DEFTYPE of the file."""
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
            if remark:
                self._into.findings.append(section.finding("AccessType", remark))
            return access
        word = access.replace(" ", "").replace("only", "")
        access = _ACCESS_WORDS.get(word, "ro" if sub == 0 and parent is not None else "rw")
        self._into.findings.append(section.finding("AccessType", f"allowed are {', '.join(_ACCESS)}; read as {access}"))
        return access

    def _mappable(self, section: Section) -> bool:
        text = section.get("PDOMapping")
        if not text or text in _BIT_FLAGS:
            return text == "1"
        value, _, remark = values.integer(text)
        if value is None:
            value = int(text.lower() in _MAPPABLE)
            remark = f"the form is 0 or 1; read as {value}"
        if remark:
            self._into.findings.append(section.finding("PDOMapping", remark))
        return bool(value)

    def _read_values(self, entry: Entry, section: Section) -> None:
        entry.has_default = bool(section.get("DefaultValue"))
        entry.default, entry.has_node_id = self._value(entry, section, "DefaultValue")
        if section.get("ParameterValue") and self._into.is_dcf:
            entry.value, _ = self._value(entry, section, "ParameterValue")
        for key in ("UploadFile", "DownloadFile"):
            name = section.get(key)
            if name:
                content, told = file_content(self._into.path, name)
                if entry.type.python is not bytes:
                    told = f"only a DOMAIN has a file, not {entry.type.name}; not read"
                elif content is not None:
                    entry.value = content
                if told:
                    self._into.findings.append(section.finding(key, told))

    def _value(self, entry: Entry, section: Section, key: str) -> tuple[Value, bool]:
        value, has_node_id, remark = values.typed(entry.type, section.get(key) or "", self._into.node_id)
        if remark:
            self._into.findings.append(section.finding(key, remark))
        return value, has_node_id

    def _read_limits(self, entry: Entry, section: Section) -> None:
        if entry.type.python not in (int, float):
            return
        low, high = self._limit(entry, section, "LowLimit"), self._limit(entry, section, "HighLimit")
        if low is not None and high is not None and (low > high or low == high == 0):
            why = "above HighLimit" if low > high else "HighLimit, too, is 0: no other value were allowed"
            self._into.findings.append(section.finding("LowLimit", f"{why}; neither limit applies"))
            return
        entry.low, entry.high = low, high
        for key, value in (("DefaultValue", entry.default), ("ParameterValue", entry.value)):
            if section.get(key) and isinstance(value, int | float) and not _within(entry, value):
                told = f"outside the limits {_shown(low)} to {_shown(high)}; the value stays, a write of it is rejected"
                self._into.findings.append(section.finding(key, told))

    def _limit(self, entry: Entry, section: Section, key: str) -> int | float | None:
        if not section.get(key):
            return None
        value, remark = values.limit(entry.type, section.get(key) or "", self._into.node_id)
        if remark:
            self._into.findings.append(section.finding(key, remark))
        return value

    def _number(self, section: Section, key: str) -> int | None:
        """Return an integer key, None for what is none; a remark becomes a finding, once."""
        value, _, remark = values.integer(section.get(key) or "")
        if remark:
            finding = section.finding(key, remark)
            if finding not in self._into.findings[-20:]:
                self._into.findings.append(finding)
        return value

    def _say(self, key: str, what: str) -> None:
        if self._section is not None:
            self._into.findings.append(self._section.finding(key, what))


def _is_unsigned(letter: str) -> bool:
    kind = TYPES[letter]
    return kind.python is int and kind.limits is not None and kind.limits[0] == 0 and letter != "?"


def _within(entry: Entry, value: float) -> bool:
    return (entry.low is None or value >= entry.low) and (entry.high is None or value <= entry.high)


def _shown(limit: float | None) -> str:
    return "any" if limit is None else str(limit)


def _sub_of(key: str) -> int | None:
    """Return the sub-index of a key of a list: ``1``, ``0x1``; None for another key."""
    return values.integer(key).value if key[:1].isdigit() else None


def _listed(section: Section | None, sub: int) -> str | None:
    if section is None:
        return None
    plain = section.get(str(sub))
    if plain is not None:
        return plain
    return next((text for key, text in section.keys.items() if _sub_of(key) == sub), None)
