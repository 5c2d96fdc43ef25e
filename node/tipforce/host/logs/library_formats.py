"""Read every log format that python-can reads (ASC, BLF, TRC, CSV, MF4, SQLite) as blocks of frames."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import can
import numpy as np

from tipforce.errors import EnvironmentLackError, InputError, LogError
from tipforce.host.frames.frame_array import FRAME, SENT, FrameArray
from tipforce.host.logs.log_statistics import FD, UNREADABLE, LogNotes
from tipforce.socketcan import raw_can_id

BLOCK_MESSAGES = 8192
_PACK = struct.Struct("<qIBBBx8s").pack  # one FRAME


def message_blocks(path: Path, notes: LogNotes) -> Iterator[FrameArray]:
    """Yield blocks of at most BLOCK_MESSAGES frames. A truncated log is noted as bad.

    Raises LogError for a file that is not of the format in its name, EnvironmentLackError for a missing package.
    """
    try:
        reader = _reader(path)
    except NotImplementedError as error:  # python-can names the package
        raise EnvironmentLackError(f"{path}: {error}; for .mf4: pip install asammdf") from error
    except Exception as error:  # readers raise various exceptions for a damaged file
        raise LogError(
            f"{path}: can't be read as {path.suffix}: {error or type(error).__name__}; the file is damaged or of "
            "another format"
        ) from error
    messages = iter(reader)
    empty = True
    try:
        while packed := _packed(path, messages, notes):
            empty = False
            yield np.frombuffer(bytearray(packed), dtype=FRAME)
        if empty and not notes.bad and not notes.skipped:
            notes.note_bad(UNREADABLE, f"{path}: no message in it, or damaged")
    finally:
        reader.stop()


def _reader(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".blf":  # its reader does not close a file that it rejects
        file = path.open("rb")
        try:
            return can.BLFReader(file)
        except BaseException:
            file.close()
            raise
    return can.LogReader(path, **({"relative_timestamp": False} if suffix == ".asc" else {}))


def _packed(path: Path, messages: Iterator[can.Message], notes: LogNotes) -> bytes:
    """Return the next frames, as bytes. Empty at the end."""
    rows = bytearray()
    while not rows:
        count = 0
        try:
            for message in islice(messages, BLOCK_MESSAGES):
                count += 1
                rows += _row(path, message, notes)
        except InputError:
            raise
        except Exception as error:  # as above
            notes.note_bad(UNREADABLE, f"{path}: truncated: {error or type(error).__name__}")
            break
        if not count:
            break
    return bytes(rows)


def _row(path: Path, message: can.Message, notes: LogNotes) -> bytes:
    if message.is_fd:
        notes.skip(FD)
        return b""
    name = "can" if message.channel is None else str(message.channel)
    channel = notes.channel(f"can{name}" if name.isdecimal() else name)
    if channel is None:
        notes.note_bad("interface", f"{path}: more than {len(notes.channels)} different channels")
        return b""
    # A float has no nanosecond resolution for present times: digits below a microsecond are noise.
    t_ns = round(message.timestamp * 1e6) * 1000
    length = message.dlc if message.is_remote_frame else len(message.data)
    data = b"" if message.is_remote_frame else bytes(message.data[:8])
    return _PACK(t_ns, raw_can_id(message), min(length, 8), channel, 0 if message.is_rx else SENT, data)
