"""Sources of frames: buses, a log, a pipe; each returns the frames received within a time."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from tipforce.errors import TipforceError
from tipforce.host.frames.frame_array import FRAME, FrameArray

if TYPE_CHECKING:
    from tipforce.host.live.receiver import ReceiverGroup
    from tipforce.host.logs.reader import LogReader

Clock = Callable[[], float]
_WAITING_BLOCKS = 64


class FrameSource:
    """``ended``: no more frames will arrive. Its clock is that of the frames: adapters and recordings have their own.
    It goes on with ``clock`` while no frames arrive. ``close`` releases the buses or the log."""

    def __init__(self, close: Callable[[], object], clock: Clock = time.monotonic) -> None:
        self.ended = False
        self.close, self._clock = close, clock
        self._newest: tuple[int, float] | None = None
        self.dropped = 0
        """Frames that the kernel had dropped at the last ``take``."""

    def take(self, timeout_s: float) -> tuple[FrameArray, Sequence[str]]:
        """Wait for frames up to a timeout; return a FRAME array (k,), k may be 0, and the names of the interfaces.
        Raises the errors of the bus or of the log's reader."""
        frames, names = self._take(timeout_s)
        if len(frames):
            self._newest = int(frames["t_ns"][-1]), self._clock()
        return frames, names

    def _take(self, timeout_s: float) -> tuple[FrameArray, Sequence[str]]:
        raise NotImplementedError

    def now_ns(self) -> int | None:
        """Return the present time on the clock of the frames; None before the first."""
        if self._newest is None:
            return None
        t_ns, at_s = self._newest
        return t_ns + round((self._clock() - at_s) * 1e9)


class BusSource(FrameSource):
    """Buses, live."""

    def __init__(self, receiver: ReceiverGroup) -> None:
        super().__init__(receiver.close)
        self._receiver = receiver

    def _take(self, timeout_s: float) -> tuple[FrameArray, Sequence[str]]:
        block = self._receiver.receive_block(timeout_s)
        self.dropped = self._receiver.dropped
        return block.frames, block.names


class PipeSource(FrameSource):
    """A growing log, or stdin: read by a thread, because it blocks. Frames without times get that of arrival."""

    def __init__(self, log: LogReader, clock: Clock = time.monotonic) -> None:
        super().__init__(log.close, clock)
        self._log = log
        self._arrived: queue.Queue[FrameArray | TipforceError | None] = queue.Queue(_WAITING_BLOCKS)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        try:
            for frames in self._log:
                if not self._log.timed:
                    frames["t_ns"] = time.time_ns()
                self._arrived.put(frames)
        except TipforceError as error:
            self._arrived.put(error)
        except (OSError, ValueError):  # closed by the reader's caller
            pass
        self._arrived.put(None)

    def _take(self, timeout_s: float) -> tuple[FrameArray, Sequence[str]]:
        frames: FrameArray = np.zeros(0, dtype=FRAME)
        with suppress(queue.Empty):
            item = self._arrived.get(timeout=timeout_s)
            if isinstance(item, TipforceError):
                raise item
            self.ended = item is None
            frames = frames if item is None else item
        return frames, self._log.channels


class LogSource(FrameSource):
    """A log with its recorded timing, ``speed`` times as fast; infinite: without waiting. A step returns the frames of
    at most ``step_ns``, so that a table of any time of the log can be shown."""

    def __init__(
        self, log: LogReader, speed: float, step_ns: int, clock: Clock = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:  # fmt: skip
        super().__init__(log.close, clock)
        self._log = log
        self._blocks: Iterator[FrameArray] = iter(log)
        self._speed, self._step_ns, self._sleep = speed, step_ns, sleep
        self._waiting: FrameArray = np.zeros(0, dtype=FRAME)
        self._start: tuple[int, float] = 0, 0.0
        self._now_ns: int | None = None

    def _take(self, timeout_s: float) -> tuple[FrameArray, Sequence[str]]:
        if not len(self._waiting):
            self._waiting = next(self._blocks, self._waiting)
        if not len(self._waiting):
            self.ended = True
            return self._waiting, self._log.channels
        first_ns = int(self._waiting["t_ns"][0])
        if self._now_ns is None or first_ns < self._now_ns - self._step_ns:  # the clock of the recording was set back
            self._now_ns, self._start = first_ns, (first_ns, self._clock())
        end_ns = self._now_ns + self._step_ns
        if self._speed != float("inf"):  # the present time of the log, after waiting for its next frame up to timeout_s
            start_ns, start_s = self._start
            wait_s = min(start_s + (first_ns - start_ns) * 1e-9 / self._speed - self._clock(), timeout_s)
            if wait_s > 0:
                self._sleep(wait_s)
            end_ns = start_ns + round(min((self._clock() - start_s) * 1e9 * self._speed, 1e18))
        late = self._waiting["t_ns"] > end_ns
        count = int(late.argmax()) if late.any() else len(self._waiting)
        frames, self._waiting = self._waiting[:count], self._waiting[count:]
        self._now_ns = end_ns if len(self._waiting) else int(frames["t_ns"].max())
        return frames, self._log.channels

    def now_ns(self) -> int | None:
        """See FrameSource: the time that is reached in the log."""
        return self._now_ns
