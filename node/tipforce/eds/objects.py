"""Object sections of an EDS or DCF as entries: records, arrays, compact arrays with their lists (CiA 306-1)."""

from __future__ import annotations

from dataclasses import replace

from tipforce.device import communication
from tipforce.eds import description as eds
from tipforce.eds import standard, values
from tipforce.eds.description import Description, Entry, Object
from tipforce.eds.entries import EntryReader
from tipforce.eds.sections import EdsFile, Section

_OBJECT_CODES = (eds.NULL, eds.DOMAIN, eds.DEFTYPE, eds.DEFSTRUCT, eds.VAR, eds.ARRAY, eds.RECORD)
_MOST_COMPACT = 254
_LONGEST_NAME = 255  # CiA 306-1 has 241
_CODE_OF_WORD = {"domain": eds.DOMAIN, "var": eds.VAR, "array": eds.ARRAY, "record": eds.RECORD}


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
        self._entries = EntryReader(file, into, index)
        self._subs = file.subs.get(index, {})
        self._section = file.objects.get(index)
        self._own = self._section or self._subs[min(self._subs)]  # for its line

    def read(self) -> Object | None:
        code = self._code()
        if code in (eds.NULL, eds.DEFTYPE, eds.DEFSTRUCT):
            if self._index >= communication.FIRST and code != eds.NULL:
                self._say("ObjectType", "a type definition has no value; left out")
            return None
        name = self._name(self._own) if self._section is not None else None
        if not name:
            name = f"{self._index:04X}h"
            if self._section is not None:
                self._say("ParameterName", f"called {name!r}")
        found = Object(self._index, name, code, self._own.line)
        if code in (eds.VAR, eds.DOMAIN):
            found.entries[0] = self._into.take(self._entries.read(0, self._own, name, code == eds.DOMAIN))
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
        return self._entries.number(section, "ObjectType") if text else None

    def _compact(self) -> int:
        section = self._section
        if section is None or not section.get("CompactSubObj"):
            return 0
        count = self._entries.number(section, "CompactSubObj") or 0
        if not 0 <= count <= _MOST_COMPACT:
            return _MOST_COMPACT if count > 0 else 0
        return count

    def _read_list(self, found: Object) -> None:
        compact = self._compact()
        if compact and self._section is not None:
            given = self._entries.number(self._section, "CompactSubObj")
            if given != compact:
                self._say("CompactSubObj", f"allowed are 1 to {_MOST_COMPACT}; read as {compact}")
            self._read_compact(found, self._section, compact)
        inherited = None if self._section is None else self._section
        for sub in sorted(self._subs):
            section = self._subs[sub]
            name = self._name(section)
            if not name:
                name = f"{found.name} {sub}"
                self._into.findings.append(section.finding("ParameterName", f"called {name!r}"))
            code = self._object_type(section) if section.get("ObjectType") else eds.VAR
            if code not in (eds.VAR, eds.DOMAIN):
                self._into.findings.append(section.finding("ObjectType", "a sub-index is a VAR; read as one"))
            entry = self._entries.read(sub, section, name, code == eds.DOMAIN, inherited)
            found.entries[sub] = self._into.take(entry)
        self._check_count(found)

    def _read_compact(self, found: Object, section: Section, count: int) -> None:
        lists = self._file.lists.get(self._index, {})
        listed = {name: _listed(section) for name, section in lists.items()}
        read: dict[str | None, Entry] = {}  # by the type that CiA 301 has, where it has one
        for sub in range(1, count + 1):
            name = listed.get("name", {}).get(sub) or f"{found.name}{sub}"
            letter = standard.standard_letter(self._index, sub)
            if letter not in read:
                read[letter] = self._entries.read(sub, section, name, False, quiet=sub > 1)
            entry = self._into.take(replace(read[letter], sub=sub, name=name))
            entry.denotation = listed.get("denotation", {}).get(sub) or ""
            text = listed.get("value", {}).get(sub)
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
            number = self._entries.number(self._section, "SubNumber")
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

    def _name(self, section: Section) -> str:
        name = section.get("ParameterName") or ""
        if len(name) > _LONGEST_NAME:
            self._into.findings.append(section.finding("ParameterName", f"cut to {_LONGEST_NAME} characters"))
        return name[:_LONGEST_NAME]

    def _say(self, key: str, what: str) -> None:
        if self._section is not None:
            self._into.findings.append(self._section.finding(key, what))


def _sub_of(key: str) -> int | None:
    """Return the sub-index of a key of a list: ``1``, ``0x1``; None for another key."""
    return values.integer(key).value if key[:1].isdigit() else None


def _listed(section: Section) -> dict[int, str]:
    """Return the texts of a list by sub-index; ``1`` applies before ``0x1``, else the first."""
    found: dict[int, str] = {}
    for key, text in section.keys.items():
        sub = _sub_of(key)
        if sub is not None and (sub not in found or key == str(sub)):
            found[sub] = text
    return found
