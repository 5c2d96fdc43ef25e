"""Rows of samples as columns: the data that the parts of `tipforce decode` exchange."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.dictionary.signals import Signal

Values = npt.NDArray[Any]
BoolArray = npt.NDArray[np.bool_]

NO_COUNTER = -1
NO_FLAG = -1
NO_INTEGER = np.iinfo(np.int64).min
_MISSING = {"flag": np.int8(NO_FLAG), "integer": np.int64(NO_INTEGER), "real": np.float64(math.nan)}
NODE_BITS = 7
"""A key is channel << NODE_BITS | node-id: it separates nodes of two buses."""

_SUFFIX = {"N": "_N", "degree": "_deg", "microstrain": "_ue", "degC": "_degC"}
_FIRST = ("P", "phi", "theta", "u_P", "u_phi", "u_theta", "F1", "F2", "F3")
_GAUGE, _NUMBER, _FLAG, _COUNT = 20, 40, 60, 80


@dataclass(frozen=True, slots=True)
class Column:
    """One column: ``kind`` is "real", "flag" or "integer".

    ``digits`` after the point are its resolution (None: as many as needed). ``rank`` orders columns.
    """

    name: str
    signal: str
    kind: str
    digits: int | None
    unit: str
    rank: int

    @property
    def angle(self) -> bool:
        """True if values a full turn apart are equal."""
        return self.unit == "degree"


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """k rows, each a sample of one node, in the order of their first frames.

    ``t_ns`` (k,) receive time of the first frame; ``key`` (k,) channel and node; ``counter`` (k,) of the sample, or
    NO_COUNTER; ``cyclic`` (k,): whether it came with a PDO that follows SYNC. ``values`` by column name, (k,) each:
    real float64 with NaN for missing, flag int8 with NO_FLAG, integer int64 with NO_INTEGER.
    ``absent``: by column name, where no frame carried it; columns present in all rows are omitted.
    """

    t_ns: npt.NDArray[np.int64]
    key: npt.NDArray[np.uint16]
    counter: npt.NDArray[np.int64]
    cyclic: BoolArray
    columns: tuple[Column, ...] = ()
    values: dict[str, Values] = field(default_factory=dict)
    absent: dict[str, BoolArray] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    timed: bool = True
    moduli: tuple[tuple[str, int], ...] = ()
    """Of the counters, by channel; 256 for one that it lacks."""

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def node(self) -> npt.NDArray[np.uint8]:
        """(k,) the node-ids; 0 for messages of a DBC that belong to no node."""
        return (self.key & ((1 << NODE_BITS) - 1)).astype(np.uint8)

    @property
    def channel(self) -> npt.NDArray[np.intp]:
        """(k,) indices into ``channels``."""
        return (self.key >> NODE_BITS).astype(np.intp)

    def with_columns(self, columns: Iterable[Column], channels: tuple[str, ...]) -> Table:
        """Return the table with further columns, empty in all rows, and further channels."""
        new = [column for column in columns if column.name not in self.values]
        none = {column.name: missing_of(column, len(self)) for column in new}
        absent = {column.name: np.ones(len(self), dtype=np.bool_) for column in new}
        ordered = in_order((*self.columns, *new))
        return replace(
            self, columns=ordered, values={**self.values, **none}, absent={**self.absent, **absent}, channels=channels
        )

    def renumbered(self, numbers: Sequence[int], channels: tuple[str, ...], timed: bool) -> Table:
        """Return the table with other ``numbers`` of its channels, and without times unless ``timed``."""
        key = np.array(numbers, dtype=np.uint16)[self.channel] << NODE_BITS | self.node
        return replace(self, key=key.astype(np.uint16), channels=channels, timed=self.timed and timed)

    def take(self, rows: npt.NDArray[Any]) -> Table:
        """Return some of the rows."""
        return replace(
            self,
            t_ns=self.t_ns[rows],
            key=self.key[rows],
            counter=self.counter[rows],
            cyclic=self.cyclic[rows],
            values={name: column[rows] for name, column in self.values.items()},
            absent={name: column[rows] for name, column in self.absent.items()},
        )


def column_of(signal: Signal) -> Column:
    """Return the column for a signal."""
    if signal.bits == 1 and signal.unknown is None:
        return Column(signal.name, signal.name, "flag", 0, "", _rank(signal.name, _FLAG))
    name = signal.name + ("" if signal.index == 0 else _SUFFIX.get(signal.unit, ""))
    plain = signal.unknown is None and signal.scale == 1 and not signal.offset and not signal.real
    if plain and (signal.bits < 64 or signal.signed):
        return Column(name, signal.name, "integer", 0, signal.unit, _rank(signal.name, _NUMBER))
    digits = None
    if not signal.real and 0 < signal.scale <= 1 and not signal.offset:
        digits = -math.floor(math.log10(signal.scale) + 1e-9)
        if abs(signal.scale * 10**digits - round(signal.scale * 10**digits)) > 1e-6 or digits > 9:
            digits = None
    return Column(name, signal.name, "real", digits, signal.unit, _rank(signal.name, _NUMBER))


def computed(name: str, unit: str, digits: int | None = 6) -> Column:
    """Return a column of numbers that no frame carried."""
    return Column(name + _SUFFIX.get(unit, ""), name, "real", digits, unit, _rank(name, _NUMBER))


def counted(name: str) -> Column:
    """Return a column of integers that no frame carried."""
    return Column(name, name, "integer", 0, "", _COUNT)


def flag(name: str) -> Column:
    """Return a column of flags that no frame carried."""
    return Column(name, name, "flag", 0, "", _rank(name, _FLAG))


def _rank(name: str, otherwise: int) -> int:
    if name in _FIRST:
        return _FIRST.index(name)
    return _GAUGE if name.startswith("SG") and name[2:].isdigit() else otherwise


def in_order(columns: Iterable[Column], asked: Sequence[str] | None = None) -> tuple[Column, ...]:
    """Return columns in display order: contact, forces, gauges, other numbers, flags; or in the requested order."""
    if asked is not None:
        place = {name: number for number, name in enumerate(asked)}
        return tuple(sorted(columns, key=lambda column: place.get(column.signal, len(place))))
    return tuple(sorted(columns, key=lambda column: column.rank))


def missing_of(column: Column, count: int) -> Values:
    """Return ``count`` missing values."""
    return np.full(count, _MISSING[column.kind])


def is_missing(column: Column, values: Values) -> BoolArray:
    """Return which values are missing."""
    return np.isnan(values) if column.kind == "real" else np.asarray(values == _MISSING[column.kind])
