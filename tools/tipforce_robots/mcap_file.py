"""Write MCAP for Foxglove and other readers: ROS 2 messages of each fingertip, a drawing, and the CAN frames.

The frames, as can_msgs/Frame, keep everything: each command of tipforce reads the file as the log that it was.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import mcap.writer
import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.arrays import occurring
from tipforce.host.decoding.sample_table import NODE_BITS, Table, Values
from tipforce.host.decoding.services import BusEvent
from tipforce.host.frames.frame_array import FrameArray
from tipforce.output_file import MCAP, NewFile
from tipforce.samples.columns import Block
from tipforce.samples.reasons import Status
from tipforce.samples.record import Samples
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce_robots.ros2 import cdr, scene_update
from tipforce_robots.ros2 import messages as diagnosing
from tipforce_robots.ros2.cdr import CONTACT, DIAGNOSTICS, FRAME, WRENCH, with_dependencies
from tipforce_robots.ros2.messages import TipMessages

_SECOND_NS = 1_000_000_000
_PICTURE_NS = _SECOND_NS // 30
_STALE_NS = _SECOND_NS // 2
_GAP_NS = _SECOND_NS
_PREFIX = "/tipforce"
_ID_MASK = np.uint32(~(ERROR_FLAG | EXTENDED_FLAG | REMOTE_FLAG) & 0xFFFFFFFF)


class _Tip:
    """One fingertip in the file."""

    def __init__(self, writer: McapWriter, name: str, node: int) -> None:
        plain = name.replace("/", "_")
        self.name = name
        self.messages = TipMessages(f"{plain}_tip", node, FABRICATED.r_m)
        self.diagnostics = diagnosing.TipDiagnostics(f"tipforce: {name}", node)
        self.wrench = writer.channel(f"{_PREFIX}/{name}/wrench", WRENCH)
        self.contact = writer.channel(f"{_PREFIX}/{name}/contact", CONTACT)


class McapWriter:
    """Topics as of `tipforce ros2`; stamps and log times are those of the samples' first frames, as in other files."""

    left_out = frozenset[str]()
    """Columns that are not in the file, as of ``StreamWriter``."""

    def __init__(self, path: Path, inputs: Iterable[str] = ()) -> None:
        """Raises InputError."""
        self._file = NewFile(path, MCAP, inputs)
        self._stream = self._file.partial.open("wb")
        self._writer = mcap.writer.Writer(self._stream)
        self._writer.start(profile="ros2", library="tipforce")
        self._tips: dict[int, _Tip] = {}
        self._frames: dict[str, tuple[int, cdr.Layout]] = {}
        self._sequence: dict[int, int] = {}
        self._newest: dict[int, tuple[Block, int]] = {}  # by key: samples, and the row of the newest
        self._picture_ns = self._last_ns = 0
        self._diagnostics = self.channel("/diagnostics", DIAGNOSTICS)
        schema = self._writer.register_schema(scene_update.SCHEMA_NAME, "jsonschema", scene_update.SCHEMA)
        self._scene = self._writer.register_channel(f"{_PREFIX}/scene", "json", schema)

    def channel(self, topic: str, kind: str) -> int:
        """Return a new channel of ROS 2 messages."""
        schema = self._writer.register_schema(kind, "ros2msg", with_dependencies(kind).encode())
        return int(self._writer.register_channel(topic, "cdr", schema))

    def frames(self, frames: FrameArray, channels: Sequence[str]) -> None:
        """Append CAN frames, FRAME (n,); ``channels`` are the interfaces by number."""
        messages: list[bytes] = [b""] * len(frames)
        places = np.zeros(len(frames), dtype=np.intp)
        for number in occurring(frames["channel"]):
            chosen = np.flatnonzero(frames["channel"] == number)
            places[chosen], layout = self._frame_channel(channels[number])
            for row, message in zip(chosen.tolist(), cdr.split(_frame_rows(frames[chosen], layout)), strict=True):
                messages[row] = message
        for place, t_ns, message in zip(places.tolist(), frames["t_ns"].tolist(), messages, strict=True):
            self._add(place, t_ns, message)

    def write(self, table: Table) -> None:
        """Append the samples of a table."""
        for chunk in _by_second(table):
            second = int(chunk.t_ns[0]) // _SECOND_NS
            if self._last_ns and second != self._last_ns // _SECOND_NS:
                self._report()
            samples: dict[int, Block] = {}
            for key in occurring(chunk.key):
                tip_samples, counter = samples_of(chunk.take(np.flatnonzero(chunk.key == key)))
                if len(tip_samples):
                    samples[key] = tip_samples
                    self._write_samples(self._tip(key, table.channels), tip_samples, counter)
            if samples:
                self._pictures(chunk, samples)
                self._last_ns = int(chunk.t_ns.max())

    def _write_samples(self, tip: _Tip, samples: Block, counter: npt.NDArray[np.int64]) -> None:
        tip.diagnostics.add(samples)
        for t_ns, message in zip(samples.t_ns.tolist(), tip.messages.contacts(samples, counter), strict=True):
            self._add(tip.contact, t_ns, message)
        known_ns, wrenches = tip.messages.wrenches(samples)
        for t_ns, message in zip(known_ns.tolist(), wrenches, strict=True):
            self._add(tip.wrench, t_ns, message)

    def close(self, events: Sequence[BusEvent]) -> None:
        """Append EMCYs and changes of NMT states, and complete the file."""
        for event in events:
            status = diagnosing.diagnostic(
                f"tipforce: finger_{event.node_id}", f"node {event.node_id}", diagnosing.level_of(event.kind),
                f"{event.kind.replace('_', ' ')}: {event.text}", {"event": event.kind, "channel": event.channel},
            )  # fmt: skip
            self._add(self._diagnostics, event.t_ns, diagnosing.array(event.t_ns, [status]))
        self._report()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()
        self._file.keep()

    def abort(self) -> None:
        """Remove the file."""
        with suppress(OSError):  # a full disk
            self._stream.close()
        self._file.drop()

    def _add(self, channel: int, t_ns: int, message: bytes) -> None:
        number = self._sequence[channel] = self._sequence.get(channel, -1) + 1
        self._writer.add_message(channel, t_ns, message, t_ns, number)

    def _tip(self, key: int, channels: Sequence[str]) -> _Tip:
        if key not in self._tips:
            node, bus = key & ((1 << NODE_BITS) - 1), key >> NODE_BITS
            name = f"{channels[bus]}/finger_{node}" if bus else f"finger_{node}"
            self._tips[key] = _Tip(self, name, node)
        return self._tips[key]

    def _frame_channel(self, name: str) -> tuple[int, cdr.Layout]:
        if name not in self._frames:
            channel = self.channel(f"/{name}/frames", FRAME)
            self._frames[name] = channel, cdr.Layout(FRAME, {"header.frame_id": name})
        return self._frames[name]

    def _pictures(self, chunk: Table, samples: Mapping[int, Block]) -> None:
        """Draw the state at every 30th of a second of a chunk."""
        first_ns, last_ns = int(chunk.t_ns.min()), int(chunk.t_ns.max())
        begin_ns = self._picture_ns if abs(first_ns - self._picture_ns) < _GAP_NS else first_ns
        times = np.arange(begin_ns, last_ns + 1, _PICTURE_NS)
        if self._picture_ns and first_ns - self._picture_ns >= _GAP_NS:  # in the gap the drawing shows no force
            times = np.append(self._picture_ns + _STALE_NS, times)
        place = {key: np.searchsorted(of.t_ns, times, side="right") - 1 for key, of in samples.items()}
        for number, t_ns in enumerate(times.tolist()):
            for key, of in samples.items():
                if place[key][number] >= 0:
                    self._newest[key] = of, int(place[key][number])
            shown = {self._tips[key].name: _shown(t_ns, *newest) for key, newest in self._newest.items()}
            self._add(self._scene, t_ns, scene_update.scene_update(t_ns, shown))
            self._picture_ns = t_ns + _PICTURE_NS
        self._newest.update({key: (of, -1) for key, of in samples.items()})

    def _report(self) -> None:
        """Write the diagnostics of the second that ends."""
        if self._tips:
            t_ns = self._last_ns
            status = [tip.diagnostics.status("") for tip in self._tips.values()]
            self._add(self._diagnostics, t_ns, diagnosing.array(t_ns, status))


