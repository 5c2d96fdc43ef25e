"""Write frames to a file: candump's log format directly, every other format with python-can's writers."""

from __future__ import annotations

import gzip
import time
from io import BufferedIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump_format import CandumpFormat

if TYPE_CHECKING:
    import can

CANDUMP_SUFFIXES = (".log",)
_ZIP = ".gz"
_ZIP_FLUSH_S = 1.0  # each flush costs compression
_DRAIN_S = 60.0


class LogWriter(Protocol):
    """A log file opened for writing."""

    def write(self, block: CandumpBlock) -> None:
        """Append the frames of a block; a killed process loses at most one second of a .gz. Raises OSError."""

    def close(self) -> None:
        """Write pending frames and close the file. Raises OSError."""


def open_writer(path: Path) -> LogWriter:
    """Return a writer of the format of the suffix. Raises InputError for another suffix."""
    suffix = format_suffix(path)
    if suffix in CANDUMP_SUFFIXES:
        return CandumpWriter(path)
    return PythonCanWriter(path)


def format_suffix(path: Path) -> str:
    """Return `.log` for run.log and run.log.gz. Raises InputError for a format that cannot be written."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    zipped = suffixes[-1:] == [_ZIP]
    suffix = "".join(suffixes[:-1][-1:] if zipped else suffixes[-1:])
    if suffix in CANDUMP_SUFFIXES:
        return suffix
    from can.io.logger import MESSAGE_WRITERS

    known = sorted({*MESSAGE_WRITERS, *CANDUMP_SUFFIXES})
    if suffix not in known or (zipped and suffix in {".blf", ".db", ".mf4"}):
        raise InputError(
            f"{path}: unknown format {path.suffix or '(no suffix)'}: "
            f"allowed are {', '.join(known)}, and .gz after .log, .asc, .csv, .trc and .txt"
        )
    return suffix


class CandumpWriter:
    """candump's log format: one line per frame as in `candump -L`. Wireshark and canplayer read it."""

    def __init__(self, path: Path) -> None:
        # Names are not aligned: the width would change with a longer one.
        self._format = CandumpFormat(log=True, align=False)
        zipped = path.suffix.lower() == _ZIP
        self._file: BufferedIOBase = gzip.GzipFile(path, "wb", compresslevel=6) if zipped else path.open("wb")
        self._flush_every_s = _ZIP_FLUSH_S if zipped else 0.0
        self._flushed_s = time.monotonic()

    def write(self, block: CandumpBlock) -> None:
        """See LogWriter."""
        lines = self._format.lines(block)
        if lines:
            self._file.write(("\n".join(lines) + "\n").encode())
            now = time.monotonic()
            if now - self._flushed_s >= self._flush_every_s:
                self._file.flush()
                self._flushed_s = now

    def close(self) -> None:
        """See LogWriter."""
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
        """See LogWriter."""
        from tipforce.host.live.python_can import block_messages

        for message in block_messages(block):
            self._writer.on_message_received(message)

    def close(self) -> None:
        """See LogWriter."""
        _drain(self._writer)
        self._writer.stop()


def _drain(writer: can.io.generic.MessageWriter) -> None:
    """Wait until python-can's SQLite writer has written all messages: its stop() discards the rest."""
    waiting = getattr(writer, "buffer", None)
    if waiting is None or not hasattr(waiting, "empty"):
        return
    end = time.monotonic() + _DRAIN_S
    while not waiting.empty() and time.monotonic() < end:
        time.sleep(0.01)
    if not waiting.empty():
        raise OSError(f"the database needs more than {_DRAIN_S:g} s; {waiting.qsize()} frames are not written")
