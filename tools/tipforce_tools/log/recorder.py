"""Write frames to one or more log files in sequence, and count them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Self

from tipforce.errors import InputError
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce_tools.log.writers import LogWriter, format_suffix, open_writer


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
        self._writer = self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(self, block: CandumpBlock) -> None:
        """Append a block, to the next file if this one is full or old enough. Raises OSError if the disk is full."""
        if not len(block):
            return
        if self._is_over():
            self._writer.close()
            self._writer = self._open()
        self._writer.write(block)
        self.frames += len(block)

    def _is_over(self) -> bool:
        if self._limit_s is not None and time.monotonic() - self._begun_s >= self._limit_s:
            return True
        return self._limit_bytes is not None and self.paths[-1].stat().st_size >= self._limit_bytes

    def _open(self) -> LogWriter:
        path = self._path
        if self._limit_bytes is not None or self._limit_s is not None:
            stem, dot, suffixes = path.name.partition(".")
            path = path.with_name(f"{stem}-{len(self.paths) + 1:04d}{dot}{suffixes}")
        if path.exists() and not self._overwrite:
            raise InputError(f"{path} exists: choose another name, or add --overwrite")
        try:
            writer = open_writer(path)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        self.paths.append(path)
        self._begun_s = time.monotonic()
        return writer
