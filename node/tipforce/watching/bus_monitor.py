"""State of the nodes on one bus: a state machine that processes frames and returns snapshots."""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from canopen_device.core import codes
from tipforce.arrays import IntArray, occurring
from tipforce.dictionary.service_texts import EMCY_CODES, NMT_STATES, state_text
from tipforce.dictionary.table import FAULT_BITS, STATUS_BITS
from tipforce.host.decoding.counters import SyncModulus, Tally
from tipforce.host.decoding.decoder import Decoder, Samples
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.host.decoding.health import Health
from tipforce.host.decoding.pdo_layout import EdsFiles, Layouts
from tipforce.host.decoding.service_frames import add_samples, find_duplicates
from tipforce.host.frames.frame_array import FrameArray, heartbeats_and_emcys
from tipforce.host.network.bus_load import LEAST_BITS, MOST_BITS, kinds
from tipforce.samples import reasons

STALE_NS = 500_000_000
"""A value is stale after this, or after three of its periods if that is longer."""
QUANTITIES = ("P", "phi", "theta")
FLAGS = (*(name for name, _ in STATUS_BITS), *(f"fault_{name}" for _, name, _ in FAULT_BITS))
WINDOW_NS = 2_000_000_000
_LEAST_NS = 100_000_000  # minimum time for a rate
MOST = 65_536  # events kept: a full bus for more than the window


@dataclass(frozen=True, slots=True)
class Periods:
    """Times between events in milliseconds: median, 99th percentile, maximum."""

    p50_ms: float
    p99_ms: float
    max_ms: float


class Window:
    """Times of events, and with each ``columns`` numbers, within WINDOW_NS before the newest of them."""

    def __init__(self, columns: int = 0) -> None:
        self._rows: IntArray = np.zeros((1 + columns, 0), dtype=np.int64)  # times, then the numbers

    def add(self, t_ns: IntArray, *numbers: IntArray) -> None:
        """Add events (k,) and their numbers (k,). A clock set back by more than the window restarts it."""
        if not len(t_ns):
            return
        before = self._rows if (self.last_ns or 0) <= t_ns[-1] + WINDOW_NS else self._rows[:, :0]
        rows = np.concatenate((before, np.stack((t_ns, *numbers))), axis=1)[:, -MOST:]
        self._rows = rows[:, rows[0] > t_ns[-1] - WINDOW_NS]

    @property
    def last_ns(self) -> int | None:
        """Time of the newest event."""
        return int(self._rows[0, -1]) if self._rows.size else None

    def rate_hz(self, now_ns: int) -> float:
        """Return events per second: from their periods while they continue, decreasing to 0 after they end."""
        recent = self._rows[0, self._rows[0] > now_ns - WINDOW_NS]
        if len(recent) < 2 or recent[-1] <= recent[0]:
            return 0.0
        span_ns, silence_ns = float(recent[-1] - recent[0]), now_ns - float(recent[-1])
        if silence_ns > 3.0 * span_ns / (len(recent) - 1):
            span_ns += silence_ns
        return (len(recent) - 1) * 1e9 / span_ns

    def periods(self) -> Periods | None:
        """Return the periods of the events; None for fewer than two. Times that step back slightly count as 0."""
        if self._rows.shape[1] < 2:
            return None
        periods = np.maximum(np.diff(self._rows[0]), 0) * 1e-6
        return Periods(*(float(value) for value in (*np.percentile(periods, (50, 99)), periods.max())))

    def sums(self, now_ns: int) -> list[float]:
        """Return the numbers per second, over the observed part of the window before ``now_ns``."""
        recent = self._rows[:, self._rows[0] > now_ns - WINDOW_NS]
        seen_ns = max(now_ns - int(recent[0, 0]), _LEAST_NS) if recent.size else _LEAST_NS
        return [float(row.sum()) * 1e9 / seen_ns for row in recent[1:]]


@dataclass(frozen=True, slots=True)
class Reading:
    """A quantity: its value, or None and the reason. ``stale``: not received for too long."""

    value: float | None
    unit: str
    reason: str = ""
    stale: bool = False


@dataclass(frozen=True, slots=True)
class Emergency:
    """The last EMCY of a node."""

    code: int
    register: int
    text: str
    age_s: float


@dataclass(frozen=True, slots=True)
class NodeView:
    """One row. ``age_s``: of the last sample. ``readings``: P, phi, theta; of a node with an EDS its TPDOs' signals."""

    node_id: int
    rate_hz: float
    periods: Periods | None
    age_s: float | None
    stale: bool
    readings: dict[str, Reading]
    status: tuple[str, ...]
    nmt: str
    nmt_lost: bool
    emergency: Emergency | None
    lost: int
    duplicate: str = ""
    """What shows that two nodes use this node-id, and what to do."""


