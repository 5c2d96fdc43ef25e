"""Sources of a page: a feed of live rows, a log whose rows all stay in memory, a scene that is run."""

import dataclasses
import tempfile
import time
import tomllib
from contextlib import suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from canopen_device.core.codes import RPDO_BASES, STANDARD_MASK, SYNC_COB_ID, TPDO_BASES
from tipforce.errors import InputError, RefusedError, TipforceError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.hand.events import Event
from tipforce.host.logs.notes import no_sample
from tipforce.host.logs.reader import open_log
from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, range_of_bits
from tipforce.samples import reasons
from tipforce.samples.reasons import Status
from tipforce.watching.feeds import Counters, Feed, Finger, FingerMaker, Watcher, with_layout
from tipforce.watching.findings import not_calibrated
from tipforce_tools.page.model import MAX_BYTES, Model, row_bytes

LOG_BYTES = 8 * MAX_BYTES
"""Memory limit of a log's rows; of a longer log the user must choose a part."""
MAX_FRAMES = 1_000_000
"""A longer log is shown without the text of its frames."""
_NO_FRAMES: FrameArray = np.zeros(0, dtype=FRAME)
_PYTHON = """\
import tipforce

log = tipforce.read_log("{file}")
print(log)
print(log[{node_id}])
print(log[{node_id}].P_newtons)  # .t_s, .phi_deg, .theta_deg
"""
"""What it prints has numbers, also where the first samples are unknown."""


class Source:
    """Fills a model; one thread calls ``pump`` about 30 times a second. ``no_tare``: why tare is not available, or "".
    ``loops``: a replay begins again at its end; otherwise it ends on the moment ``rest_ns``, if given."""

    loops = False
    rest_ns: int | None = None
    python = ""
    """Lines of Python that read the same."""

    def __init__(self, title: str, no_tare: str, model: Model) -> None:
        self.title, self.no_tare, self.model = title, no_tare, model

    def pump(self) -> None:
        """Move received data into the model."""

    def tare(self, node_id: int) -> str:
        """Set the present force of a finger as zero; return the message to show. Raises TipforceError."""
        raise RefusedError(f"node {node_id}: {self.no_tare}")

    def close(self) -> None:
        """Release the source."""


class LiveSource(Source):
    """Rows of a feed, which it closes."""

    def __init__(self, feed: Feed, title: str, no_tare: str = "") -> None:
        super().__init__(title, no_tare, Model(feed.fingers, feed.gauges))
        self.feed = feed
        self._bare: set[int] = set()  # node-ids that were said to be uncalibrated

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
        fingers = self.feed.fingers
        if fingers != model.fingers:
            model.set_fingers(fingers)
        for block in blocks:
            model.add(block, self.feed.arrived_s)
            self._note_uncalibrated(block.status)
        for event in events:
            model.add_event(time.time_ns(), event.node_id, event.kind, event.text)
        while self.feed.hints:
            model.add_event(time.time_ns(), 0, "hint", self.feed.hints.pop(0))
        model.counters = self.feed.counters()
        model.nmt = [self.feed.state(finger.node_id) for finger in fingers]

    def _note_uncalibrated(self, status: npt.NDArray[np.integer]) -> None:
        """Add an event, once for each finger, with the command that calibrates it; ``status``: (m, k) of new rows."""
        bare = (status & (reasons.NO_ANSWER | Status.CALIBRATED) == 0).any(axis=0)
        for finger, is_bare in zip(self.model.fingers, bare.tolist(), strict=False):
            if is_bare and finger.calibration is None and finger.node_id not in self._bare:
                self._bare.add(finger.node_id)
                text = f"{reasons.NOT_CALIBRATED}: {not_calibrated(finger.node_id).next_step}"
                self.model.add_event(time.time_ns(), finger.node_id, "hint", text)

    def tare(self, node_id: int) -> str:
        """See Source."""
        return self.feed.tare(node_id)

    def close(self) -> None:
        """See Source."""
        self.feed.close()


