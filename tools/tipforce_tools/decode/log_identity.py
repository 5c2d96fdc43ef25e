"""Recognise a log by its content and its options: a copy, and one that has grown."""

from __future__ import annotations

import hashlib
import zlib
from contextlib import suppress
from pathlib import Path

from tipforce.host.decoding.log_part import Reading
from tipforce.host.logs.lines import open_file
from tipforce.host.logs.reader import log_kind
from tipforce.host.logs.unpacking import decompressed
from tipforce.visible_text import visible

HASHED_BYTES = 1 << 16
_COMPARED_BYTES = 1 << 12


def begin_hash(name: str) -> str:
    """Return the SHA-256 of the first bytes of a text, packed or not; of another log, which has a header, of all."""
    start = bytearray()
    with open_file(Path(name)) as file, suppress(OSError, EOFError, zlib.error):
        if log_kind(Path(name)) != "text":
            return hashlib.file_digest(file, "sha256").hexdigest()
        unpacked, block = decompressed(file, name), bytearray(_COMPARED_BYTES)
        while len(start) < _COMPARED_BYTES and (count := unpacked.readinto(block)):
            start += block[:count]
    return hashlib.sha256(start[:_COMPARED_BYTES]).hexdigest()


def is_whole(path: Path, size: int) -> bool:
    """Return whether a file is there, with its size in bytes."""
    return path.is_file() and path.stat().st_size == size


def hash_of(name: str, start: int, end: int) -> str:
    """Return the SHA-256 of bytes of a log. Raises InputError for a log that can't be opened."""
    with open_file(Path(name)) as file:
        file.seek(start)
        return hashlib.sha256(file.read(end - start) or b"").hexdigest()


def tail_hash(name: str, end: int) -> str:
    """Return the SHA-256 of the last bytes in front of ``end``."""
    return hash_of(name, max(end - HASHED_BYTES, 0), end)


def options_of(reading: Reading, hand: str | None) -> str:
    """Return what the rows of a log depend on besides its bytes."""
    layouts = reading.layouts
    words = [f"gauges {layouts.gauges}"]
    origin = reading.origin_ns or 0
    start, end = (
        limit and f"{limit.ns + (origin if limit.relative else 0)} ns" for limit in (reading.start, reading.end)
    )
    given = (
        ("nodes", layouts.nodes), ("signals", reading.signals), ("buses", reading.buses), ("hand", hand),
        ("from", start), ("to", end), ("deltas", reading.deltas), ("dbc", layouts.dbc), ("eds", layouts.eds),
    )  # fmt: skip
    words += [f"{name} {value}" for name, value in given if value]
    if layouts.pdos:
        words.append(f"layouts {hashlib.sha256(repr(layouts).encode()).hexdigest()[:12]}")
    return visible(", ".join(words))  # JSON has no surrogates, which names of files may have
