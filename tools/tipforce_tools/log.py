"""`tipforce log [vcan0,181:7FF ...] [-o FILE]`: from buses to files, until an end condition.

candump's log format is written directly, every other format with python-can's writers.
"""

from __future__ import annotations

import argparse
import gzip
import math
import os
import re
import time
from io import BufferedIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias

from tipforce.errors import EnvironmentLackError, InputError, WriteError
from tipforce.output_file import check_output
from tipforce_tools.cli import common
from tipforce_tools.cli.listening import StopSignals, add_sync_argument, counted, open_targets
from tipforce_tools.cli.main import INTERRUPTED

if TYPE_CHECKING:
    from tipforce.host.frames.frame_block import CandumpBlock
    from tipforce.host.live.receiver import ReceiverGroup

DESCRIPTION = """\
Record frames until Ctrl-C, SIGTERM, -n, -T or --seconds. The file then holds all received frames in every case;
stderr reports the number of frames, and of frames dropped by the kernel.
"""
EPILOG = """\
CHANNEL[,FILTER...] as for `tipforce dump` and candump; without #MASK no error frames. The suffix of FILE sets the
format: .log (candump's, for canplayer, Wireshark, `tipforce replay` and `decode`), .asc .blf .csv .trc .db .mf4 .txt
(python-can's writers), and .log.gz .asc.gz .csv.gz .trc.gz. With a --rotate flag, files are numbered: run-0001.log.
exit codes: 0 ended by -n, -T or --seconds, 130 by Ctrl-C or SIGTERM, 1 the disk is full, 2 usage

  tipforce log vcan0                                candump-2026-05-17_093000.log, as candump -l
  tipforce log -o run.log.gz vcan0,180:780 vcan1
  tipforce log -o run.blf -i pcan -c PCAN_USBBUS1 -b 1000000
  tipforce log -o hand.log --rotate-size 100M --rotate-time 3600 any,0:0,#FFFFFFFF
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce log` and python-can's bus flags to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument(
        "targets", nargs="*", type=common.Target(), metavar="CHANNEL[,FILTER...]", help="buses with their filters"
    )
    parser.add_argument("-o", "--output", metavar="FILE", help="default: a name as of candump -l, by date and time")
    parser.add_argument("--overwrite", action="store_true", help="overwrite existing files")
    parser.add_argument("-n", dest="count", type=common.count, metavar="COUNT", help="end after COUNT frames")
    parser.add_argument("-T", dest="timeout_ms", type=common.count, metavar="MS", help="end after MS without a frame")
    parser.add_argument("--seconds", type=common.seconds, metavar="S", help="end after S seconds")
    parser.add_argument("-D", dest="stay", action="store_true", help="continue when an interface goes down")
    add_sync_argument(parser)
    parser.add_argument("--rotate-size", type=_bytes, metavar="SIZE", help="a new file after SIZE bytes: 500K 100M 1G")
    parser.add_argument("--rotate-time", type=common.seconds, metavar="S", help="a new file after S seconds")
    common.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Record until an end condition; return 0, or 130 after a signal.


    Raises InputError for an unusable target or file, EnvironmentLackError for a bus that cannot be opened or fails,
    WriteError for a full disk; the file holds the frames received until then.
    """
    from tipforce_tools.dump.targets import split_targets

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


def _bytes(text: str) -> int:
    match = re.fullmatch(r"([1-9]\d*)([KMG]?)", text, re.IGNORECASE)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r}: expected bytes, or a number with K, M or G: 100M")
    return int(match[1]) << {"": 0, "K": 10, "M": 20, "G": 30}[match[2].upper()]


TICK_S = 0.02
"""Period of writes: saves work, and the socket's buffer holds many times as much."""
_SLICE_S = 0.2  # maximum delay of a signal
_LAST_S = 0.5  # time to read pending frames after a signal


def _record(args: argparse.Namespace, receiver: ReceiverGroup, recorder: Recorder, stop: StopSignals) -> None:
    from tipforce.host.live.receiver import InterfaceDownError

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


