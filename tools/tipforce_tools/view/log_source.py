"""A log as the source of a page: the whole log is read, and its rows stay in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tipforce.device.codes import RPDO_BASES, STANDARD_MASK, SYNC_COB_ID, TPDO_BASES
from tipforce.errors import InputError, LogError, RefusedError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.network.bus_load import range_of_bits
from tipforce_tools.view.fingers import Finger
from tipforce_tools.view.history import MAX_BYTES, row_bytes
from tipforce_tools.view.model import Model
from tipforce_tools.view.watcher import Watcher

LOG_BYTES = 8 * MAX_BYTES
"""Memory limit of a log's rows; of a longer log the user must choose a part."""

_NO_FRAMES: FrameArray = np.zeros(0, dtype=FRAME)


class LogSource:
    """A log; all its rows stay in memory."""

    def __init__(
        self, path: Path, make_finger: Callable[[int], Finger | None], gauges: int = 3,
        fingers: Sequence[Finger] = (), start_s: float = 0.0, end_s: float | None = None,
    ) -> None:  # fmt: skip
        """``start_s``, ``end_s``: the part to read, seconds from the log's first frame. Raises InputError."""
        self.title, self.no_tare = path.name, "a log can't be tared"
        watcher = Watcher(make_finger, gauges, fingers)
        limits = self._discover(path, watcher, start_s, end_s)
        if not watcher.fingers:
            raise LogError(f"{path}: no PDO of a fingertip (0x180, 0x280 or 0x380 + node-id, with 8 bytes)")
        capacity = LOG_BYTES // (2 * row_bytes(len(watcher.fingers), gauges))
        self.model = Model(watcher.fingers, gauges, live=False, capacity=self._rows(path, watcher, limits, capacity))
        self._read(path, watcher, limits)
        if not self.model.counters.rows:
            raise InputError(f"{path}: no sample between --from and --to; the log lasts {self._seconds:g} s")
        found = self.model.counters
        for name, values in watcher.tally().items():
            setattr(found, name, values)
        start, end = self.model.span_ns()
        bits, seconds = self._bits, max((end - start) * 1e-9, 1e-9)
        found.load_low, found.load_high = (total / (1_000_000 * seconds) for total in bits)

    def _discover(
        self, path: Path, watcher: Watcher, start_s: float, end_s: float | None
    ) -> tuple[int | None, int | None]:
        from tipforce.host.logs.reader import open_log

        first: int | None = None
        limits: tuple[int | None, int | None] = (None, None)
        with open_log(path) as log:
            for frames in log:
                if first is None:
                    first = int(frames["t_ns"][0])
                    start = first + round(start_s * 1e9) if start_s else None
                    limits = start, first + round(end_s * 1e9) if end_s is not None else None
                watcher.discover(frames)
                self._seconds = (int(frames["t_ns"][-1]) - first) * 1e-9
            if first is not None and not log.timed:
                raise InputError(f"{path}: the log has no timestamps, which a replay needs")
        return limits

    @staticmethod
    def _rows(path: Path, watcher: Watcher, limits: tuple[int | None, int | None], most: int) -> int:
        """Return the maximum number of rows: SYNCs, or frames of the finger that sent most."""
        from tipforce.host.logs.reader import open_log

        identifiers = STANDARD_MASK + 1
        count = np.zeros(identifiers, dtype=np.int64)
        with open_log(path, start_ns=limits[0], end_ns=limits[1]) as log:
            for frames in log:
                ids = frames["can_id"]
                count += np.bincount(ids[ids < identifiers], minlength=identifiers)
        rows = int(count[SYNC_COB_ID]) or int(count[TPDO_BASES[0] + 1 : RPDO_BASES[2]].max())
        if rows > most:
            raise InputError(
                f"{path}: {rows} rows of {len(watcher.fingers)} fingers, allowed are {most}; choose a part with "
                "--from and --to (seconds)"
            )
        return rows + 1

    def _read(self, path: Path, watcher: Watcher, limits: tuple[int | None, int | None]) -> None:
        from tipforce.host.logs.reader import open_log

        last_s, low, high = 0.0, 0, 0
        with open_log(path, start_ns=limits[0], end_ns=limits[1]) as log:
            for frames in log:
                last_s = float(frames["t_ns"][-1]) * 1e-9
                self._take(watcher, frames, last_s)
                least, most = range_of_bits(frames)
                low, high = low + least, high + most
        self._take(watcher, _NO_FRAMES, last_s + 1.0)
        self._bits = low, high

    def _take(self, watcher: Watcher, frames: FrameArray, now_s: float) -> None:
        found, events = watcher.add(frames, now_s)
        for block in found:
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
