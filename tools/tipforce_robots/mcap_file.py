"""Write MCAP for Foxglove and other readers: ROS 2 messages of each fingertip, a drawing, and the CAN frames. The
frames, as can_msgs/Frame, keep everything: each command of tipforce reads the file as the log that it was."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import mcap.writer
import msgspec
import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.arrays import occurring
from tipforce.errors import InputError
from tipforce.host.decoding.sample_table import NODE_BITS, Table, Values
from tipforce.host.decoding.services import BusEvent
from tipforce.host.frames.frame_array import FrameArray
from tipforce.samples import reasons
from tipforce.samples.columns import Block
from tipforce.samples.reasons import Status
from tipforce.samples.record import JoinedSamples
from tipforce.sensor.structure.strain import FABRICATED
from tipforce_robots.ros2 import bridge, cdr

_SECOND_NS = 1_000_000_000
_PICTURE_NS = _SECOND_NS // 30
_STALE_NS = _SECOND_NS // 2
_GAP_NS = _SECOND_NS
_PREFIX = "/tipforce"
_ID_MASK = np.uint32(~(ERROR_FLAG | EXTENDED_FLAG | REMOTE_FLAG) & 0xFFFFFFFF)


class McapWriter:
    """Topics as of `tipforce ros2`; stamps and log times are those of the samples' first frames, as in other files."""

    def __init__(self, stream: BinaryIO) -> None:
        self._writer = mcap.writer.Writer(stream)
        self._writer.start(profile="ros2", library="tipforce")
        self._tips: dict[int, tuple[str, bridge.Tip, dict[str, int]]] = {}  # by key; channels by kind
        self._frames: dict[str, tuple[int, cdr.Layout]] = {}
        self._sequence: dict[int, int] = {}
        self._newest: dict[int, tuple[Block, int]] = {}  # by key: samples, and the row of the newest
        self._picture_ns = self._last_ns = 0
        self._diagnostics = self.channel("/diagnostics", cdr.DIAGNOSTICS)
        example = {"entities": [_entity(0, 0, "", (1.0, 0.0, 0.0), 0)]}  # has all fields of SceneUpdate that are used
        content = json.dumps({"title": _SCENE, **_schema(example)}).encode()
        schema = self._writer.register_schema(_SCENE, "jsonschema", content)
        self._scene = self._writer.register_channel(f"{_PREFIX}/scene", "json", schema)

    def channel(self, topic: str, kind: str) -> int:
        """Return a new channel of ROS 2 messages."""
        schema = self._writer.register_schema(kind, "ros2msg", cdr.with_dependencies(kind).encode())
        return int(self._writer.register_channel(topic, "cdr", schema))

    def frames(self, frames: FrameArray, channels: Sequence[str]) -> None:
        """Append CAN frames, FRAME (n,); ``channels`` are the interfaces by number."""
        messages: list[bytes] = [b""] * len(frames)
        places = np.zeros(len(frames), dtype=np.intp)
        for number in occurring(frames["channel"]):
            chosen, name = np.flatnonzero(frames["channel"] == number), channels[number]
            if name not in self._frames:
                layout = cdr.Layout(cdr.FRAME, {"header.frame_id": name})
                self._frames[name] = self.channel(f"/{name}/frames", cdr.FRAME), layout
            places[chosen], layout = self._frames[name]
            rows, some = layout.rows(len(chosen)), frames.take(chosen)
            cdr.set_stamps(rows, some["t_ns"])
            rows["id"], rows["dlc"], rows["data"] = some["can_id"] & _ID_MASK, some["length"], some["data"]
            for flag_name, flag in (("is_rtr", REMOTE_FLAG), ("is_extended", EXTENDED_FLAG), ("is_error", ERROR_FLAG)):
                rows[flag_name] = some["can_id"] & np.uint32(flag) != 0
            for row, message in zip(chosen.tolist(), cdr.split(rows), strict=True):
                messages[row] = message
        for place, t_ns, message in zip(places.tolist(), frames["t_ns"].tolist(), messages, strict=True):
            self._add(place, t_ns, message)

    def write(self, table: Table) -> None:
        """Append the samples of a table. Raises InputError for a log without timestamps."""
        if not table.timed:
            raise InputError("no timestamps, which MCAP needs; candump -L writes them")
        seconds = table.t_ns // _SECOND_NS
        for second in np.unique(seconds).tolist():
            chunk = table.take(np.flatnonzero(seconds == second))
            if self._last_ns and second != self._last_ns // _SECOND_NS:
                self._report()
            samples: dict[int, Block] = {}
            for key in occurring(chunk.key):
                tip_samples, counter = samples_of(chunk.take(np.flatnonzero(chunk.key == key)))
                if len(tip_samples):
                    samples[key] = tip_samples
                    _name, tip, channel = self._tip(key, table.channels)
                    for kind, t_ns, message in tip.messages(tip_samples, counter):
                        self._add(channel[kind], t_ns, message)
            if samples:
                self._pictures(chunk, samples)
                self._last_ns = int(chunk.t_ns.max())

    def close(self, events: Sequence[BusEvent]) -> None:
        """Append EMCYs and changes of NMT states, and complete the file."""
        for event in events:
            name, node = f"tipforce: finger_{event.node_id}", f"node {event.node_id}"
            status = bridge.of_event(name, node, event, channel=event.channel)
            self._add(self._diagnostics, event.t_ns, bridge.array(event.t_ns, [status]))
        self._report()
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _add(self, channel: int, t_ns: int, message: bytes) -> None:
        number = self._sequence[channel] = self._sequence.get(channel, -1) + 1
        self._writer.add_message(channel, t_ns, message, t_ns, number)

    def _tip(self, key: int, channels: Sequence[str]) -> tuple[str, bridge.Tip, dict[str, int]]:
        if key not in self._tips:
            node, bus = key & ((1 << NODE_BITS) - 1), key >> NODE_BITS
            name = f"{channels[bus]}/finger_{node}" if bus else f"finger_{node}"
            tip = bridge.Tip(f"tipforce: {name}", node, f"{name.replace('/', '_')}_tip", FABRICATED.r_m)
            topics = {cdr.WRENCH: f"{_PREFIX}/{name}/wrench", cdr.CONTACT: f"{_PREFIX}/{name}/contact"}
            self._tips[key] = name, tip, {kind: self.channel(topic, kind) for kind, topic in topics.items()}
        return self._tips[key]

    def _pictures(self, chunk: Table, samples: Mapping[int, Block]) -> None:
        """Draw the state every 30th of a second, side by side: a recording does not say where fingers are mounted."""
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
            entities = [
                _entity(t_ns, number, self._tips[key][0], *_shown(t_ns, *newest))
                for number, (key, newest) in enumerate(self._newest.items())
            ]
            self._add(self._scene, t_ns, msgspec.json.encode({"entities": entities}))
            self._picture_ns = t_ns + _PICTURE_NS
        self._newest.update({key: (of, -1) for key, of in samples.items()})

    def _report(self) -> None:
        if self._tips:
            status = [tip.status("") for _, tip, _ in self._tips.values()]
            self._add(self._diagnostics, self._last_ns, bridge.array(self._last_ns, status))


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
    samples = JoinedSamples(part.t_ns, part.node, part.counter, columns)
    u = np.stack([columns.get(f"u_{name}", unknown) for name in ("P", "phi", "theta")], axis=-1)
    return Block(part.t_ns, samples.contact, u, samples.gauges, samples.status), part.counter


