"""From what a person writes to an entry: ``calibration.matrix:3``, ``0x2103:04``, ``2103h:04``.

After a dotted name the sub-index is decimal, because it counts; after an index it is hexadecimal, because it
continues that number, as ``str(entry)`` prints it.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass

from tipforce.dictionary import types
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.rows import Row, rows
from tipforce.errors import InputError

_NUMERIC = re.compile(r"(?:0[xX]([0-9a-fA-F]{1,4})|([0-9a-fA-F]{4})[hH])(?:[:.](?:0[xX])?([0-9a-fA-F]{1,2})[hH]?)?")


@dataclass(frozen=True, slots=True)
class Description:
    """What an entry is called and holds: ``dotted`` is its name here, ``letter`` its type, see ``types``."""

    name: str
    dotted: str
    unit: str
    letter: str
    access: str


def resolve(text: str, n: int = 3) -> Entry[types.Value]:
    """The entry that ``text`` names on a node with ``n`` gauges, simulated or not, with program slots or without.

    Raises InputError with the nearest names, or with the sub-indices that there are.
    """
    found = rows(n, True, True)
    wanted = text.strip()
    match = _NUMERIC.fullmatch(wanted)
    row = _numeric(match, found, n) if match else _named(wanted, found, n)
    return Entry[types.Value](row.index, row.sub, row.letter, row.dotted, row.access, row.unit)


def describe(index: int, sub: int, n: int = 3) -> Description | None:
    """What the dictionary of ``n`` gauges says of an entry, None where it has no such entry."""
    row = rows(n, True, True).get((index, sub))
    return None if row is None else Description(row.name, row.dotted, row.unit, row.letter, row.access)


def all_names(n: int = 3) -> tuple[str, ...]:
    """Every dotted name of a node with ``n`` gauges, by index: for completion."""
    return tuple(row.dotted for row in rows(n, True, True).values() if row.slug)


def _numeric(match: re.Match[str], found: dict[tuple[int, int], Row], n: int) -> Row:
    index, sub = int(match[1] or match[2], 16), int(match[3] or "0", 16)
    row = found.get((index, sub))
    subs = [s for i, s in found if i == index]
    if row is not None and (match[3] is not None or subs == [0]):
        return row
    if not subs:
        near = sorted({i for i, _ in found}, key=lambda i: (abs(i - index), i))[:3]
        hint = ", ".join(f"0x{i:04X}" for i in near)
        raise InputError(f"{match[0]}: no object 0x{index:04X} with {n} gauges; the nearest are {hint}")
    allowed = _ranges(subs, "02X")
    if match[3] is None:
        raise InputError(f"{match[0]} has several sub-indices: write 0x{index:04X}:SS, SS (hex) {allowed}")
    raise InputError(f"{match[0]}: no sub-index {sub} (0x{sub:02X}); allowed, in hex, with {n} gauges: {allowed}")


def _named(text: str, found: dict[tuple[int, int], Row], n: int) -> Row:
    by_name = {row.dotted: row for row in found.values() if row.slug}
    name = re.sub(r"[.:](\d+)$", lambda m: f":{int(m[1])}", text)
    if name in by_name:
        return by_name[name]
    stem = name.partition(":")[0]
    subs = [row.sub for row in found.values() if row.many and row.slug == stem]
    if subs:
        raise InputError(f"{text}: write {stem}:SUB, with {n} gauges SUB is {_ranges(subs, 'd')}")
    return _folded(text, name, by_name)


def _folded(text: str, name: str, by_name: dict[str, Row]) -> Row:
    """One name that differs in case alone is meant; anything else gets suggestions."""
    same = [row for dotted, row in by_name.items() if dotted.lower() == name.lower()]
    if len(same) == 1:
        return same[0]
    stems = {dotted.partition(":")[0] for dotted in by_name}
    tails = {stem.rpartition(".")[2]: stem for stem in sorted(stems)}
    near = difflib.get_close_matches(name.partition(":")[0], sorted(stems | set(tails)), n=3, cutoff=0.6)
    hints = list(dict.fromkeys(tails.get(word, word) for word in near))
    if hints:
        raise InputError(f"no object is called {text!r}; close to it: {', '.join(hints)}")
    raise InputError(
        f"no object is called {text!r}; write a name such as calibration.generation or an index such as 0x2103:04"
    )


def _ranges(subs: list[int], form: str) -> str:
    """``00-09`` or ``00-03, 05-06``."""
    parts: list[list[int]] = []
    for sub in subs:
        if parts and sub == parts[-1][1] + 1:
            parts[-1][1] = sub
        else:
            parts.append([sub, sub])
    return ", ".join(f"{a:{form}}" if a == b else f"{a:{form}}-{b:{form}}" for a, b in parts)