def _report(args: argparse.Namespace, recorder: Recorder, dropped: int, seconds: float) -> None:
    paths = [str(path) for path in recorder.paths]
    files = paths[0] if len(paths) == 1 else f"{len(paths)} files"
    frames = counted(recorder.frames, "frame")
    common.note(args, f"tipforce log: {frames} in {seconds:.1f} s to {files}, {dropped} dropped")
    if args.json:
        common.print_json({"frames": recorder.frames, "dropped": dropped, "seconds": round(seconds, 3), "files": paths})


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


_CANDUMP = ".log"
_ZIP = ".gz"
_ZIP_FLUSH_S = 1.0  # each flush costs compression
_DRAIN_S = 60.0


def open_writer(path: Path) -> LogWriter:
    """Return a writer of the format of the suffix. Raises InputError for another suffix."""
    return CandumpWriter(path) if format_suffix(path) == _CANDUMP else PythonCanWriter(path)


def format_suffix(path: Path) -> str:
    """Return `.log` for run.log and run.log.gz. Raises InputError for a format that cannot be written."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    zipped = suffixes[-1:] == [_ZIP]
    suffix = "".join(suffixes[:-1][-1:] if zipped else suffixes[-1:])
    if suffix == _CANDUMP:
        return suffix
    from can.io.logger import MESSAGE_WRITERS

    known = sorted({*MESSAGE_WRITERS, _CANDUMP})
    if suffix not in known or (zipped and suffix in {".blf", ".db", ".mf4"}):
        raise InputError(
            f"{path}: unknown format {path.suffix or '(no suffix)'}: "
            f"allowed are {', '.join(known)}, and .gz after .log, .asc, .csv, .trc and .txt"
        )
    return suffix


class CandumpWriter:
    """candump's log format: one line per frame as in `candump -L`. Wireshark and canplayer read it."""

    def __init__(self, path: Path) -> None:
        from tipforce.host.logs.candump_format import CandumpFormat

        # Names are not aligned: the width would change with a longer one.
        self._format = CandumpFormat(log=True, align=False)
        zipped = path.suffix.lower() == _ZIP
        self._file: BufferedIOBase = gzip.GzipFile(path, "wb", compresslevel=6) if zipped else path.open("wb")
        self._flush_every_s = _ZIP_FLUSH_S if zipped else 0.0
        self._flushed_s = time.monotonic()

    def write(self, block: CandumpBlock) -> None:
        """Append the frames of a block; a killed process loses at most one second of a .gz. Raises OSError."""
        lines = self._format.lines(block)
        if lines:
            self._file.write(("\n".join(lines) + "\n").encode())
            now = time.monotonic()
            if now - self._flushed_s >= self._flush_every_s:
                self._file.flush()
                self._flushed_s = now

    def close(self) -> None:
        """Write pending frames and close the file. Raises OSError."""
        self._file.close()


class PythonCanWriter:
    """A writer for any format of python-can."""

    def __init__(self, path: Path) -> None:
        """Raises EnvironmentLackError for a format that needs a missing package."""
        import can

        try:
            self._writer: Any = can.Logger(path)
        except (ImportError, NotImplementedError) as error:
            raise EnvironmentLackError(f"{path}: {error}; for .mf4: pip install asammdf") from error

    def write(self, block: CandumpBlock) -> None:
        """Append the frames of a block."""
        from tipforce.host.live.python_can import block_messages

        for message in block_messages(block):
            self._writer.on_message_received(message)

    def close(self) -> None:
        """Write pending frames and close the file. Raises OSError."""
        self._drain()
        self._writer.stop()

    def _drain(self) -> None:
        """Wait until python-can's SQLite writer has written all messages: its stop() discards the rest."""
        waiting = getattr(self._writer, "buffer", None)
        if waiting is None or not hasattr(waiting, "empty"):
            return
        end = time.monotonic() + _DRAIN_S
        while not waiting.empty() and time.monotonic() < end:
            time.sleep(0.01)
        if not waiting.empty():
            raise OSError(f"the database needs more than {_DRAIN_S:g} s; {waiting.qsize()} frames are not written")


LogWriter: TypeAlias = CandumpWriter | PythonCanWriter
