"""Sources of a page: a feed of live rows, a log whose rows all stay in memory, a scene that is run."""

from __future__ import annotations

import tempfile
import time
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from msgspec.structs import replace

from canopen_device.core.codes import RPDO_BASES, STANDARD_MASK, SYNC_COB_ID, TPDO_BASES
from tipforce.errors import InputError, LogError, RefusedError, TipforceError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.logs.reader import open_log
from tipforce.host.network.bus_load import range_of_bits
from tipforce.watching.feeds import Feed
from tipforce.watching.fingers import Finger, FingerMaker, with_layout
from tipforce.watching.watcher import Watcher
from tipforce_tools.view.history import MAX_BYTES, row_bytes
from tipforce_tools.view.model import Model

if TYPE_CHECKING:
    from tipforce.scene.schema import Scene

LOG_BYTES = 8 * MAX_BYTES
"""Memory limit of a log's rows; of a longer log the user must choose a part."""
LISTENING = "this page only listens to the bus"
_NO_FRAMES: FrameArray = np.zeros(0, dtype=FRAME)


class Source(Protocol):
    """Fills a model. One thread calls ``pump`` about 30 times a second."""

    model: Model
    title: str
    no_tare: str
    """Why tare is not available; empty if it is."""

    def pump(self) -> None:
        """Move received data into the model."""

    def tare(self, node_id: int) -> str:
        """Set the present force of a finger as zero; return the message to show. Raises TipforceError."""

    def close(self) -> None:
        """Release the source."""


class LiveSource:
    """Rows of a feed, which it closes."""

    def __init__(self, feed: Feed, title: str, gauges: int = 3, no_tare: str = "") -> None:
        self.title, self.no_tare, self.feed = title, no_tare, feed
        self.model = Model(feed.fingers, gauges)
        self.close = feed.close

    def pump(self) -> None:
        """See Source."""
        model = self.model
        try:
            blocks, events = self.feed.take(0.0)
        except TipforceError as error:
            if not model.error:
                model.add_event(time.time_ns(), 0, "bus_down", str(error))
            model.error = f"reception has ended: {error}"
            blocks, events = [], []
        fingers = tuple(self.feed.fingers)
        if fingers != model.fingers:
            model.set_fingers(fingers)
        for block in blocks:
            model.add(block, self.feed.arrived_s)
        for event in events:
            model.add_event(time.time_ns(), event.node_id, event.kind, event.text)
        model.counters = self.feed.counters()
        model.nmt = [self.feed.state(finger.node_id) for finger in fingers]

    def tare(self, node_id: int) -> str:
        """See Source."""
        return self.feed.tare(node_id)


