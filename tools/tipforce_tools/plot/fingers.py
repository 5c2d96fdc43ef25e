"""Fingers of a recording as traces in bounded memory (bins keep extremes): quantities with bands, flags, losses."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray
from tipforce.host.decoding.sample_table import NO_COUNTER, NODE_BITS, Column, Table
from tipforce_tools.cli.common import shown_id

COVERAGE = 2.0
"""Half width of a band in standard uncertainties: 95 %."""
_TURN = 360.0
_PERIODS = 5.0  # a pause of this many periods is a gap


class Line(NamedTuple):
    """A quantity at k times. ``y`` (5, k): mean, low, high, and the band, NaN where its uncertainty is unknown.
    ``starts`` (k,): preceded by a gap or an unknown value. Angles are unwrapped."""

    t_ns: IntArray
    y: FloatArray
    starts: BoolArray


class Trace:
    """Collects one quantity; an ``angle`` in degrees is unwrapped at the jump from 180 to -180."""

    def __init__(self, start_ns: int, *, angle: bool = False) -> None:
        self.unknown = 0
        self.banded = False
        self._angle = angle
        self._bins = Bins(
            start_ns,
            {
                "low": (np.minimum, np.inf), "high": (np.maximum, -np.inf), "total": (np.add, 0.0),
                "band_low": (np.minimum, np.inf), "band_high": (np.maximum, -np.inf),
                "key": (np.minimum, np.iinfo(np.int64).max),
            },
        )  # fmt: skip
        self._last: tuple[int, float] | None = None  # the last known value
        self._broken = True  # an unknown value has arrived since
        self._start_ns = start_ns
        self._period_ns = 0.0

    def add(self, t_ns: IntArray, values: FloatArray, uncertainty: FloatArray | None = None) -> None:
        """Add samples (k,), NaN for unknown, and their standard uncertainties (k,)."""
        known = np.flatnonzero(np.isfinite(values))
        self.unknown += len(values) - len(known)
        if len(t_ns) > 1:
            self._period_ns = float(np.median(np.diff(t_ns)))
        if not len(known):
            self._broken = self._broken or len(values) > 0
            return
        gap = np.diff(known, prepend=-1) > 1
        gap[0] |= self._broken
        self._broken = bool(known[-1] < len(values) - 1)
        t, x = t_ns[known], values[known]
        if self._period_ns > 0:
            gap |= np.diff(t, prepend=self._last[0] if self._last else t[0]) > _PERIODS * self._period_ns
        if self._angle:
            x = self._unwrapped(x, gap)
        self._last = int(t[-1]), float(x[-1])
        u = np.full(len(x), np.nan) if uncertainty is None else COVERAGE * uncertainty[known]
        finite = np.isfinite(u)
        self.banded = self.banded or bool(finite.any())
        low, high = np.where(finite, x - u, np.inf), np.where(finite, x + u, -np.inf)
        key = 2 * np.maximum(t - self._start_ns, 0) + ~gap  # the first of a bin, and whether a gap precedes it
        self._bins.add(t, low=x, high=x, total=x, band_low=low, band_high=high, key=key)

    def _unwrapped(self, x: FloatArray, gap: BoolArray) -> FloatArray:
        start = x[0] if self._last is None or gap[0] else self._last[1]
        x = np.asarray(np.unwrap(np.concatenate(([start], x)), period=_TURN)[1:])
        # After each gap it starts within -180..180 again.
        run = np.cumsum(gap)
        turns = np.where(gap, np.ceil((x - _TURN / 2) / _TURN), 0.0)
        first = np.concatenate(([0.0], turns[gap]))
        return np.asarray(x - _TURN * first[run])

    def line(self) -> Line | None:
        """Return the trace to draw; None without a known value."""
        bins = self._bins.filled()
        if not len(bins["count"]):
            return None
        band = np.stack((bins["band_low"], bins["band_high"]))
        y = np.stack(
            (bins["total"] / bins["count"], bins["low"], bins["high"], *np.where(np.isfinite(band), band, np.nan))
        )
        return Line(bins["first_ns"] // 2 + bins["last_ns"] // 2, y, bins["key"] % 2 == 0)


class Flags:
    """Collects the times of set flags: at most 63, by name."""

    def __init__(self, start_ns: int) -> None:
        self._bins = Bins(start_ns, {"set": (np.bitwise_or, 0)})
        self._names: list[str] = []

    def add(self, t_ns: IntArray, flags: Mapping[str, BoolArray]) -> None:
        """Add samples (k,) of flags."""
        bits = np.zeros(len(t_ns), dtype=np.int64)
        for name, is_set in flags.items():
            if name not in self._names:
                self._names.append(name)
            bits |= is_set.astype(np.int64) << self._names.index(name)
        self._bins.add(t_ns, set=bits)

    def bars(self) -> dict[str, list[tuple[int, int]]]:
        """Return by name, for flags that were set: start and end times in nanoseconds."""
        bins = self._bins.filled()
        first, last = bins["first_ns"], bins["last_ns"]
        usual_ns = (last[-1] - first[0]) / max(int(bins["count"].sum()) - 1, 1)
        # A flag holds until the next sample, unless that is late.
        until = np.append(first[1:], last[-1])
        until = np.where(until - last > np.maximum(_PERIODS * usual_ns, self._bins.width_ns), last, until)
        bars: dict[str, list[tuple[int, int]]] = {}
        for number, name in enumerate(self._names):
            is_set = (bins["set"] >> number & 1).astype(np.bool_)
            if not is_set.any():
                continue
            starts = np.flatnonzero(is_set & ~np.concatenate(([False], is_set[:-1] & (until[:-1] >= first[1:]))))
            bars[name] = []
            for start, end in zip(starts.tolist(), [*starts[1:].tolist(), len(is_set)], strict=True):
                inside = np.flatnonzero(is_set[start:end])
                bars[name].append((int(first[start]), int(until[start + inside[-1]])))
        return bars


class Lost:
    """Collects lost samples: times, and total number."""

    def __init__(self, start_ns: int) -> None:
        self.total = 0
        self._bins = Bins(start_ns, {"lost": (np.add, 0)})
        self._last: int | None = None

    def add(self, t_ns: IntArray, counter: IntArray) -> None:
        """Add the unwrapped counters (k,) of samples that follow SYNC."""
        if not len(counter):
            return
        missing = np.maximum(np.diff(counter, prepend=counter[0] if self._last is None else self._last) - 1, 0)
        self._last = int(counter[-1])
        there = missing > 0
        self.total += int(missing.sum())
        self._bins.add(t_ns[there], lost=missing[there])

    def times_ns(self) -> IntArray:
        """Return the time of the first sample after each loss; losses close together count as one."""
        return np.asarray(self._bins.filled()["first_ns"])


BINS = 4096
"""Several for each pixel of a wide panel."""
_FIRST_WIDTH_NS = 1000

Array = npt.NDArray[Any]
Reduced = Mapping[str, tuple[np.ufunc, Any]]  # by column: reduction of a bin, and value of an empty bin


class Bins:
    """Columns of samples from ``start_ns``, reduced per bin; bins grow by powers of two with time. ``count`` (BINS,):
    number of samples in each; ``first_ns``, ``last_ns``: their times."""

    def __init__(self, start_ns: int, columns: Reduced) -> None:
        self.start_ns = start_ns
        self.width_ns = _FIRST_WIDTH_NS
        last = np.iinfo(np.int64)
        times = {"first_ns": (np.minimum, last.max), "last_ns": (np.maximum, last.min)}
        self._how: dict[str, tuple[np.ufunc, Any]] = {**columns, "count": (np.add, 0), **times}
        self._columns = {name: np.full(BINS, empty) for name, (_, empty) in self._how.items()}

    def add(self, t_ns: IntArray, **columns: Array) -> None:
        """Add samples (k,) in time order; an earlier one gets the time of its predecessor."""
        if not len(t_ns):
            return
        place = np.maximum.accumulate(np.maximum(t_ns - self.start_ns, 0))
        while place[-1] // self.width_ns >= BINS:  # every two bins become one
            self.width_ns *= 2
            for name, (how, empty) in self._how.items():
                pairs = self._columns[name].reshape(-1, 2)
                self._columns[name] = np.concatenate((how(pairs[:, 0], pairs[:, 1]), np.full(BINS // 2, empty)))
        number = place // self.width_ns
        edges = np.concatenate(([0], np.flatnonzero(number[1:] != number[:-1]) + 1))
        chosen = number[edges]
        given = {**columns, "count": np.ones(len(t_ns), dtype=np.int64), "first_ns": t_ns, "last_ns": t_ns}
        for name, (how, _) in self._how.items():
            target = self._columns[name]
            target[chosen] = how(target[chosen], how.reduceat(given[name], edges))

    def filled(self) -> dict[str, Array]:
        """Return the columns of the non-empty bins."""
        there = self._columns["count"] > 0
        return {name: column[there] for name, column in self._columns.items()}


_UNCERTAINTY_OF = {"P": "u_P", "phi": "u_phi", "theta": "u_theta"}
_HELD_NS = 3_000_000_000  # validity of an uncertainty: TPDO4 is sent once a second
INVERTED = {"calibrated": "not calibrated"}
"""The flags whose absence is drawn as a bar."""


class Finger:
    """One node of one bus. ``traces`` and ``units`` by signal; ``computed`` ones are computed from its gauges."""

    def __init__(self, start_ns: int, wanted: Collection[str], computed: Collection[str]) -> None:
        self.traces: dict[str, Trace] = {}
        self.units: dict[str, str] = {}
        self.flags: dict[str, Flags] = {}
        self.lost = Lost(start_ns)
        self._start_ns = start_ns
        self._wanted = wanted
        self._computed = computed
        self._held: dict[str, tuple[int, float]] = {}

    def add(self, table: Table) -> None:
        """Add a table of this finger alone."""
        t_ns = table.t_ns
        columns = {column.signal: column for column in table.columns}
        flags: dict[str, tuple[BoolArray, BoolArray]] = {}
        steady = table.cyclic & (table.counter != NO_COUNTER)
        self.lost.add(t_ns[steady], table.counter[steady])
        for signal, column in columns.items():
            # The rows with the signal, known or not. A computed one needs its gauges.
            carrier = "SG1_ue" if signal in self._computed and "SG1_ue" in table.values else column.name
            there, values = ~table.absent.get(carrier, np.zeros(len(table), dtype=np.bool_)), table.values[column.name]
            if column.kind == "flag":
                there &= values >= 0
            if not there.any():
                continue
            if column.kind == "flag":
                flags[INVERTED.get(signal, signal)] = (values == 1) != (signal in INVERTED), there
            elif signal in self._wanted:
                if signal not in self.traces:
                    self.traces[signal] = Trace(self._start_ns, angle=column.angle and not signal.startswith("u_"))
                    self.units[signal] = column.unit
                u = self._uncertainty(table, columns, signal)
                self.traces[signal].add(t_ns[there], values.astype(np.float64)[there], None if u is None else u[there])
        for group in ("status", "health"):  # at different times: status with each sample, faults with TPDO4
            chosen = {name: both for name, both in flags.items() if (name in HATCHES) == (group == "status")}
            if chosen:
                kept = np.logical_or.reduce([there for _, there in chosen.values()])
                collected = self.flags.setdefault(group, Flags(self._start_ns))
                collected.add(t_ns[kept], {name: (is_set & there)[kept] for name, (is_set, there) in chosen.items()})

    def _uncertainty(self, table: Table, columns: dict[str, Column], signal: str) -> FloatArray | None:
        """Return the standard uncertainty at each row: its own, or the last one sent while it is valid."""
        name = _UNCERTAINTY_OF.get(signal, "")
        column = columns.get(name)
        if column is None and name not in self._held:
            return None
        own = np.full(len(table), np.nan) if column is None else table.values[column.name]
        if name in self._computed:
            return own
        at_ns, value = self._held.get(name, (0, np.nan))
        known = np.flatnonzero(np.isfinite(own))
        last = np.searchsorted(known, np.arange(len(table)), side="right")
        times = np.concatenate(([at_ns], table.t_ns[known]))[last]
        held = np.concatenate(([value], own[known]))[last]
        if len(known):
            self._held[name] = int(table.t_ns[known[-1]]), float(own[known[-1]])
        return np.where(table.t_ns - times <= _HELD_NS, held, np.nan)


HATCHES = {
    "contact": "", "not calibrated": "xx", "saturated": "//", "stale": "\\\\", "theta_unresolved": "..",
    "misses_tip": "++", "outside_pad": "oo", "fault": "xx", "beyond_first_order": "..",
}  # fmt: skip
"""By name of a flag of the status, in the order of the strip; others follow."""


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
                self._by_key[key] = Finger(self.start_ns, self._wanted, self._computed)
            self._by_key[key].add(table.take(np.flatnonzero(table.key == key)))

    def named(self) -> list[tuple[str, Finger]]:
        """Return the fingers with titles, in the order of channels and node-ids."""
        several = len({key >> NODE_BITS for key in self._by_key}) > 1
        return [
            (f"{f'{self._channels[key >> NODE_BITS]} ' * several}node {shown_id(key & ((1 << NODE_BITS) - 1))}", finger)
            for key, finger in sorted(self._by_key.items())
        ]
