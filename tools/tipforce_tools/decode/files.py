"""Copy bytes of files."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

_BLOCK_BYTES = 1 << 20


def append_bytes(path: Path, start: int, end: int, out: BinaryIO) -> None:
    """Append bytes of a file; where the system can, they do not pass through this process. ``out`` is flushed."""
    with path.open("rb") as file:
        file.seek(start)
        with suppress(AttributeError, OSError):
            while start < end and (count := os.copy_file_range(file.fileno(), out.fileno(), end - start, start)):
                start += count
        out.seek(0, os.SEEK_END)
        file.seek(start)
        while start < end:
            block = file.read(min(_BLOCK_BYTES, end - start))
            out.write(block)
            start += len(block)
