"""Entries of the dictionary: what to read or write, how bytes become a value, and what the table says of each.
``objects`` unfolds the table's runs into an ``Entry`` for each sub-index. ``resolve`` finds what a person writes:
``calibration.matrix:3``, ``0x2103:04``, ``2103h:04``. After a dotted name the sub-index is decimal, because it counts;
after an index hexadecimal, because it continues that number, as ``str(entry)`` prints it.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar, cast

from canopen_device import types
from tipforce.dictionary import indices, table, table_objects
from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.dictionary.table import Limit

T = TypeVar("T", bound=types.Value)
Entries: TypeAlias = "dict[tuple[int, int], Entry[Any]]"

_NUMERIC = re.compile(r"(?:0[xX]([0-9a-fA-F]{1,4})|([0-9a-fA-F]{4})[hH])(?:[:.](?:0[xX])?([0-9a-fA-F]{1,2})[hH]?)?")


@dataclass(frozen=True)
class Entry(Generic[T]):
    """One sub-index: what identifies it, then what the table says of it (no part of equality)."""

    index: int
    sub: int
    type: str
    """A letter of ``types.TYPES``."""
    name: str
    """That ``resolve`` reads, such as ``calibration.matrix:3``; of an EDS its ParameterName, or the number."""
    access: str
    """ro, wo, rw or const."""
    unit: str
    title: str = field(default="", compare=False)
    """For people: its ParameterName."""
    stem: str = field(default="", compare=False)
    """The name without the sub-index; empty for a sub-index 0 that has none of its own."""
    flags: int = field(default=0, compare=False)
    """Of ``table``."""
    default: types.Value = field(default=0, compare=False)
    low: Limit = field(default=None, compare=False)
    """Least value allowed, None where there is no limit."""
    high: Limit = field(default=None, compare=False)

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.sub

    @property
    def is_counted(self) -> bool:
        """Several sub-indices share the stem: the name is "stem:sub"."""
        return self.stem != "" and self.name == f"{self.stem}:{self.sub}"

    @property
    def mappable(self) -> bool:
        """May be mapped into a PDO, of either direction."""
        return bool(self.flags & (table.TPDO | table.RPDO))

    def encode(self, value: T) -> bytes:
        """The bytes of an SDO download of ``value``. Raises InputError where it does not fit the type."""
        try:
            return types.encode(self.type, value)
        except InputError as error:
            raise InputError(f"{self.name} ({self}): {error}") from None

    def decode(self, data: bytes) -> T:
        """The value of the bytes of an SDO upload. Raises InputError where the length does not fit the type."""
        try:
            return cast(T, types.decode(self.type, data))
        except InputError as error:
            raise InputError(f"{self.name} ({self}): {error}") from None

    def __str__(self) -> str:
        """``0x2100:03``; both numbers are hexadecimal."""
        return f"0x{self.index:04X}:{self.sub:02X}"


@dataclass(frozen=True)
class Array(Generic[T]):
    """The entries of one index that share a name and a type; ``array[sub]`` is one of them."""

    index: int
    type: str
    name: str
    access: str
    unit: str

    def __getitem__(self, sub: int) -> Entry[T]:
        """The entry at ``sub``. Raises InputError outside 1..254; how many a node has depends on its gauges."""
        if not 1 <= sub <= 254:
            raise InputError(f"{self.name}: sub-index {sub}, allowed 1 to 254")
        return Entry[T](self.index, sub, self.type, f"{self.name}:{sub}", self.access, self.unit)

    def entries(self, n: int = 3) -> Iterator[Entry[T]]:
        """Every entry that a node with ``n`` gauges has, in order. Raises InputError for an ``n`` outside 3..8."""
        known = entries(n, True, True).values()
        return (self[entry.sub] for entry in known if entry.index == self.index and entry.stem == self.name)


@dataclass(frozen=True, slots=True)
class Object:
    """One index of the dictionary: ``code`` is the object code (7 VAR, 8 ARRAY, 9 RECORD; CiA 301, 7.4.3)."""

    index: int
    code: int
    name: str
    stem: str
    entries: tuple[Entry[Any], ...]


def gauges_of(product: int) -> int:
    """Number of gauges of a node by its product code (1018h:2); 0 for a node that is none of this dictionary."""
    gauges = product & table.PRODUCT_GAUGES
    ours = product & ~(table.PRODUCT_SIMULATED | table.PRODUCT_24_BIT) == table.PRODUCT | gauges
    return gauges if ours and table.MIN_GAUGES <= gauges <= table.MAX_GAUGES else 0


@lru_cache(maxsize=32)
def objects(
    n: int = 3, simulated: bool = False, converter: table.Converter = table.CONVERTER_16, programs: bool = False
) -> tuple[Object, ...]:
    """Every object of a node with ``n`` gauges, ordered by index. Raises InputError for an ``n`` outside 3..8."""
    try:
        declared = table_objects.objects(n, simulated, converter, programs)
    except ValueError as error:
        raise InputError(str(error)) from None
    unfolded = []
    for index, code, name, stem, runs in declared:
        listed: list[Entry[Any]] = []
        for first, count, titles, slug, letter, access, flags, defaults, low, high, unit in runs:
            counted = code != table.VAR and not (first == 0 or (code == table.RECORD and count == 1))
            own = "" if slug == "count" else slug
            for k, sub in enumerate(range(first, first + count)):
                full = f"0x{index:04X}:{sub:02X}" if not own else f"{own}:{sub}" if counted else own
                title = titles[k] if isinstance(titles, tuple) else titles.replace("%d", str(sub))
                default = defaults[k] if isinstance(defaults, tuple) else defaults
                listed.append(Entry(index, sub, letter, full, access, unit, title, own, flags, default, low, high))
        unfolded.append(Object(index, code, name, stem, tuple(listed)))
    return tuple(unfolded)


@lru_cache(maxsize=32)
def entries(n: int = 3, simulated: bool = False, programs: bool = False) -> Entries:
    """Every entry by (index, sub), in order. Raises InputError for an ``n`` outside 3..8."""
    known = objects(n, simulated, programs=programs)
    return {entry.key: entry for each in known for entry in each.entries}


def resolve(text: str, n: int = 3) -> Entry[Any]:
    """The entry that ``text`` names on a node with ``n`` gauges, simulated or not, with program slots or without.
    Raises InputError with the nearest names, or with the sub-indices that there are."""
    known, wanted = entries(n, True, True), text.strip()
    match = _NUMERIC.fullmatch(wanted)
    if match is None:
        return _named(wanted, known, n)
    index, sub = int(match[1] or match[2], 16), int(match[3] or "0", 16)
    subs = [s for i, s in known if i == index]
    if sub in subs and (match[3] is not None or subs == [0]):
        return known[index, sub]
    if not subs:
        near = sorted({i for i, _ in known}, key=lambda i: (abs(i - index), i))[:3]
        hint = ", ".join(f"0x{i:04X}" for i in near)
        raise InputError(f"{wanted}: no object 0x{index:04X} with {n} gauges; the nearest are {hint}")
    allowed = _ranges(subs, "02X")
    if match[3] is None:
        raise InputError(f"{wanted} has several sub-indices: write 0x{index:04X}:SS, SS (hex) {allowed}")
    raise InputError(f"{wanted}: no sub-index {sub} (0x{sub:02X}); allowed, in hex, with {n} gauges: {allowed}")


def describe(index: int, sub: int, n: int = 3) -> Entry[Any] | None:
    """What the dictionary of ``n`` gauges says of an entry, None where it has no such entry."""
    return entries(n, True, True).get((index, sub))


def all_names(n: int = 3) -> tuple[str, ...]:
    """Every dotted name of a node with ``n`` gauges, by index: for completion."""
    return tuple(entry.name for entry in entries(n, True, True).values() if entry.stem)


def _named(text: str, known: Entries, n: int) -> Entry[Any]:
    by_name = {entry.name: entry for entry in known.values() if entry.stem}
    name = re.sub(r"[.:](\d+)$", lambda m: f":{int(m[1])}", text)
    if name in by_name:
        return by_name[name]
    for sub, channel in enumerate(table.channels(n), 1):
        if channel[0] == text:
            return known[indices.PROCESS_VALUE, sub]
    stem = name.partition(":")[0]
    subs = [entry.sub for entry in known.values() if entry.is_counted and entry.stem == stem]
    if subs:
        raise InputError(f"{text}: write {stem}:SUB, with {n} gauges SUB is {_ranges(subs, 'd')}")
    same = [entry for own, entry in by_name.items() if own.lower() == name.lower()]
    if len(same) == 1:  # one name that differs in case alone is meant; anything else gets suggestions
        return same[0]
    stems = {own.partition(":")[0] for own in by_name}
    tails = {stem.rpartition(".")[2]: stem for stem in sorted(stems)}
    near = difflib.get_close_matches(name.partition(":")[0], sorted(stems | set(tails)), n=3, cutoff=0.6)
    hints = list(dict.fromkeys(tails.get(word, word) for word in near))
    if hints:
        raise InputError(f"no object is called {text!r}; close to it: {', '.join(hints)}")
    raise InputError(
        f"no object is called {text!r}; write a name such as calibration.generation or an index such as 0x2103:04"
    )


def _ranges(subs: list[int], form: str) -> str:
    # Within a run of consecutive numbers each is as far beyond its place as the others.
    runs = [[sub for _, sub in run] for _, run in groupby(enumerate(subs), lambda pair: pair[1] - pair[0])]
    return ", ".join(f"{run[0]:{form}}" + (f"-{run[-1]:{form}}" if len(run) > 1 else "") for run in runs)
