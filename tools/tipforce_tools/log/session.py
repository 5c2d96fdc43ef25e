"""One run of `tipforce log`: from the buses to the file, until an end condition."""

from __future__ import annotations

import math
import os
import time
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from tipforce.errors import InputError, WriteError
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.live.receiver import InterfaceDownError
from tipforce.output_file import check_output
from tipforce_tools.cli import common
from tipforce_tools.cli.listening import StopSignals, counted, open_targets
from tipforce_tools.cli.main import INTERRUPTED
from tipforce_tools.dump.output import split_targets
from tipforce_tools.log.writers import LogWriter, format_suffix, open_writer

if TYPE_CHECKING:
    from tipforce.host.live.receiver import ReceiverGroup


def default_name(second: float) -> str:
    """Return the file name of candump -l for a log that begins at this time, in seconds since 1970."""
    return time.strftime("candump-%Y-%m-%d_%H%M%S.log", time.localtime(second))


class Recorder:
    """Write blocks to ``path``, or with a limit to numbered files: run-0001.log, run-0002.log... A context manager."""

    def __init__(
        self, path: Path, *, limit_bytes: int | None = None, limit_s: float | None = None, overwrite: bool = False
    ) -> None:
        """Open the first file. Raises InputError if it exists, cannot be created, or has no known format."""
        format_suffix(path)
        self._path = path
        self._limit_bytes = limit_bytes
        self._limit_s = limit_s
        self._overwrite = overwrite
        self.paths: list[Path] = []
        self.frames = 0
        self._begun_s = 0.0
        self._failed = False
        self._place = path
        self._writer = self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def write(self, block: CandumpBlock) -> None:
        """Append a block, to the next file if this one is full or old enough. Raises WriteError if the disk is full."""
        if not len(block):
            return
        if self._is_over():
            self._close()
            self._writer = self._open()
        try:
            self._writer.write(block)
        except OSError as error:
            self._failed = True
            raise self._failure(error) from error
        self.frames += len(block)

    def _is_over(self) -> bool:
        if self._limit_s is not None and time.monotonic() - self._begun_s >= self._limit_s:
            return True
        return self._limit_bytes is not None and self._place.stat().st_size >= self._limit_bytes

    def _open(self) -> LogWriter:
        path = self._path
        if self._limit_bytes is not None or self._limit_s is not None:
            stem, dot, suffixes = path.name.partition(".")
            path = path.with_name(f"{stem}-{len(self.paths) + 1:04d}{dot}{suffixes}")
        check_output(path)
        if path.exists() and not self._overwrite:
            raise InputError(f"{path} exists: choose another name, or add --overwrite")
        # The suffix selects the format.
        self._place = path.with_name(f".{os.getpid()}.{path.name}") if path.is_file() else path
        try:
            writer = open_writer(self._place)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        self.paths.append(path)
        self._begun_s = time.monotonic()
        return writer

    def _close(self) -> None:
        """Complete the file. After a failed write, what was recorded stays under its temporary name."""
        try:
            self._writer.close()
        except OSError as error:
            if not self._failed:  # otherwise the first error is reported
                raise self._failure(error) from error
            return
        if self._place != self.paths[-1] and not self._failed:
            self._place.replace(self.paths[-1])

    def _failure(self, error: OSError) -> WriteError:
        path = self.paths[-1]
        old = "" if self._place == path else f"; the frames so far are in {self._place}, {path.name} is the old file"
        return WriteError(f"{path}: {error.strerror or error}{old}")


TICK_S = 0.02
"""Period of writes: saves work, and the socket's buffer holds many times as much."""

_SLICE_S = 0.2  # maximum delay of a signal
_LAST_S = 0.5  # time to read pending frames after a signal


def record(args: Namespace) -> int:
    """Record until -n, -T, --seconds or a signal; return 0, or 130 after a signal."""
    source, targets = split_targets(args.targets)
    if source is not None:
        raise InputError(f"{source}: allowed are buses; `tipforce replay` reads a file")
    path = Path(args.output or default_name(time.time()))
    with (
        StopSignals() as stop,
        open_targets(targets, args, tick_s=TICK_S) as receiver,
        Recorder(path, limit_bytes=args.rotate_size, limit_s=args.rotate_time, overwrite=args.overwrite) as recorder,
    ):
        common.note(args, f"tipforce log: recording to {recorder.paths[0]}")
        begun_s = time.monotonic()
        try:
            _record(args, receiver, recorder, stop)
        finally:
            _report(args, recorder, receiver.dropped, time.monotonic() - begun_s)
    return INTERRUPTED if stop.stopped else 0


def _record(args: Namespace, receiver: ReceiverGroup, recorder: Recorder, stop: StopSignals) -> None:
    limit_s = math.inf if args.timeout_ms is None else args.timeout_ms / 1000
    last_s = time.monotonic()
    end_s = math.inf if args.seconds is None else last_s + args.seconds
    while not stop.stopped and (now_s := time.monotonic()) < end_s:
        try:
            block = receiver.receive_block(min(_SLICE_S, limit_s, end_s - now_s))
        except InterfaceDownError as error:
            if not args.stay:
                raise
            common.note(args, f"tipforce log: {error}")
            continue
        if len(block):
            last_s = time.monotonic()
        elif time.monotonic() - last_s >= limit_s:
            return
        if args.count is not None:
            block = block.head(args.count - recorder.frames)
        recorder.write(block)
        if recorder.frames == args.count:
            return
    # Frames received until then are recorded, too.
    end_s = time.monotonic() + _LAST_S
    while time.monotonic() < end_s and len(block := receiver.receive_block(0)):
        recorder.write(block if args.count is None else block.head(args.count - recorder.frames))


def _report(args: Namespace, recorder: Recorder, dropped: int, seconds: float) -> None:
    files = str(recorder.paths[0]) if len(recorder.paths) == 1 else f"{len(recorder.paths)} files"
    common.note(
        args, f"tipforce log: {counted(recorder.frames, 'frame')} in {seconds:.1f} s to {files}, {dropped} dropped"
    )
    if args.json:
        common.print_json(
            {
                "frames": recorder.frames,
                "dropped": dropped,
                "seconds": round(seconds, 3),
                "files": [str(path) for path in recorder.paths],
            }
        )