class LogSource(Source):
    """A log; all its rows stay in memory."""

    def __init__(
        self, path: Path, make_finger: FingerMaker, gauges: int = 3, start_s: float = 0.0, end_s: float | None = None
    ) -> None:
        """``start_s``, ``end_s``: the part to read, seconds from the log's first frame. Raises InputError."""
        self._path, self._hidden = path, False

        def make(node_id: int) -> Finger | None:
            finger = make_finger(node_id)
            self._hidden |= finger is None
            return finger

        self._watcher = Watcher(make, gauges)
        rows = self._discover(start_s, end_s)
        found = self._watcher.fingers
        most = LOG_BYTES // (2 * row_bytes(len(found), gauges))
        if rows > most:
            raise InputError(
                f"{path}: {rows} rows of {len(found)} fingers, allowed are {most}; choose a part with --from and --to "
                "(seconds)"
            )
        super().__init__(path.name, "a log can't be tared", Model(found, gauges, live=False, capacity=rows + 1))
        self.python = _PYTHON.format(file=path.name, node_id=found[0].node_id)
        low, high = self._read()
        if not self._watcher.tally.rows:
            raise InputError(f"{path}: no sample between --from and --to; the log lasts {self._seconds:g} s")
        start, end = self.model.span_ns()
        bits = DEFAULT_BIT_RATE * (end - start) * 1e-9  # 0: one moment has no load
        self.model.counters = Counters.of(self._watcher.tally, load=(low / bits, high / bits) if bits else (None, None))

    def _discover(self, start_s: float, end_s: float | None) -> int:
        """Find the fingers and the length of the log; return the rows of the part at most: SYNCs, or a node's PDOs."""
        first, start, end = None, 0, np.iinfo(np.int64).max
        count = np.zeros(STANDARD_MASK + 1, dtype=np.int64)
        with open_log(self._path) as log:
            for frames in log:
                t_ns, ids = frames["t_ns"], frames["can_id"]
                if first is None:
                    first = int(t_ns[0])
                    start = first + round(start_s * 1e9) if start_s else start
                    end = first + round(end_s * 1e9) if end_s is not None else end
                self._watcher.discover(frames)
                self._seconds = (int(t_ns[-1]) - first) * 1e-9
                counted = ids[(ids < len(count)) & (t_ns >= start) & (t_ns < end)]
                count += np.bincount(counted, minlength=len(count))
            if not self._watcher.fingers:
                if self._hidden:
                    raise InputError(f"{self._path}: no PDO of the chosen nodes")
                raise no_sample(log.source, log.frames, log.extended)
            if not log.timed:
                raise InputError(f"{self._path}: the log has no timestamps, which a replay needs")
        self._limits = start, end
        if not count[SYNC_COB_ID]:
            self._watcher.pace_by_pdo()
        return int(count[SYNC_COB_ID]) or int(count[TPDO_BASES[0] + 1 : RPDO_BASES[2]].max())

    def _read(self) -> tuple[int, int]:
        last_s, low, high = 0.0, 0, 0
        kept: list[FrameArray] = []
        with open_log(self._path, start_ns=self._limits[0], end_ns=self._limits[1]) as log:
            for frames in log:
                if sum(map(len, kept)) <= MAX_FRAMES:
                    kept.append(frames)
                last_s = float(frames["t_ns"][-1]) * 1e-9
                for event in self._add(frames, last_s):
                    self.model.add_event(round(event.t_s * 1e9), event.node_id, event.kind, event.text)
                least, most = range_of_bits(frames)
                low, high = low + least, high + most
        self._add(_NO_FRAMES, last_s + 1.0)  # the end of a log is not a lost heartbeat
        if kept and sum(map(len, kept)) <= MAX_FRAMES:
            frames = np.concatenate(kept)
            if (np.diff(frames["t_ns"]) > -1_000_000_000).all():  # a clock set back: they are not of a row's moment
                self.model.frames = frames, tuple(log.channels)
        return low, high

    def _add(self, frames: FrameArray, now_s: float) -> list[Event]:
        blocks, events = self._watcher.add(frames, now_s)
        for block in blocks:
            self.model.add(block)
        return events


def is_scene(path: Path) -> bool:
    """Return whether a TOML file is a scene; the reader of hand files reports an unreadable file."""
    with suppress(OSError, ValueError):
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return "nodes" in content and "finger" not in content
    return False


def scene_source(path: Path, make_finger: FingerMaker, start_s: float = 0.0, end_s: float | None = None) -> LogSource:
    """Run the scene without its output files, expectations and bus, and show it like its log. Raises InputError. It
    knows the names, layouts and calibrations of its fingers, and ends on the moment with most of them in contact."""
    from tipforce.scene.build import build
    from tipforce.scene.reader import read_scene
    from tipforce.scene.run import run_scene
    from tipforce.scene.schema import Outputs

    scene = replace(read_scene(path), expect=(), bus=None)
    built = {finger.node_id: finger for finger in build(scene, path.parent)}

    def make(node_id: int) -> Finger | None:
        finger, simulated = make_finger(node_id), built[node_id]
        if finger is None:
            return None
        names, layout = dict(zip(simulated.group.ids, simulated.group.names, strict=False)), simulated.group.layout
        finger = dataclasses.replace(finger, name=names.get(node_id, ""), calibration=simulated.calibration)
        return with_layout(finger, layout if isinstance(layout, str) and not finger.layout else "", None)

    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "scene.log"
        run_scene(replace(scene, outputs=Outputs(log=str(log))), path.parent)
        try:
            source = LogSource(log, make, max(finger.gauges for finger in built.values()), start_s, end_s)
        except InputError as error:
            raise InputError(str(error).replace(str(log), str(path))) from None
    source.python = f"# tipforce run {path.stem} --log scene.log\n{source.python}"
    source.title, source.no_tare = scene.title or path.name, "a scene can't be tared"
    source.rest_ns = source.model.best_ns()
    return source