def samples_of(table: Table) -> tuple[Block, npt.NDArray[np.int64]]:
    """Return the samples of one node and their counters, without rows that carry neither contact, force nor gauges."""
    bases = [column for column in table.columns if column.signal in {"P", "F1", "SG1"}]
    carried = np.zeros(len(table), dtype=np.bool_)
    for column in bases:
        absent = table.absent.get(column.name)
        carried |= True if absent is None else ~absent
    part = table.take(np.flatnonzero(carried))
    columns: dict[str, Values] = {}
    nowhere = np.zeros(1, dtype=np.bool_)
    for column in part.columns:
        if not part.absent.get(column.name, nowhere).all():  # else it is another node's
            columns[column.signal] = part.values[column.name]
    unknown = np.full(len(part), np.nan)
    if "P" in columns:  # the contact is what was sent or computed
        columns = {"phi": unknown, "theta": unknown} | columns
    samples = Samples(part.t_ns, part.node, part.counter, columns)
    u = np.stack([columns.get(f"u_{name}", unknown) for name in ("P", "phi", "theta")], axis=-1)
    return Block(part.t_ns, samples.contact, u, samples.gauges, samples.status), part.counter


def _shown(t_ns: int, samples: Block, row: int) -> tuple[tuple[float, float, float], int]:
    """Return what is drawn at a time: an old sample is no answer."""
    if t_ns - int(samples.t_ns[row]) > _STALE_NS:
        return (math.nan, math.nan, math.nan), int(Status.NO_ANSWER)
    P, phi, theta = samples.contact[row].tolist()
    return (P, phi, theta), int(samples.status[row])


def _by_second(table: Table) -> Iterator[Table]:
    seconds = table.t_ns // _SECOND_NS
    if not len(table) or seconds.min() == seconds.max():
        yield table
        return
    for second in np.unique(seconds).tolist():
        yield table.take(np.flatnonzero(seconds == second))


def _frame_rows(frames: FrameArray, layout: cdr.Layout) -> cdr.Rows:
    rows, can_id = layout.rows(len(frames)), frames["can_id"]
    cdr.set_stamps(rows, frames["t_ns"])
    rows["id"], rows["dlc"], rows["data"] = can_id & _ID_MASK, frames["length"], frames["data"]
    for name, flag in (("is_rtr", REMOTE_FLAG), ("is_extended", EXTENDED_FLAG), ("is_error", ERROR_FLAG)):
        rows[name] = can_id & np.uint32(flag) != 0
    return rows
