"""Convert tables of samples to the traces of each finger."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.sample_table import NO_COUNTER, NODE_BITS, Column, Table
from tipforce_tools.cli.common import shown_id
from tipforce_tools.plot.traces import Flags, Lost, Trace

_UNCERTAINTY_OF = {"P": "u_P", "phi": "u_phi", "theta": "u_theta"}
_HELD_NS = 3_000_000_000  # validity of an uncertainty: TPDO4 is sent once a second
INVERTED = {"calibrated": "not calibrated"}
"""The flags whose absence is drawn as a bar."""


class Finger:
    """One node of one bus. ``traces`` and ``units`` by signal; ``computed`` ones are computed from its gauges."""

    def __init__(self, name: str, start_ns: int, wanted: Collection[str], computed: Collection[str]) -> None:
        self.name = name
        self.traces: dict[str, Trace] = {}
        self.units: dict[str, str] = {}
        self.flags: dict[str, Flags] = {}
        self.lost = Lost(start_ns)
        self._start_ns = start_ns
        self._wanted = wanted
        self._computed = computed
        self._held: dict[str, tuple[int, float]] = {}

    def add(self, table: Table, rows: npt.NDArray[np.intp]) -> None:
        """Add the rows of a table that belong to this finger."""
        t_ns = table.t_ns[rows]
        columns = {column.signal: column for column in table.columns}
        flags: dict[str, tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]] = {}
        steady = table.cyclic[rows] & (table.counter[rows] != NO_COUNTER)
        self.lost.add(t_ns[steady], table.counter[rows][steady])
        for signal, column in columns.items():
            there = self._there(table, column, rows)
            if not there.any():
                continue
            values = table.values[column.name][rows]
            if column.kind == "flag":
                is_set = values == 1
                flags[INVERTED.get(signal, signal)] = is_set != (signal in INVERTED), there
            elif column.kind in {"real", "integer"} and signal in self._wanted:
                if signal not in self.traces:
                    self.traces[signal] = Trace(self._start_ns, angle=column.angle and not signal.startswith("u_"))
                    self.units[signal] = column.unit
                u = self._uncertainty(table, columns, signal, rows, t_ns)
                self.traces[signal].add(t_ns[there], values.astype(np.float64)[there], None if u is None else u[there])
        if flags:
            self._take_flags(t_ns, flags)

    def _there(self, table: Table, column: Column, rows: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
        """Return a mask of the rows with the signal, known or not. A computed one needs its gauges."""
        name = "SG1_ue" if column.signal in self._computed and "SG1_ue" in table.values else column.name
        there = np.ones(len(rows), dtype=np.bool_)
        if name in table.absent:
            there &= ~table.absent[name][rows]
        if column.kind == "flag":
            there &= table.values[column.name][rows] >= 0
        return there

    def _uncertainty(
        self,
        table: Table,
        columns: dict[str, Column],
        signal: str,
        rows: npt.NDArray[np.intp],
        t_ns: npt.NDArray[np.int64],
    ) -> npt.NDArray[np.float64] | None:
        """Return the standard uncertainty at each row: its own, or the last one sent while it is valid."""
        column = columns.get(_UNCERTAINTY_OF.get(signal, ""))
        if column is None and _UNCERTAINTY_OF.get(signal, "") not in self._held:
            return None
        name = _UNCERTAINTY_OF[signal]
        own = np.full(len(rows), np.nan) if column is None else table.values[column.name][rows]
        if name in self._computed:
            return own
        at_ns, value = self._held.get(name, (0, np.nan))
        known = np.flatnonzero(np.isfinite(own))
        last = np.searchsorted(known, np.arange(len(rows)), side="right")
        times = np.concatenate(([at_ns], t_ns[known]))[last]
        held = np.concatenate(([value], own[known]))[last]
        if len(known):
            self._held[name] = int(t_ns[known[-1]]), float(own[known[-1]])
        return np.where(t_ns - times <= _HELD_NS, held, np.nan)

    def _take_flags(
        self, t_ns: npt.NDArray[np.int64], flags: dict[str, tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]]
    ) -> None:
        """Bin flags with different times separately: status with each sample, faults with TPDO4."""
        for group in ("status", "health"):
            chosen = {name: both for name, both in flags.items() if (name in _STATUS) == (group == "status")}
            if chosen:
                rows = np.logical_or.reduce([there for _, there in chosen.values()])
                collected = self.flags.setdefault(group, Flags(self._start_ns))
                collected.add(t_ns[rows], {name: (is_set & there)[rows] for name, (is_set, there) in chosen.items()})


_STATUS = frozenset(
    {
        "contact", "not calibrated", "saturated", "stale", "theta_unresolved", "misses_tip", "outside_pad", "fault",
        "beyond_first_order",
    }
)  # fmt: skip


class Fingers:
    """All fingers of a recording by channel and node."""

    def __init__(self, wanted: Collection[str], computed: Collection[str]) -> None:
        self._wanted, self._computed = wanted, computed
        self._by_key: dict[int, Finger] = {}
        self.start_ns: int | None = None
        self.end_ns = 0
        self.timed = True
        self._channels: tuple[str, ...] = ()

    def add(self, table: Table) -> None:
        """Add a table."""
        if not len(table):
            return
        if self.start_ns is None:
            self.start_ns = int(table.t_ns[0])
        self.end_ns = max(self.end_ns, int(table.t_ns.max()))
        self.timed = self.timed and table.timed
        self._channels = table.channels
        for key in np.unique(table.key).tolist():
            if key not in self._by_key:
                name = shown_id(key & ((1 << NODE_BITS) - 1))
                self._by_key[key] = Finger(name, self.start_ns, self._wanted, self._computed)
            self._by_key[key].add(table, np.flatnonzero(table.key == key))

    def named(self) -> list[tuple[str, Finger]]:
        """Return the fingers with titles, in the order of channels and node-ids."""
        several = len({key >> NODE_BITS for key in self._by_key}) > 1
        titled = []
        for key, finger in sorted(self._by_key.items()):
            channel = f"{self._channels[key >> NODE_BITS]} " if several else ""
            titled.append((f"{channel}node {finger.name}", finger))
        return titled
