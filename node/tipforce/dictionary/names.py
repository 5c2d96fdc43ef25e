"""All entries of a node: the table's runs unfolded, each sub-index an ``Entry``, by place and by the name that a person
writes: ``calibration.matrix:3``, ``0x2103:04``, ``2103h:04``. After a dotted name the sub-index is decimal, because it
counts; after an index hexadecimal, because it continues that number."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from typing import Any, TypeAlias

from tipforce.dictionary import indices, table, table_objects
from tipforce.dictionary.entries import Entry
from tipforce.errors import InputError

Entries: TypeAlias = dict[tuple[int, int], Entry[Any]]
_NUMERIC = re.compile(r"(?:0[xX]([0-9a-fA-F]{1,4})|([0-9a-fA-F]{4})[hH])(?:[:.](?:0[xX])?([0-9a-fA-F]{1,2})[hH]?)?")


@dataclass(frozen=True, slots=True)
class Object:
    """One index of the dictionary: ``code`` is the object code (7 VAR, 8 ARRAY, 9 RECORD; CiA 301, 7.4.3)."""

    index: int
    code: int
    name: str
    stem: str
    entries: tuple[Entry[Any], ...]


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


def describe(index: int, sub: int, n: int = 3) -> Entry[Any] | None:
    """What the dictionary of ``n`` gauges says of an entry, None where it has no such entry."""
    return entries(n, True, True).get((index, sub))


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
    import difflib  # its import costs time

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