def _shown(t_ns: int, samples: Block, row: int) -> tuple[tuple[float, float, float], int]:
    """Return what is drawn at a time: an old sample is no answer."""
    if t_ns - int(samples.t_ns[row]) > _STALE_NS:
        return (math.nan, math.nan, math.nan), int(Status.NO_ANSWER)
    P, phi, theta = samples.contact[row].tolist()
    return (P, phi, theta), int(samples.status[row])


_SCENE = "foxglove.SceneUpdate"
_METRES_PER_NEWTON = 0.005
_SPACING_M = 0.06
_ARC = np.linspace(0.0, math.pi, 33)
_OUTLINE = [
    {"x": x, "y": y, "z": 0.0}
    for x, y in (
        *zip((FABRICATED.r_m * np.cos(_ARC)).tolist(), (FABRICATED.r_m * np.sin(_ARC)).tolist(), strict=True),
        (FABRICATED.r_m, 0.0), (0.0, 0.0), (0.0, -FABRICATED.d_m),
    )
]  # fmt: skip
"""The half circle of the tip, the horizontal beam below it, and the vertical beam, in one line."""
_GREY, _FORCE = {"r": 0.4, "g": 0.45, "b": 0.5, "a": 1.0}, {"r": 0.85, "g": 0.2, "b": 0.1, "a": 1.0}


