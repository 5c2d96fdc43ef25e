"""What an EDS or DCF says of a device: objects with their entries, general facts, and what is wrong with the file."""

import difflib
import re
from dataclasses import dataclass, field
from pathlib import Path

from canopen_device.eds.sections import Findings
from canopen_device.errors import InputError
from canopen_device.types import TYPES, DataType, Value

NULL, DOMAIN, DEFTYPE, DEFSTRUCT, VAR, ARRAY, RECORD = 0, 2, 5, 6, 7, 8, 9  # object codes (CiA 301, 7.4.3)
READ_ONLY, CONSTANT = "ro", "const"
_NUMERIC = re.compile(
    r"(?:0[xX]([0-9a-fA-F]{1,4})|([0-9a-fA-F]{1,4})[hH])(?:\s*[:./]\s*(?:0[xX])?([0-9a-fA-F]{1,2})[hH]?)?"
)
COUNTED = re.compile(r"(.+):(\d+)")  # an object by its name, and a sub-index
MOST_ENTRIES = 100_000
"""Entries of a device: large devices have some thousands; few lines with CompactSubObj and CompactPDO count many."""

MOST_VALUE_BYTES = 64 << 20
"""Names and values of all entries, with the files of a DCF: a section may stand for 254 entries."""


@dataclass(slots=True)
class Entry:
    """One sub-index. ``default`` and ``value`` (None without one) include the node-id; ``directions``: flags TPDO, RPDO
    of the PDOs that may map it; ``access``: ro, wo, rw, rwr, rww or const; ``letter`` one of ``types``; ``remark``: on
    the text of ``initial``, behind its line; ``is_other``: ``initial`` is not the value of that text."""

    index: int
    sub: int
    name: str
    letter: str
    access: str
    default: Value
    low: int | float | None = None
    high: int | float | None = None
    mappable: bool = False
    directions: int = 0
    has_node_id: bool = False
    has_default: bool = True
    value: Value | None = None
    remark: str = ""
    is_other: bool = False
    flags: int = 0
    unit: str = ""
    denotation: str = ""
    line: int = 0

    @property
    def type(self) -> DataType:
        """The data type."""
        return TYPES[self.letter]

    @property
    def initial(self) -> Value:
        """The value after power-on."""
        return self.default if self.value is None else self.value

    @property
    def place(self) -> str:
        """``0x1018:01``."""
        return f"0x{self.index:04X}:{self.sub:02X}"


@dataclass(slots=True)
class Object:
    """One index; ``code`` is the object code, ``entries`` by sub-index (a VAR or DOMAIN has 0 alone)."""

    index: int
    name: str
    code: int
    line: int
    entries: dict[int, Entry] = field(default_factory=dict)


