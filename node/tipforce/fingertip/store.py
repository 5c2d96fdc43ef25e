"""Parameters on disk: one file per node, replaced as a whole: it is the old or the new one, never a mixture."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

from tipforce.errors import InputError

_LOG = logging.getLogger(__name__)
_DAMAGED = b"\0"  # too short for a CRC: the device core reports the group as damaged


class FileStore:
    """``save`` and ``load`` of a device, kept as JSON (group name -> hex) in ``path``.

    A write goes to a temporary file beside it, is flushed to the disk (fsync), takes the name in one step (rename),
    and the directory is flushed too; ``save`` returns only then. Raises InputError if ``path`` is a directory or lies
    in a directory that does not exist.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path).absolute()
        if self._path.is_dir():
            raise InputError(f"store {self._path}: is a directory; give the name of a file, for example node-5.json")
        if not self._path.parent.is_dir():
            raise InputError(f"store {self._path}: the directory {self._path.parent} does not exist; create it first")
        self._temporary = self._path.with_name(self._path.name + ".new")

    def save(self, group: str, data: bytes) -> bool:
        """Replace one group; False, with the reason in the log, when the disk refuses."""
        try:
            groups = self._read() or {}
            groups[group] = data.hex()
            self._replace(json.dumps(groups, indent=1).encode() + b"\n")
        except OSError as error:
            _LOG.error("store %s: %s; nothing was changed", self._path, error.strerror)
            return False
        return True

    def load(self, group: str) -> bytes | None:
        """What was stored for ``group``; None if nothing was, bytes that fail their CRC if the file is damaged."""
        try:
            groups = self._read()
        except OSError as error:
            _LOG.error("store %s: %s; starting with defaults", self._path, error.strerror)
            return _DAMAGED
        if groups is None:
            return _DAMAGED
        try:
            return bytes.fromhex(groups[group]) if group in groups else None
        except (TypeError, ValueError):
            return _DAMAGED

    def _read(self) -> dict[str, str] | None:
        """All groups; empty if there is no file yet, None if it does not hold what ``save`` writes.

        Raises OSError if the disk does not give the file: what it holds must then not be replaced either.
        """
        try:
            content = json.loads(self._path.read_bytes())
        except FileNotFoundError:
            return {}
        except (ValueError, RecursionError) as error:
            _LOG.error("store %s: not what was stored (%s)", self._path, error)
            return None
        return content if isinstance(content, dict) else None

    def _replace(self, content: bytes) -> None:
        with open(self._temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(self._temporary, self._path)
        if os.name == "posix":
            directory = os.open(self._path.parent, os.O_RDONLY)
            try:
                os.fsync(directory)
            finally:
                os.close(directory)
