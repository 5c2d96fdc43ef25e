"""Record frames to files: candump's log format is written directly, every other format with python-can's writers."""

from __future__ import annotations

import gzip
import os
import time
from contextlib import AbstractContextManager
from io import BufferedIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tipforce.errors import EnvironmentLackError, InputError, WriteError
from tipforce.host.logs.notes import suffix_of
from tipforce.output_file import check_output

if TYPE_CHECKING:
    from tipforce.host.frames.frame_block import CandumpBlock


class Recorder(AbstractContextManager["Recorder"]):
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
        self._failed = False
        self._writer = self._open()

    def __exit__(self, *_: object) -> None:
        self._close()

    def write(self, block: CandumpBlock) -> None:
        """Append a block, to the next file if this one is full or old enough. Raises WriteError if the disk is full."""
        if not len(block):
            return
        late = self._limit_s is not None and time.monotonic() - self._begun_s >= self._limit_s
        if late or (self._limit_bytes is not None and self._place.stat().st_size >= self._limit_bytes):
            self._close()
            self._writer = self._open()
        try:
            self._writer.write(block)
        except OSError as error:
            self._failed = True
            raise self._failure(error) from error
        self.frames += len(block)

    def _open(self) -> CandumpWriter | PythonCanWriter:
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
_ZIP_FLUSH_S = 1.0  # each flush costs compression
_DRAIN_S = 60.0


def open_writer(path: Path) -> CandumpWriter | PythonCanWriter:
    """Return a writer of the format of the suffix. Raises InputError for another suffix."""
    return CandumpWriter(path) if format_suffix(path) == _CANDUMP else PythonCanWriter(path)


def format_suffix(path: Path) -> str:
    """Return `.log` for run.log and run.log.gz. Raises InputError for a format that cannot be written."""
    suffix, zipped = suffix_of(path)
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
        zipped = suffix_of(path)[1]
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
        from tipforce.host.live.python_can import message

        for t_ns, can_id, length, data, interface, sent, fd_flags in block.in_order():
            name = block.names[interface]
            self._writer.on_message_received(message(t_ns, can_id, length, data, name, sent, fd_flags))

    def close(self) -> None:
        """Write pending frames and close the file. Raises OSError."""
        waiting: Any = getattr(self._writer, "buffer", None)  # SQLite: its stop() discards what is not written
        end = time.monotonic() + _DRAIN_S
        while hasattr(waiting, "empty") and not waiting.empty():
            if time.monotonic() > end:
                raise OSError(f"the database needs more than {_DRAIN_S:g} s; {waiting.qsize()} frames are not written")
            time.sleep(0.01)
        self._writer.stop()