@dataclass(slots=True)
class Description:
    """A device as its file describes it, for one node-id. ``bit_rates`` are those that [DeviceInfo] allows, in bit/s,
    ``bit_rate`` is that of a DCF. ``dummies``: data types that an RPDO may map as placeholders, None if not stated."""

    path: Path
    node_id: int
    objects: dict[int, Object] = field(default_factory=dict)
    findings: Findings = field(default_factory=Findings)
    content: bytes = b""
    vendor_name: str = ""
    product_name: str = ""
    order_code: str = ""
    node_name: str = ""
    bit_rates: tuple[int, ...] = ()
    bit_rate: int | None = None
    serial: int | None = None
    lss: bool = True
    dummies: frozenset[int] | None = None
    is_dcf: bool = False
    count: int = 0
    value_bytes: int = 0

    def take(self, entry: Entry) -> Entry:
        """Count an entry, and return it. Raises InputError beyond MOST_ENTRIES and MOST_VALUE_BYTES."""
        self.count += 1
        if self.count > MOST_ENTRIES:
            raise InputError(f"{self.path}:{entry.line}: {entry.place}: more than {MOST_ENTRIES} entries, the limit")
        self.value_bytes += len(entry.name)
        self.value_bytes += sum(len(v) for v in (entry.default, entry.value) if isinstance(v, str | bytes))
        if self.value_bytes > MOST_VALUE_BYTES:
            problem = f"more than {MOST_VALUE_BYTES} bytes of names and values up to it, the limit"
            raise InputError(f"{self.path}:{entry.line}: {entry.place}: {problem}")
        return entry

    def add(self, line: int, text: str) -> None:
        """Note what is wrong at ``line``."""
        self.findings.add(line, text)

    @property
    def warnings(self) -> list[str]:
        """The findings as text: ``drive.eds:120: [6040] DataType=...: ...``."""
        name = self.path.name
        return [f"{name}:{line}: {text}" if line else f"{name}: {text}" for line, text in sorted(self.findings)]

    def entry(self, index: int, sub: int) -> Entry | None:
        """The entry, None if there is none."""
        return self.objects[index].entries.get(sub) if index in self.objects else None

    def entries(self) -> list[Entry]:
        """Every entry, by index and sub-index."""
        return [entry for _, part in sorted(self.objects.items()) for _, entry in sorted(part.entries.items())]

    def find(self, key: int | tuple[int, int] | str) -> Entry:
        """The entry of an index (its only or first value), (index, sub), "0x6064", "6041h:00", or a name in any case
        ("Object/Entry" for a record, "Object:3"). Raises InputError with the nearest names, or those of several."""
        if not isinstance(key, str):
            return _numbered(self, key, None) if isinstance(key, int) else _numbered(self, *key)
        if match := _NUMERIC.fullmatch(key.strip()):
            return _numbered(self, int(match[1] or match[2], 16), None if match[3] is None else int(match[3], 16))
        known = names(self)
        named = known.get(folded(key), [])
        if len(named) == 1:
            return named[0]
        if match := COUNTED.fullmatch(key.strip()):
            indices = [index for index, each in self.objects.items() if folded(each.name) == folded(match[1])]
            if len(indices) == 1:
                return _numbered(self, indices[0], int(match[2]))
        if named:
            shown = ", ".join(entry.place for entry in named[:4]) + (", ..." if len(named) > 4 else "")
            raise InputError(f"{key!r} names {len(named)} entries of {self.path.name}: {shown}; write one of these")
        near = difflib.get_close_matches(folded(key), list(known), 3, 0.5)
        shown = ", ".join(f"{known[name][0].name!r} ({known[name][0].place})" for name in near)
        hint = f"close to it: {shown}" if near else "write an index such as 0x6064 or a ParameterName of the file"
        raise InputError(f"{self.path.name}: no object is called {key!r}; {hint}")


def _numbered(description: Description, index: int, sub: int | None) -> Entry:
    named = description.objects.get(index)
    if named is None:
        near = sorted(description.objects, key=lambda known: (abs(known - index), known))[:3]
        shown = ", ".join(f"0x{known:04X}" for known in near)
        raise InputError(f"{description.path.name}: no object 0x{index:04X}; the nearest are {shown}")
    subs = sorted(named.entries)
    shown = ", ".join(f"{known:02X}" for known in subs) if len(subs) < 9 else f"{subs[0]:02X} to {subs[-1]:02X}"
    if sub is None and subs != [0]:
        raise InputError(f"0x{index:04X} {named.name!r} has several entries: write 0x{index:04X}:SS, {shown}")
    if (sub or 0) not in subs:
        raise InputError(f"0x{index:04X} {named.name!r}: no sub-index {sub}; allowed are {shown}")
    return named.entries[sub or 0]


def folded(name: str) -> str:
    """Return a name without what does not distinguish it: case, spaces, punctuation."""
    return "".join(part for part in name.lower() if part.isalnum() or part == "/")


def names(description: Description) -> dict[str, list[Entry]]:
    """Return the entries by folded name: that of the object for a single value, object/entry, and entry alone."""
    known: dict[str, list[Entry]] = {}
    for _, part in sorted(description.objects.items()):
        object_name = folded(part.name)
        for entry in part.entries.values():
            name = folded(entry.name)
            both = object_name.replace("/", "") + "/" + name.replace("/", "")
            for text in (object_name,) if set(part.entries) == {0} else (both, name):
                known.setdefault(text, []).append(entry)
    return known