def _entity(t_ns: int, number: int, name: str, contact: tuple[float, float, float], status: int) -> dict[str, Any]:
    x_m = number * _SPACING_M
    time = cdr.stamp(t_ns)
    known, text = all(map(math.isfinite, contact)), f"{contact[0]:.2f} N"
    if math.isnan(contact[0]):
        text = reasons.why(status, force_known=False, angles_known=False)
    elif not known:
        text = f"{text}, {reasons.why_no_angle(status) or 'no angle'}"
    return {
        "timestamp": {"sec": time["sec"], "nsec": time["nanosec"]}, "frame_id": "tipforce", "id": name,
        "lifetime": {"sec": 0, "nsec": 0}, "frame_locked": False,
        "lines": [{
            "type": 0, "pose": _pose(x_m, 0.0), "thickness": 0.0006, "scale_invariant": False,
            "points": _OUTLINE, "color": _GREY,
        }],
        "arrows": [_arrow(x_m, contact)] if known and contact[0] > 0.0 else [],
        "texts": [{
            "pose": _pose(x_m, -FABRICATED.d_m - 0.008), "billboard": True, "font_size": 0.005,
            "scale_invariant": False, "color": _GREY, "text": f"{name}: {text}",
        }],
    }  # fmt: skip


def _schema(example: Any) -> dict[str, Any]:
    if isinstance(example, dict):
        return {"type": "object", "properties": {name: _schema(value) for name, value in example.items()}}
    if isinstance(example, list):
        return {"type": "array", "items": _schema(example[0])}
    names = {bool: "boolean", int: "integer", float: "number", str: "string"}
    return {"type": names[type(example)]}


def _arrow(x_m: float, contact: tuple[float, float, float]) -> dict[str, Any]:
    """Return the force at its place: a push ends there, a pull begins there."""
    P, phi, theta = contact[0], *map(math.radians, contact[1:])
    length_m = _METRES_PER_NEWTON * P
    back_m = length_m if math.cos(phi - theta) < 0.0 else 0.0
    x = FABRICATED.r_m * math.cos(theta) - back_m * math.cos(phi)
    y = FABRICATED.r_m * math.sin(theta) - back_m * math.sin(phi)
    head_m = min(0.004, 0.5 * length_m)
    return {
        "pose": _pose(x_m + x, y, phi), "shaft_length": length_m - head_m, "shaft_diameter": 0.0012,
        "head_length": head_m, "head_diameter": 0.003, "color": _FORCE,
    }  # fmt: skip


def _pose(x_m: float, y_m: float, turn_rad: float = 0.0) -> dict[str, Any]:
    orientation = {"x": 0.0, "y": 0.0, "z": math.sin(0.5 * turn_rad), "w": math.cos(0.5 * turn_rad)}
    return {"position": {"x": x_m, "y": y_m, "z": 0.0}, "orientation": orientation}