@dataclass(frozen=True, slots=True)
class BusView:
    """A bus: frames and bits per second (minimum, maximum) and its nodes."""

    name: str
    frames_hz: float
    least_bits_hz: float
    worst_bits_hz: float
    sync_hz: float
    errors: int
    nodes: tuple[NodeView, ...]


class BusMonitor:
    """One bus. ``node_ids`` None monitors all nodes; only those that have sent frames get a row."""

    def __init__(
        self, name: str = "", gauges: int = 3, node_ids: Iterable[int] | None = None, eds: EdsFiles = ()
    ) -> None:
        """``eds``: nodes of other manufacturers. Raises InputError for a file that is no EDS."""
        self.name = name
        self._watched = frozenset(range(1, 128) if node_ids is None else node_ids)
        self._described = frozenset(node_id for node_id, _ in eds)
        self._decoder = Decoder(gauges, sorted(self._watched - self._described))
        self._of_eds = Layouts(nodes=tuple(self._watched), eds=eds).decoder() if eds else None
        self._tally = Tally()
        self._health = Health()
        self._modulus = SyncModulus()
        self._duplicates = DuplicateNodes()
        self._nodes: defaultdict[int, _Node] = defaultdict(_Node)
        self._traffic = Window(columns=3)
        self._sync = Window()
        self._errors = 0

    def feed(self, frames: FrameArray) -> None:
        """Process a FRAME array (k,) in the order of arrival."""
        can_id = frames["can_id"]
        error = (can_id & np.uint32(codes.ERROR_FLAG)) != 0
        self._errors += int(error.sum())
        kind = kinds(frames)
        self._traffic.add(frames["t_ns"][~error], np.ones_like(kind), LEAST_BITS[kind], MOST_BITS[kind])
        for duplicate in find_duplicates(self._duplicates, frames):
            if duplicate.node_id in self._watched:  # also one without heartbeats
                self._nodes.setdefault(duplicate.node_id, _Node())
        data = (can_id & np.uint32(codes.EXTENDED_FLAG | codes.REMOTE_FLAG | codes.ERROR_FLAG)) == 0
        self._sync.add(frames["t_ns"][data & (can_id == codes.SYNC_COB_ID)])
        self._take_services(frames)
        for part in self._modulus.parts(frames):
            decoded = self._decoder.decode(part)
            for (node_id, name), samples in decoded.items():
                self._tally.add_samples(samples, self._modulus.modulus)
                add_samples(self._duplicates, samples, part, self._modulus.modulus)
                self._nodes[node_id].take(name, samples)
            self._health.take(part, decoded.values())
        if self._of_eds is not None:
            for start, end in self._of_eds.parts(frames):
                for (node_id, name), samples in self._of_eds.decode(frames[start:end]).items():
                    if name.startswith("TPDO"):  # not what a master sends to the node
                        self._nodes[node_id].take(name, samples)

    def _take_services(self, frames: FrameArray) -> None:
        for row, function, node_id, data in heartbeats_and_emcys(frames):
            if node_id not in self._watched or (function == codes.HEARTBEAT_BASE and len(data) != 1):
                continue
            node, t_ns = self._nodes[node_id], int(frames["t_ns"][row])
            if function == codes.HEARTBEAT_BASE:
                node.nmt = data[0] & 0x7F
                node.heartbeats.add(np.array([t_ns]))
            elif len(data) >= 3:
                node.emergency = *struct.unpack_from("<HB", data), t_ns

    def view(self, now_ns: int) -> BusView:
        """Return the state at a time on the clock of the frames."""
        frames_hz, least, worst = self._traffic.sums(now_ns)
        lost = self._tally.lost()
        nodes = tuple(
            self._view(node_id, node, lost.get(("", node_id), 0), now_ns)
            for node_id, node in sorted(self._nodes.items())
        )
        return BusView(self.name, frames_hz, least, worst, self._sync.rate_hz(now_ns), self._errors, nodes)

    def _view(self, node_id: int, node: _Node, lost: int, now_ns: int) -> NodeView:
        periods, last_ns = node.samples.periods(), node.samples.last_ns
        age_s = None if last_ns is None else max(now_ns - last_ns, 0) * 1e-9
        limit_s = max(STALE_NS * 1e-9, 3e-3 * periods.p50_ms if periods else 0.0)
        flags = dict(node.flags)
        if node_id in self._health.nodes:
            faults, _ = self._health.now(node_id)
            flags |= {f"fault_{name}": bool(faults >> bit & 1) for bit, name, _ in FAULT_BITS}
        if node.values.get("P", (0.0,))[0] == reasons.LARGEST_NEWTONS:
            flags["fault_overload"] = True
        given = {"calibrated": True, "contact": True} | flags
        bits = sum(bit for name, bit in reasons.BITS.items() if given.get(name) == 1)
        names = tuple(node.values) if node_id in self._described else QUANTITIES
        emergency = None
        if node.emergency is not None:
            code, register, t_ns = node.emergency
            text = EMCY_CODES.get(code, EMCY_CODES.get(code & 0xFF00, "unknown code"))
            emergency = Emergency(code, register, text, max(now_ns - t_ns, 0) * 1e-9)
        return NodeView(
            node_id, node.samples.rate_hz(now_ns), periods, age_s, age_s is not None and age_s > limit_s,
            {name: node.reading(name, bits, now_ns, limit_s) for name in names},
            tuple(name.removeprefix("fault_") for name in FLAGS if flags.get(name)),
            *node.nmt_state(now_ns), emergency, lost, str(self._duplicates.found.get(node_id, "")),
        )  # fmt: skip


