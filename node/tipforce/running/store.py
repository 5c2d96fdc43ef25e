"""Parameters on disk in two slots: each save replaces the older one as a whole, so a sound one is always left."""

from __future__ import annotations

import binascii
import contextlib
import json
import logging
import os
from pathlib import Path
from typing import NamedTuple

from tipforce.errors import InputError

_LOG = logging.getLogger(__name__)
_DAMAGED = b"\0"  # too short for a CRC: the device core reports the group as damaged


class _Slot(NamedTuple):
    """What a file holds. ``sound``: it is as it was written; if not, ``groups`` is what can still be read of it."""

    path: Path
    sequence: int
    groups: dict[str, str]
    sound: bool


class FileStore:
    """``save`` and ``load`` of a device in two files, ``path`` and ``path`` with ``.2`` added.

    Each is JSON: a sequence number, the groups (name -> hex), a CRC-32 over both. A save writes the slot with the lower
    number: to a temporary file beside it that is flushed to the disk (fsync) and takes the name in one step (rename);
    then the directory is flushed; ``save`` returns only then. A slot that is torn or corrupt is said once on the
    log, and the other one holds. Without a sound slot the groups that can be read are given as they are: each has
    a CRC of its own, which the device checks. Raises InputError if ``path`` is a directory or lies in a directory that
    does not exist.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path).absolute()
        if self._path.is_dir():
            raise InputError(f"store {self._path}: is a directory; give the name of a file, for example node-5.json")
        if not self._path.parent.is_dir():
            raise InputError(f"store {self._path}: the directory {self._path.parent} does not exist; create it first")
        self._paths = self._path, self._path.with_name(self._path.name + ".2")
        self._temporary = self._path.with_name(self._path.name + ".new")
        self._said: set[str] = set()  # each trouble once, until a save succeeds

    def save(self, group: str, data: bytes) -> bool:
        """Replace one group; False, with the reason in the log, when the disk refuses."""
        try:
            slots = self._slots()
            newest = _newest(slots)
            groups = dict(newest.groups) if newest is not None else {}
            groups[group] = data.hex()
            sequence = 1 + max((slot.sequence for slot in slots if slot.sound), default=0)
            self._replace(self._target(slots), _text(sequence, groups))
        except OSError as error:
            self._say(
                f"{error.strerror}; nothing was changed, and storing is refused (06060000h) until the disk takes it"
            )
            with contextlib.suppress(OSError):
                self._temporary.unlink()  # half a file on a full disk helps nobody
            return False
        self._said.clear()
        return True

    def load(self, group: str) -> bytes | None:
        """What was stored for ``group``; None if nothing was, bytes that fail their CRC if the files are damaged."""
        try:
            slots = self._slots()
        except OSError as error:
            self._say(f"{error.strerror}; starting with defaults")
            return _DAMAGED
        newest = _newest(slots)
        if newest is None:
            return _DAMAGED if slots else None
        if group not in newest.groups:
            return None
        try:
            return bytes.fromhex(newest.groups[group])
        except (TypeError, ValueError):
            return _DAMAGED

    def _slots(self) -> list[_Slot]:
        """The slots that there are.

        Raises OSError if the disk does not give a file: what it holds must then not be replaced either.
        """
        found = []
        for path in self._paths:
            try:
                slot = _parsed(path, path.read_bytes())
            except FileNotFoundError:
                continue
            if not slot.sound:
                self._say(f"{path.name} is not what was stored")
            found.append(slot)
        if any(slot.sound for slot in found) and not all(slot.sound for slot in found):
            self._say("the other slot holds: settings are those of the save before, or of the last one")
        return found

    def _target(self, slots: list[_Slot]) -> Path:
        """Where the next save goes: the slot that is missing, then one that is damaged, then the older."""
        there = {slot.path: slot.sequence if slot.sound else 0 for slot in slots}
        return min(self._paths, key=lambda path: there.get(path, -1))

    def _say(self, trouble: str) -> None:
        if trouble not in self._said:
            self._said.add(trouble)
            _LOG.error("store %s: %s", self._path, trouble)

    def _replace(self, path: Path, content: bytes) -> None:
        with open(self._temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(self._temporary, path)
        if os.name == "posix":
            directory = os.open(self._path.parent, os.O_RDONLY)
            try:
                os.fsync(directory)
            finally:
                os.close(directory)


def _newest(slots: list[_Slot]) -> _Slot | None:
    """The sound slot that was written last; without one, the one of which most can be read."""
    sound = [slot for slot in slots if slot.sound]
    if sound:
        return max(sound, key=lambda slot: slot.sequence)
    readable = [slot for slot in slots if slot.groups]
    return max(readable, key=lambda slot: len(slot.groups)) if readable else None


def _text(sequence: int, groups: dict[str, str]) -> bytes:
    content = {"sequence": sequence, "crc32": _crc32(sequence, groups), "groups": groups}
    return json.dumps(content, indent=1).encode() + b"\n"


def _crc32(sequence: int, groups: dict[str, str]) -> str:
    """Over a form of the content that no reformatting of the file changes."""
    return f"{binascii.crc32(json.dumps([sequence, groups], sort_keys=True).encode()):08x}"


def _parsed(path: Path, content: bytes) -> _Slot:
    try:
        found = json.loads(content)
        if isinstance(found, dict) and found and all(isinstance(text, str) for text in found.values()):
            return _Slot(path, 0, found, True)  # the form before there were two slots: the groups alone
        sequence, groups = found["sequence"], found["groups"]
        readable = isinstance(groups, dict) and isinstance(sequence, int)
        sound = readable and found["crc32"] == _crc32(sequence, groups)
    except (ValueError, RecursionError, KeyError, TypeError):
        return _Slot(path, 0, {}, False)
    return _Slot(path, sequence, groups, sound) if readable else _Slot(path, 0, {}, False)
