"""Objects of one entry, of equal entries and of different ones, in the form of ``dictionary.table``."""

from tipforce.dictionary.table import ARRAY, RECORD, VAR

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from tipforce.dictionary.table import Limit, Object, Run, Value


def var(
    index: int,
    name: str,
    slug: str,
    kind: str,
    access: str,
    flags: int = 0,
    default: "Value" = 0,
    low: "Limit" = None,
    high: "Limit" = None,
    unit: str = "",
) -> "Object":
    return (index, VAR, name, slug, ((0, 1, name, slug, kind, access, flags, default, low, high, unit),))


def array(
    index: int,
    name: str,
    slug: str,
    count: int,
    names: "str | tuple[str, ...]",
    kind: str,
    access: str,
    flags: int = 0,
    default: "Value | tuple[Value, ...]" = 0,
    low: "Limit" = None,
    high: "Limit" = None,
    unit: str = "",
) -> "Object":
    run = (1, count, names, slug, kind, access, flags, default, low, high, unit)
    return (index, ARRAY, name, slug, (run,))


def record(index: int, name: str, slug: str, *entries: "tuple[Any, ...]") -> "Object":
    """Entries as (sub, name, slug, type, access, flags, default, low, high, unit), the tail optional."""
    filled: list[Run] = []
    for entry in entries:
        tail = (0, 0, None, None, "")[len(entry) - 5 :]
        sub, label, part, kind, access = entry[:5]
        flags, default, low, high, unit = tuple(entry[5:]) + tail
        filled.append((sub, 1, label, slug + "." + part, kind, access, flags, default, low, high, unit))
    return (index, RECORD, name, slug, tuple(filled))
