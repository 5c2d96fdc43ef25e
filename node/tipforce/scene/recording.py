"""Record every frame of a run, once: for the decoder as FRAME arrays, and for a log in candump's format."""

from __future__ import annotations

from io import TextIOBase
from pathlib import Path
from types import TracebackType

import numpy as np

from tipforce.errors import EnvironmentLackError, WriteError
from tipforce.host.frames.frame_array import FRAME, FrameArray, RawFrame, frame_array
from tipforce.output_file import CANDUMP_LOG, NewFile

BLOCK_FRAMES = 16_384


class Recording:
    """Record frames in the order of their times. With ``log`` each is also written to that file. A context manager.

    Raises InputError for an unusable path of the log, WriteError when it cannot be written; then an old log stays.
    """

    def __init__(self, log: str | Path | None = None, interface: str = "sim0") -> None:
        self.counts: dict[int, int] = {}
        """Frames by COB-ID."""
        self._rows: list[RawFrame] = []
        self._blocks: list[FrameArray] = []
        self._interface = interface
        self._log = None if log is None else _LogFile(log)

    def add(self, t_us: int, can_id: int, data: bytes) -> None:
        """Record one frame."""
        self._rows.append((1000 * t_us, can_id, data))
        self.counts[can_id] = self.counts.get(can_id, 0) + 1
        if len(self._rows) >= BLOCK_FRAMES:
            self._flush()

    def frames(self) -> FrameArray:
        """Return all frames so far, FRAME array (n,)."""
        self._flush()
        self._blocks = [np.concatenate(self._blocks)] if self._blocks else [np.zeros(0, dtype=FRAME)]
        return self._blocks[0]

    def _flush(self) -> None:
        if self._rows:
            block = frame_array(self._rows)
            self._rows.clear()
            self._blocks.append(block)
            if self._log is not None:
                self._log.write(block, self._interface)

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        complete = kind is None or issubclass(
            kind, (KeyboardInterrupt, EnvironmentLackError)
        )  # nothing received is lost
        try:
            if complete:
                self._flush()
        except WriteError:
            complete = False
            raise
        finally:
            if self._log is not None:
                self._log.close(complete)


class _LogFile:
    """A log in the format of candump -L; its formatter is loaded only here."""

    def __init__(self, path: str | Path) -> None:
        from tipforce.host.logs.candump_format import CandumpFormat

        self._format = CandumpFormat(log=True)
        self._new = NewFile(path, CANDUMP_LOG)
        self._file: TextIOBase = self._new.partial.open("w", encoding="ascii", newline="\n")

    def write(self, frames: FrameArray, interface: str) -> None:
        from tipforce.host.logs.candump import CandumpBlock

        count = len(frames)
        block = CandumpBlock(frames, np.zeros(count, np.uint16), (interface,), np.zeros(count, np.bool_))
        try:
            self._file.write("\n".join([*self._format.lines(block), ""]))
        except OSError as error:
            raise self._new.failed(error) from error

    def close(self, complete: bool) -> None:
        """Give the complete file its name; remove an incomplete one."""
        try:
            self._file.close()
        except OSError as error:
            self._new.drop()
            raise self._new.failed(error) from error
        if complete:
            self._new.keep()
        else:
            self._new.drop()
