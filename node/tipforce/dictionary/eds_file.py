"""Reading the text of an EDS or DCF into sections, keeping what is wrong with it (CiA 306-1, 4.4)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

_OBJECT = re.compile(r"([0-9A-Fa-f]{4})")
_SUB = re.compile(r"([0-9A-Fa-f]{4})sub([0-9A-Fa-f]{1,2})", re.IGNORECASE)


@dataclass(slots=True)
class Section:
    """One section; keys are in lower case, ``name`` and ``written`` as the file has them."""

    name: str
    line: int
    keys: dict[str, str] = field(default_factory=dict)
    written: dict[str, str] = field(default_factory=dict)

    def get(self, key: str) -> str | None:
        """The value of ``key``, in any case; None where it is missing."""
        return self.keys.get(key.lower())

    def complaint(self, key: str, what: str) -> str:
        """``[name] key=value: what``."""
        value = self.get(key)
        shown = f"{key} missing" if value is None else f"{self.written[key.lower()]}={value}"
        return f"[{self.name}] {shown}: {what}"


@dataclass(slots=True)
class EdsFile:
    """The sections of a file by their names in lower case; objects and their subs by number."""

    sections: dict[str, Section] = field(default_factory=dict)
    objects: dict[int, Section] = field(default_factory=dict)
    subs: dict[int, dict[int, Section]] = field(default_factory=dict)
    complaints: list[str] = field(default_factory=list)

    def entry(self, index: int, sub: int) -> Section | None:
        """The section of an entry: that of the sub-index, or of the object itself where it has none."""
        if index in self.subs:
            return self.subs[index].get(sub)
        return self.objects.get(index) if sub == 0 else None


def parse(text: str) -> EdsFile:
    """Never raises: lines that are no part of an EDS, and what occurs twice, become complaints."""
    found = EdsFile()
    section: Section | None = None
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.strip()
        if not line or line.startswith(";"):
            continue
        if line.startswith("[") and line.endswith("]"):
            section = _open(found, line[1:-1].strip(), number)
        elif "=" not in line:
            found.complaints.append(f"line {number} {line!r}: allowed are [section], key=value and ; comment")
        elif section is None:
            found.complaints.append(f"line {number} {line!r}: a key needs a [section] above it")
        else:
            _add(found, section, line, number)
    return found


def _open(found: EdsFile, name: str, number: int) -> Section:
    section = Section(name, number)
    key = name.lower()
    if key in found.sections:
        first = found.sections[key].line
        found.complaints.append(f"[{name}] line {number}: the section is already there at line {first}")
        return section
    found.sections[key] = section
    if match := _OBJECT.fullmatch(name):
        found.objects[int(match[1], 16)] = section
    elif match := _SUB.fullmatch(name):
        found.subs.setdefault(int(match[1], 16), {})[int(match[2], 16)] = section
    return section


def _add(found: EdsFile, section: Section, line: str, number: int) -> None:
    key, _, value = line.partition("=")
    name = key.strip()
    if name.lower() in section.keys:
        found.complaints.append(f"[{section.name}] {name} line {number}: the key is already there")
        return
    section.keys[name.lower()] = value.strip()
    section.written[name.lower()] = name
