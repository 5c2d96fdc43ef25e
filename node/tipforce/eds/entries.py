"""One entry of an EDS or DCF: type, access, PDO mapping, values and limits of a section (CiA 306-1)."""

from __future__ import annotations

from tipforce.device import communication
from tipforce.dictionary.types import LETTER_OF_CODE, TYPES, Value
from tipforce.eds import standard, values
from tipforce.eds.description import Description, Entry
from tipforce.eds.sections import EdsFile, Section
from tipforce.eds.uploads import file_content

_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_CODE_OF_TYPE = {kind.name.lower(): kind.code for kind in TYPES.values()}
_UNKNOWN_TYPE = "o"
_BIT_FLAGS = ("0", "1")
_MAPPABLE = ("optional", "default", "tpdo", "rpdo", "on", "y")  # in words, as an XDD has it
_ACCESS_WORDS = {"r": "ro", "w": "wo", "read": "ro", "write": "wo", "constant": "const"}


class EntryReader:
    """The entries of one index; what is wrong with them becomes a finding of ``into``."""

    def __init__(self, file: EdsFile, into: Description, index: int) -> None:
        self._file, self._into, self._index = file, into, index

    def read(
        self, sub: int, section: Section, name: str, is_domain: bool, parent: Section | None = None, quiet: bool = False
    ) -> Entry:
        """Read the entry of a section; ``parent`` is the section of its object, ``quiet`` says nothing of it."""
        remarks = len(self._into.findings)
        letter = self._letter(sub, section, is_domain, parent)
        entry = Entry(self._index, sub, name, letter, self._access(sub, section, parent), 0, line=section.line)
        entry.unit = section.get("Unit") or section.get("Units") or ""
        entry.denotation = section.get("Denotation") or ""
        entry.mappable = self._mappable(section)
        if section.get("ObjFlags"):
            entry.flags = self.number(section, "ObjFlags") or 0
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
                self.number(section, "DataType")
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
        # Editors of some vendors write the default of a device as ParameterValue, also in an EDS.
        key = "DefaultValue" if section.get("DefaultValue") or self._into.is_dcf else "ParameterValue"
        entry.has_default = bool(section.get(key))
        entry.default, entry.has_node_id = self._value(entry, section, key)
        if section.get("ParameterValue") and self._into.is_dcf:
            entry.value, _ = self._value(entry, section, "ParameterValue")
        for key in ("UploadFile", "DownloadFile"):
            name = section.get(key)
            if name:
                if entry.type.python is bytes:
                    content, told = file_content(self._into.path, name)
                    entry.value = entry.value if content is None else content
                else:
                    told = f"only a DOMAIN has a file, not {entry.type.name}; not read"
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

    def number(self, section: Section, key: str) -> int | None:
        """Return an integer key, None for what is none; a remark becomes a finding, once."""
        value, _, remark = values.integer(section.get(key) or "")
        if remark:
            finding = section.finding(key, remark)
            if finding not in self._into.findings[-20:]:
                self._into.findings.append(finding)
        return value


def _is_unsigned(letter: str) -> bool:
    kind = TYPES[letter]
    return kind.python is int and kind.limits is not None and kind.limits[0] == 0 and letter != "?"


def _within(entry: Entry, value: float) -> bool:
    return (entry.low is None or value >= entry.low) and (entry.high is None or value <= entry.high)


def _shown(limit: float | None) -> str:
    return "any" if limit is None else str(limit)
