"""From what a person writes to an entry of a description: an index, ``6041h:00``, or the name of the file."""

from __future__ import annotations

import difflib
import re
from typing import TYPE_CHECKING

from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.eds.description import Description, Entry

_NUMERIC = re.compile(
    r"(?:0[xX]([0-9a-fA-F]{1,4})|([0-9a-fA-F]{1,4})[hH])(?:\s*[:./]\s*(?:0[xX])?([0-9a-fA-F]{1,2})[hH]?)?"
)


def find(description: Description, key: int | tuple[int, int] | str) -> Entry:
    """Return the entry that ``key`` names. Raises InputError."""
    if isinstance(key, str):
        match = _NUMERIC.fullmatch(key.strip())
        if match is None:
            return _named(description, key)
        index, sub = int(match[1] or match[2], 16), None if match[3] is None else int(match[3], 16)
    else:
        index, sub = (key, None) if isinstance(key, int) else key
    return _numbered(description, index, sub)


def _numbered(description: Description, index: int, sub: int | None) -> Entry:
    found = description.objects.get(index)
    if found is None:
        near = sorted(description.objects, key=lambda known: (abs(known - index), known))[:3]
        shown = ", ".join(f"0x{known:04X}" for known in near)
        raise InputError(f"{description.path.name}: no object 0x{index:04X}; the nearest are {shown}")
    if sub is None and set(found.entries) != {0}:
        raise InputError(
            f"0x{index:04X} {found.name!r} has several entries: write 0x{index:04X}:SS, {_subs(found.entries)}"
        )
    entry = found.entries.get(sub or 0)
    if entry is None:
        raise InputError(f"0x{index:04X} {found.name!r}: no sub-index {sub}; allowed are {_subs(found.entries)}")
    return entry


def _subs(entries: dict[int, Entry]) -> str:
    subs = sorted(entries)
    return ", ".join(f"{sub:02X}" for sub in subs) if len(subs) < 9 else f"{subs[0]:02X} to {subs[-1]:02X}"


def folded(name: str) -> str:
    """Return a name without what does not distinguish it: case, spaces, punctuation."""
    return "".join(part for part in name.lower() if part.isalnum() or part == "/")


def names(description: Description) -> dict[str, list[Entry]]:
    """Return the entries by folded name: that of the object for a single value, object/entry, and entry alone."""
    found: dict[str, list[Entry]] = {}
    for index in sorted(description.objects):
        one = description.objects[index]
        for entry in one.entries.values():
            if set(one.entries) == {0}:
                found.setdefault(folded(one.name), []).append(entry)
                continue
            found.setdefault(f"{folded(one.name).replace('/', '')}/{folded(entry.name).replace('/', '')}", []).append(
                entry
            )
            found.setdefault(folded(entry.name), []).append(entry)
    return found


def _named(description: Description, key: str) -> Entry:
    known = names(description)
    found = known.get(folded(key), [])
    if len(found) == 1:
        return found[0]
    if found:
        shown = ", ".join(entry.place for entry in found[:4]) + (", ..." if len(found) > 4 else "")
        raise InputError(f"{key!r} names {len(found)} entries of {description.path.name}: {shown}; write one of these")
    near = difflib.get_close_matches(folded(key), list(known), 3, 0.5)
    shown = ", ".join(f"{known[name][0].name!r} ({known[name][0].place})" for name in near)
    hint = f"close to it: {shown}" if near else "write an index such as 0x6064 or a ParameterName of the file"
    raise InputError(f"{description.path.name}: no object is called {key!r}; {hint}")
