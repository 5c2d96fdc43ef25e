"""State of the nodes on one bus: a state machine that processes frames and returns snapshots."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import (
    EMCY_BASE,
    ERROR_FLAG,
    EXTENDED_FLAG,
    FUNCTION_MASK,
    HEARTBEAT_BASE,
    INITIALISING,
    NODE_ID_MASK,
    REMOTE_FLAG,
    SYNC_COB_ID,
)
from tipforce.dictionary.dbc import EMCY_CODES, NMT_STATES
from tipforce.dictionary.table import FAULT_BITS, STATUS_BITS
from tipforce.host.decoding import status_words
from tipforce.host.decoding.contacts import status_of
from tipforce.host.decoding.decoded_pdos import EdsFiles, Layouts
from tipforce.host.decoding.decoder import Decoder, Samples
from tipforce.host.decoding.duplicates import DuplicateNodes
from tipforce.host.decoding.health import Health
from tipforce.host.decoding.sample_counter import SampleCounters
from tipforce.host.decoding.sync_modulus import SyncModulus
from tipforce.host.frames.frame_array import FrameArray
from tipforce_tools.monitor.window import Periods, Window

STALE_NS = 500_000_000
"""A value is stale after this, or after three of its periods if that is longer."""
QUANTITIES = ("P", "phi", "theta")
FLAGS = (*(name for name, _ in STATUS_BITS), *(f"fault_{name}" for _, name, _ in FAULT_BITS))

# The number of stuff bits depends on the data: at least none, at most one in four (ISO 11898-1).
_LEAST_BITS = np.array([[47 + 8 * n for n in range(9)], [67 + 8 * n for n in range(9)]])
_WORST_BITS = _LEAST_BITS + np.array([[(33 + 8 * n) // 4 for n in range(9)], [(53 + 8 * n) // 4 for n in range(9)]])


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
    """One row. ``age_s``: age of the last sample, None without one.

    ``readings``: P, phi and theta; of a node with an EDS the signals of its TPDOs.
    """

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


@dataclass(slots=True)
class _Node:
    samples: Window = field(default_factory=Window)
    values: dict[str, tuple[float, str, int]] = field(default_factory=dict)  # by signal: value, unit, time
    flags: dict[str, bool] = field(default_factory=dict)
    source: str = ""  # the message that the samples are counted by
    nmt: int | None = None
    heartbeats: Window = field(default_factory=Window)
    emergency: tuple[int, int, int] | None = None  # code, register, time


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
        self._counters = SampleCounters()
        self._health = Health()
        self._modulus = SyncModulus()
        self._duplicates = DuplicateNodes()
        self._nodes: dict[int, _Node] = {}
        self._traffic = Window(columns=3)
        self._sync = Window()
        self._errors = 0

    def feed(self, frames: FrameArray) -> None:
        """Process a FRAME array (k,) in the order of arrival."""
        can_id, t_ns = frames["can_id"], frames["t_ns"]
        self._count_traffic(frames)
        self._take_duplicates(frames)
        data = (can_id & np.uint32(EXTENDED_FLAG | REMOTE_FLAG | ERROR_FLAG)) == 0
        self._sync.add(t_ns[data & (can_id == SYNC_COB_ID)])
        self._take_services(frames[data & ((can_id & NODE_ID_MASK) != 0)])
        for part in self._modulus.parts(frames):
            found = self._decoder.decode(part)
            self._counters.add(found, self._modulus.modulus)
            for samples in found.values():
                self._duplicates.samples(samples, part, self._modulus.modulus)
            for (node_id, name), samples in found.items():
                self._take_samples(self._nodes.setdefault(node_id, _Node()), name, samples)
            self._health.take(part, found.values())
        if self._of_eds is not None:
            for start, end in self._of_eds.parts(frames):
                for (node_id, name), samples in self._of_eds.decode(frames[start:end]).items():
                    if name.startswith("TPDO"):  # not what a master sends to the node
                        self._take_samples(self._nodes.setdefault(node_id, _Node()), name, samples)
        for node_id in self._health.nodes:
            if node_id in self._nodes:
                faults, _ = self._health.now(node_id)
                flags = {f"fault_{name}": bool(faults >> bit & 1) for bit, name, _ in FAULT_BITS}
                self._nodes[node_id].flags |= flags

    def _take_duplicates(self, frames: FrameArray) -> None:
        """Give a row to a node-id that two nodes use, also to one that sends no heartbeats."""
        for duplicate in self._duplicates.add(frames):
            if duplicate.node_id in self._watched:
                self._nodes.setdefault(duplicate.node_id, _Node())

    def _count_traffic(self, frames: FrameArray) -> None:
        can_id = frames["can_id"]
        error = (can_id & np.uint32(ERROR_FLAG)) != 0
        self._errors += int(error.sum())
        frames, can_id = frames[~error], can_id[~error]
        extended = (can_id >> np.uint32(31)).astype(np.intp)
        length = np.where(can_id & np.uint32(REMOTE_FLAG), 0, np.minimum(frames["length"], 8))
        ones = np.ones(len(frames), dtype=np.int64)
        self._traffic.add(frames["t_ns"], ones, _LEAST_BITS[extended, length], _WORST_BITS[extended, length])

    def _take_services(self, frames: FrameArray) -> None:
        """Process heartbeats and EMCY, of which there are few."""
        function = frames["can_id"] & FUNCTION_MASK
        chosen = frames[((function == HEARTBEAT_BASE) | (function == EMCY_BASE)) & (frames["length"] > 0)]
        for frame in chosen:
            node_id = int(frame["can_id"]) & NODE_ID_MASK
            if node_id not in self._watched:
                continue
            node, t_ns = self._nodes.setdefault(node_id, _Node()), int(frame["t_ns"])
            if int(frame["can_id"]) & FUNCTION_MASK == HEARTBEAT_BASE:
                node.nmt = int(frame["data"][0]) & 0x7F
                node.heartbeats.add(np.array([t_ns]))
            elif frame["length"] >= 3:
                code, register = struct.unpack_from("<HB", frame["data"].tobytes())
                node.emergency = code, register, t_ns

    def _take_samples(self, node: _Node, name: str, samples: Samples) -> None:
        t_ns = int(samples.t_ns[-1])
        for signal in samples.message.signals:
            last = samples.columns[signal.name][-1]
            if signal.name in FLAGS:
                node.flags[signal.name] = bool(last)
            else:
                node.values[signal.name] = float(last), signal.unit, t_ns
        # Samples are counted by one message: that of the contact, as soon as it is received.
        better = "P" in samples.columns and samples.message.transmission_type <= 240
        if not node.source or (better and node.source != name and "P" not in node.source):
            node.source = name
            node.samples.clear()
        if name == node.source:
            node.samples.add(samples.t_ns)

    def view(self, now_ns: int) -> BusView:
        """Return the state at a time on the clock of the frames."""
        frames_hz, least, worst = self._traffic.sums(now_ns)
        lost = self._counters.lost_by_node()
        nodes = tuple(
            replace(
                _view(key, self._nodes[key], lost.get(key, 0), now_ns, described=key in self._described),
                duplicate=str(self._duplicates.found.get(key, "")),
            )
            for key in sorted(self._nodes)
        )
        return BusView(self.name, frames_hz, least, worst, self._sync.rate_hz(now_ns), self._errors, nodes)


def _view(node_id: int, node: _Node, lost: int, now_ns: int, *, described: bool) -> NodeView:
    periods, last_ns = node.samples.periods(), node.samples.last_ns
    age_s = None if last_ns is None else max(now_ns - last_ns, 0) * 1e-9
    limit_s = max(STALE_NS * 1e-9, 3e-3 * periods.p50_ms if periods else 0.0)
    stale = age_s is not None and age_s > limit_s
    told = {"calibrated": True, "contact": True} | node.flags
    bits = int(status_of({name: np.array(is_set) for name, is_set in told.items()}, ()))
    names = tuple(node.values) if described else QUANTITIES
    readings = {name: _reading(node, name, bits, now_ns, limit_s) for name in names}
    status = tuple(name.removeprefix("fault_") for name in FLAGS if node.flags.get(name))
    emergency = None
    if node.emergency is not None:
        code, register, t_ns = node.emergency
        text = EMCY_CODES.get(code, EMCY_CODES.get(code & 0xFF00, "unknown code"))
        emergency = Emergency(code, register, text, max(now_ns - t_ns, 0) * 1e-9)
    return NodeView(
        node_id, node.samples.rate_hz(now_ns), periods, age_s, stale, readings, status,
        *_nmt(node, now_ns), emergency, lost,
    )  # fmt: skip


def _reading(node: _Node, name: str, status: int, now_ns: int, limit_s: float) -> Reading:
    if name not in node.values:
        return Reading(None, "", "not sent")
    value, unit, t_ns = node.values[name]
    if (now_ns - t_ns) * 1e-9 > limit_s:
        return Reading(None, unit, f"last {max(now_ns - t_ns, 0) * 1e-9:.1f} s ago", stale=True)
    if not np.isnan(value):
        return Reading(value, unit)
    reasons = status_words.why_no_force(status)
    if not reasons and name in QUANTITIES[1:]:
        reasons = [status_words.why_no_angle(status, theta=name == "theta")]
    return Reading(None, unit, next(filter(None, reasons), status_words.UNKNOWN_TO_THE_NODE))


def _nmt(node: _Node, now_ns: int) -> tuple[str, bool]:
    """Return the NMT state, and whether the heartbeat has been missing for three of its periods.

    A boot-up message does not show a lasting state: the node leaves it at once, and only a heartbeat shows the next.
    """
    last_ns = node.heartbeats.last_ns
    if node.nmt is None or last_ns is None:
        return "", False
    if node.nmt == INITIALISING:
        later = (node.samples.last_ns or last_ns) > last_ns or now_ns - last_ns > STALE_NS
        return f"{NMT_STATES[INITIALISING]}, no heartbeat" if later else NMT_STATES[INITIALISING], False
    periods = node.heartbeats.periods()
    limit_ns = 3e6 * periods.p50_ms if periods else 3e9
    return NMT_STATES.get(node.nmt, f"state {node.nmt}"), now_ns - last_ns > max(limit_ns, STALE_NS)


class Monitor:
    """All buses of a source by interface name."""

    def __init__(self, gauges: int = 3, node_ids: Iterable[int] | None = None, eds: EdsFiles = ()) -> None:
        self._gauges, self._eds = gauges, eds
        self._node_ids = None if node_ids is None else tuple(node_ids)
        self._buses: dict[str, BusMonitor] = {}
        self.newest_ns: int | None = None
        self.frames = 0

    def feed(self, frames: FrameArray, names: Iterable[str]) -> None:
        """Process a FRAME array (k,) whose ``channel`` indexes ``names``."""
        if not len(frames):
            return
        self.frames += len(frames)
        self.newest_ns = int(frames["t_ns"][-1])
        known = list(names)
        channel: npt.NDArray[np.uint8] = frames["channel"]
        for number in np.unique(channel).tolist():
            name = known[number] if number < len(known) else ""
            if name not in self._buses:
                self._buses[name] = BusMonitor(name, self._gauges, self._node_ids, self._eds)
            self._buses[name].feed(frames[channel == number])

    def views(self, now_ns: int | None = None) -> tuple[BusView, ...]:
        """Return all buses at a time (None: that of the newest frame)."""
        now = self.newest_ns if now_ns is None else now_ns
        return () if now is None else tuple(bus.view(now) for bus in self._buses.values())