@dataclass(slots=True)
class _Node:
    samples: Window = field(default_factory=Window)
    values: dict[str, tuple[float, str, int]] = field(default_factory=dict)  # by signal: value, unit, time
    flags: dict[str, bool] = field(default_factory=dict)
    source: str = ""  # the message that the samples are counted by
    nmt: int | None = None
    heartbeats: Window = field(default_factory=Window)
    emergency: tuple[int, int, int] | None = None  # code, register, time

    def take(self, name: str, samples: Samples) -> None:
        """Keep the last values of a message."""
        t_ns = int(samples.t_ns[-1])
        for signal in samples.message.signals:
            last = samples.columns[signal.name][-1]
            if signal.name in FLAGS:
                self.flags[signal.name] = bool(last)
            else:
                self.values[signal.name] = float(last), signal.unit, t_ns
        # Samples are counted by one message: that of the contact, as soon as it is received.
        better = "P" in samples.columns and samples.message.transmission_type <= 240
        if not self.source or (better and self.source != name and "P" not in self.source):
            self.source, self.samples = name, Window()
        if name == self.source:
            self.samples.add(samples.t_ns)

    def reading(self, name: str, status: int, now_ns: int, limit_s: float) -> Reading:
        """Return a value, or why there is none."""
        if name not in self.values:
            return Reading(None, "", "not sent")
        value, unit, t_ns = self.values[name]
        if (now_ns - t_ns) * 1e-9 > limit_s:
            return Reading(None, unit, f"last {max(now_ns - t_ns, 0) * 1e-9:.1f} s ago", stale=True)
        if not np.isnan(value):
            return Reading(value, unit)
        why = reasons.why_no_force(status)
        if not why and name in QUANTITIES[1:]:
            why = [reasons.why_no_angle(status, theta=name == "theta")]
        return Reading(None, unit, next(filter(None, why), reasons.UNKNOWN_TO_THE_NODE))

    def nmt_state(self, now_ns: int) -> tuple[str, bool]:
        """Return the NMT state, and whether the heartbeat has been missing for three of its periods. A boot-up message
        shows no lasting state: the node leaves it at once, and only a heartbeat shows the next."""
        last_ns = self.heartbeats.last_ns
        if self.nmt is None or last_ns is None:
            return "", False
        if self.nmt == codes.INITIALISING:
            later = (self.samples.last_ns or last_ns) > last_ns or now_ns - last_ns > STALE_NS
            return f"{NMT_STATES[codes.INITIALISING]}{', no heartbeat' if later else ''}", False
        periods = self.heartbeats.periods()
        limit_ns = 3e6 * periods.p50_ms if periods else 3e9
        return state_text(self.nmt), now_ns - last_ns > max(limit_ns, STALE_NS)


class Monitor:
    """All buses of a source by interface name."""

    def __init__(self, gauges: int = 3, node_ids: Iterable[int] | None = None, eds: EdsFiles = ()) -> None:
        self._options = gauges, None if node_ids is None else tuple(node_ids), eds
        self._buses: dict[str, BusMonitor] = {}
        self.newest_ns: int | None = None
        self.frames = 0

    def feed(self, frames: FrameArray, names: Iterable[str]) -> None:
        """Process a FRAME array (k,) whose ``channel`` indexes ``names``."""
        if not len(frames):
            return
        self.frames += len(frames)
        self.newest_ns = int(frames["t_ns"][-1])
        known, channel = list(names), frames["channel"]
        for number in occurring(channel):
            name = known[number] if number < len(known) else ""
            if name not in self._buses:
                self._buses[name] = BusMonitor(name, *self._options)
            self._buses[name].feed(frames.compress(channel == number))

    def views(self, now_ns: int | None = None) -> tuple[BusView, ...]:
        """Return all buses at a time (None: that of the newest frame)."""
        now = self.newest_ns if now_ns is None else now_ns
        return () if now is None else tuple(bus.view(now) for bus in self._buses.values())
