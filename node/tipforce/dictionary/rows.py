"""The table with its runs unfolded: one ``Row`` for each sub-index, grouped by object. What every generator reads."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from tipforce.dictionary import table
from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.dictionary.table import Limit, Run, Value

_PDO = table.TPDO | table.RPDO


@dataclass(frozen=True, slots=True)
class Row:
    """One entry of the dictionary, as the table states it; ``low`` and ``high`` are None where there is no limit."""

    index: int
    sub: int
    name: str
    slug: str  # dotted name without the sub-index, "" for a sub-index 0 that has none of its own
    many: bool  # several sub-indices share the slug: "slug:sub"
    letter: str
    access: str
    flags: int
    default: Value
    low: Limit
    high: Limit
    unit: str

    @property
    def mappable(self) -> bool:
        """May be mapped into a PDO, of either direction."""
        return bool(self.flags & _PDO)

    @property
    def dotted(self) -> str:
        """The name that ``names.resolve`` reads, such as ``calibration.matrix:3``."""
        if not self.slug:
            return f"0x{self.index:04X}:{self.sub:02X}"
        return f"{self.slug}:{self.sub}" if self.many else self.slug


@dataclass(frozen=True, slots=True)
class Object:
    """One index of the dictionary: ``code`` is the object code (7 VAR, 8 ARRAY, 9 RECORD; CiA 301, 7.4.3)."""

    index: int
    code: int
    name: str
    slug: str
    rows: tuple[Row, ...]


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
        declared = table.objects(n, simulated, converter, programs)
    except ValueError as error:
        raise InputError(str(error)) from None
    return tuple(
        Object(index, code, name, slug, tuple(row for run in runs for row in _unfold(index, code, run)))
        for index, code, name, slug, runs in declared
    )


@lru_cache(maxsize=32)
def rows(n: int = 3, simulated: bool = False, programs: bool = False) -> dict[tuple[int, int], Row]:
    """Every entry by (index, sub), in order. Raises InputError for an ``n`` outside 3..8."""
    return {(row.index, row.sub): row for found in objects(n, simulated, programs=programs) for row in found.rows}


def _unfold(index: int, code: int, run: Run) -> list[Row]:
    first, count, names, slug, letter, access, flags, defaults, low, high, unit = run
    many = code != table.VAR and not (first == 0 or (code == table.RECORD and count == 1))
    unfolded = []
    for k in range(count):
        sub = first + k
        name = names[k] if isinstance(names, tuple) else names.replace("%d", str(sub))
        default = defaults[k] if isinstance(defaults, tuple) else defaults
        own_slug = "" if slug == "count" else slug
        unfolded.append(Row(index, sub, name, own_slug, many, letter, access, flags, default, low, high, unit))
    return unfolded
