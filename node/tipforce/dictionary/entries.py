"""Entries of the dictionary: what to read or write, how bytes become a value, and what the table says of each."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, TypeVar, cast

from canopen_device import types
from tipforce.dictionary import table
from tipforce.errors import InputError, placed

if TYPE_CHECKING:
    from tipforce.dictionary.table import Limit

T = TypeVar("T", bound=types.Value)


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
        with placed(f"{self.name} ({self})"):
            return types.encode(self.type, value)

    def decode(self, data: bytes) -> T:
        """The value of the bytes of an SDO upload. Raises InputError where the length does not fit the type."""
        with placed(f"{self.name} ({self})"):
            return cast(T, types.decode(self.type, data))

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


def gauges_of(product: int) -> int:
    """Number of gauges of a node by its product code (1018h:2); 0 for a node that is none of this dictionary."""
    gauges = product & table.PRODUCT_GAUGES
    ours = product & ~(table.PRODUCT_SIMULATED | table.PRODUCT_24_BIT) == table.PRODUCT | gauges
    return gauges if ours and table.MIN_GAUGES <= gauges <= table.MAX_GAUGES else 0