class LogSource:
    """A log; all its rows stay in memory."""

    def __init__(
        self, path: Path, make_finger: FingerMaker, gauges: int = 3,
        fingers: Sequence[Finger] = (), start_s: float = 0.0, end_s: float | None = None,
    ) -> None:  # fmt: skip
        """``start_s``, ``end_s``: the part to read, seconds from the log's first frame. Raises InputError."""
        self.title, self.no_tare, self._path = path.name, "a log can't be tared", path
        self._watcher = Watcher(make_finger, gauges, fingers)
        self._limits: tuple[int | None, int | None] = (None, None)
        seconds = self._discover(start_s, end_s)
        fingers_sent = self._watcher.fingers
        if not fingers_sent:
            raise LogError(f"{path}: no PDO of a fingertip (0x180, 0x280 or 0x380 + node-id, with 8 bytes)")
        capacity = self._count_rows(LOG_BYTES // (2 * row_bytes(len(fingers_sent), gauges)))
        self.model = Model(fingers_sent, gauges, live=False, capacity=capacity)
        low, high = self._read()
        counters = self.model.counters
        if not counters.rows:
            raise InputError(f"{path}: no sample between --from and --to; the log lasts {seconds:g} s")
        counters.take_tally(self._watcher.tally())
        start, end = self.model.span_ns()
        bits = 1_000_000 * max((end - start) * 1e-9, 1e-9)
        counters.load = low / bits, high / bits

    def _discover(self, start_s: float, end_s: float | None) -> float:
        """Find the fingers and set the limits of the part to read; return the length of the log in seconds."""
        first: int | None = None
        seconds = 0.0
        with open_log(self._path) as log:
            for frames in log:
                if first is None:
                    first = int(frames["t_ns"][0])
                    start = first + round(start_s * 1e9) if start_s else None
                    self._limits = start, first + round(end_s * 1e9) if end_s is not None else None
                self._watcher.discover(frames)
                seconds = (int(frames["t_ns"][-1]) - first) * 1e-9
            if first is not None and not log.timed:
                raise InputError(f"{self._path}: the log has no timestamps, which a replay needs")
        return seconds

    def _count_rows(self, most: int) -> int:
        """Return the maximum number of rows: SYNCs, or frames of the finger that sent most."""
        identifiers = STANDARD_MASK + 1
        count = np.zeros(identifiers, dtype=np.int64)
        with open_log(self._path, start_ns=self._limits[0], end_ns=self._limits[1]) as log:
            for frames in log:
                ids = frames["can_id"]
                count += np.bincount(ids[ids < identifiers], minlength=identifiers)
        rows = int(count[SYNC_COB_ID]) or int(count[TPDO_BASES[0] + 1 : RPDO_BASES[2]].max())
        if rows > most:
            raise InputError(
                f"{self._path}: {rows} rows of {len(self._watcher.fingers)} fingers, allowed are {most}; choose a part "
                "with --from and --to (seconds)"
            )
        return rows + 1

    def _read(self) -> tuple[int, int]:
        """Read the rows; return the bits of all frames, without stuff bits and with their maximum."""
        last_s, low, high = 0.0, 0, 0
        with open_log(self._path, start_ns=self._limits[0], end_ns=self._limits[1]) as log:
            for frames in log:
                last_s = float(frames["t_ns"][-1]) * 1e-9
                self._add(frames, last_s)
                least, most = range_of_bits(frames)
                low, high = low + least, high + most
        self._add(_NO_FRAMES, last_s + 1.0)
        return low, high

    def _add(self, frames: FrameArray, now_s: float) -> None:
        blocks, events = self._watcher.add(frames, now_s)
        for block in blocks:
            self.model.add(block)
            self.model.counters.rows += len(block)
        for event in events:
            if len(frames):  # the end of a log is not a lost heartbeat
                self.model.add_event(round(event.t_s * 1e9), event.node_id, event.kind, event.text)

    def pump(self) -> None:
        """See Source."""

    def tare(self, node_id: int) -> str:
        """See Source."""
        raise RefusedError(f"node {node_id}: {self.no_tare}")

    def close(self) -> None:
        """See Source."""


def is_scene(path: Path) -> bool:
    """Return whether a TOML file is a scene; the reader of hand files reports an unreadable file."""
    with suppress(OSError, ValueError):
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return "nodes" in content and "finger" not in content
    return False


def scene_source(path: Path, make_finger: FingerMaker, gauges: int, start_s: float, end_s: float | None) -> LogSource:
    """Run the scene without its output files, expectations and bus, and show it like its log. Raises InputError."""
    from tipforce.scene.reader import read_scene
    from tipforce.scene.run import Options, run_scene
    from tipforce.scene.schema import Outputs

    scene = replace(read_scene(path), outputs=Outputs(), expect=(), bus=None)
    layouts = _layouts(scene)

    def make(node_id: int) -> Finger | None:
        finger = make_finger(node_id)
        return finger and with_layout(finger, "" if finger.layout else layouts.get(node_id, ""), None)

    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "scene.log"
        run_scene(scene, path.parent, Options(log=str(log)))
        try:
            source = LogSource(log, make, gauges, (), start_s, end_s)
        except InputError as error:
            raise InputError(str(error).replace(str(log), str(path))) from None
    source.title, source.no_tare = path.name, "a scene can't be tared"
    return source


def _layouts(scene: Scene) -> dict[int, str]:
    """Return the named layouts by node-id."""
    return {node_id: nodes.layout for nodes in scene.nodes if isinstance(nodes.layout, str) for node_id in nodes.ids}
