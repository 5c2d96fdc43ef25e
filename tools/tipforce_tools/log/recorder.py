"""Write frames to one or more log files in sequence, and count them.

A recording is written under its own name, so that a killed process leaves its frames there. One that replaces an old
log (--overwrite) is written beside it and renamed when it is complete.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Self

from tipforce.errors import InputError, WriteError
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.output_file import check_output
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
