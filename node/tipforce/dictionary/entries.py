"""Typed handles on dictionary entries: what to read or write, and how its bytes become a value."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

from tipforce.dictionary import types
from tipforce.dictionary.rows import objects
from tipforce.errors import InputError

T = TypeVar("T", bound=types.Value)


# The slots are written out: a class that dataclass(slots=True) makes again can't be frozen and called as Entry[int].


@dataclass(frozen=True)
class Entry(Generic[T]):
    """One sub-index. ``type`` is a letter of ``types.TYPES``, ``access`` is ro, wo, rw or const."""

    __slots__ = ("access", "index", "name", "sub", "type", "unit")

    index: int
    sub: int
    type: str
    name: str
    access: str
    unit: str

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

    def __reduce__(self) -> tuple[Any, ...]:
        return Entry, (self.index, self.sub, self.type, self.name, self.access, self.unit)

    def __str__(self) -> str:
        """``0x2100:03``; both numbers are hexadecimal."""
        return f"0x{self.index:04X}:{self.sub:02X}"


@dataclass(frozen=True)
class Array(Generic[T]):
    """The entries of one index that share a name and a type; ``array[sub]`` is one of them."""

    __slots__ = ("access", "index", "name", "type", "unit")

    index: int
    type: str
    name: str
    access: str
    unit: str

    def __reduce__(self) -> tuple[Any, ...]:
        return Array, (self.index, self.type, self.name, self.access, self.unit)

    def __getitem__(self, sub: int) -> Entry[T]:
        """The entry at ``sub``. Raises InputError outside 1..254; how many a node has depends on its gauges."""
        if not 1 <= sub <= 254:
            raise InputError(f"{self.name}: sub-index {sub}, allowed 1 to 254")
        return Entry[T](self.index, sub, self.type, f"{self.name}:{sub}", self.access, self.unit)

    def subs(self, n: int = 3) -> range:
        """The sub-indices that a node with ``n`` gauges has. Raises InputError for an ``n`` outside 3..8."""
        for found in objects(n, True, programs=True):
            if found.index == self.index:
                own = [row.sub for row in found.rows if row.many and row.slug == self.name]
                return range(own[0], own[-1] + 1)
        raise InputError(f"{self.name} (0x{self.index:04X}) is not in the dictionary of {n} gauges")

    def count(self, n: int = 3) -> int:
        """How many entries a node with ``n`` gauges has. Raises InputError for an ``n`` outside 3..8."""
        return len(self.subs(n))

    def entries(self, n: int = 3) -> Iterator[Entry[T]]:
        """Every entry that a node with ``n`` gauges has, in order."""
        return (self[sub] for sub in self.subs(n))
