"""Store parameters on disk in two slots: each save replaces the older slot completely, so one slot is always intact."""

import binascii
import contextlib
import json
import logging
import os
from pathlib import Path
from typing import NamedTuple

from canopen_device.errors import InputError

_LOG = logging.getLogger(__name__)
_DAMAGED = b"\0"  # too short for a CRC: the device core reports the group as damaged


class _Slot(NamedTuple):
    """The content of a file. ``sound``: the CRC is correct; otherwise ``groups`` holds what can still be read."""

    path: Path
    sequence: int
    groups: dict[str, str]
    sound: bool


class FileStore:
    """``save`` and ``load`` in two JSON files, ``path`` and ``path.2``: sequence number, groups (name -> hex), CRC-32.

    A save replaces the lower number: temporary file, fsync, rename, fsync of the directory. A corrupt slot is logged,
    and the other applies; without an intact one the readable groups are returned: the device checks the CRC of each.
    Raises InputError if ``path`` is a directory or in none, or a text that no store wrote: a save would replace it."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path).absolute()
        if self._path.is_dir():
            raise InputError(f"store {self._path}: is a directory; give the name of a file, for example node-5.json")
        if not self._path.parent.is_dir():
            raise InputError(f"store {self._path}: the directory {self._path.parent} does not exist; create it first")
        with contextlib.suppress(OSError):
            text = self._path.read_bytes()
            if b"\n" in text and not text.startswith(b"{") and b'"groups"' not in text:
                raise InputError(f"store {self._path}: is not a store of a node; give the name of a new file")
        self._paths = self._path, self._path.with_name(self._path.name + ".2")
        self._temporary = self._path.with_name(self._path.name + ".new")
        self._said: set[str] = set()  # each fault is logged once, until a save succeeds

    def save(self, group: str, data: bytes) -> bool:
        """Replace one group; return False, with the reason in the log, if the disk rejects it."""
        try:
            slots = self._slots()
            newest = _newest(slots)
            groups = {**(newest.groups if newest is not None else {}), group: data.hex()}
            sequences = {slot.path: slot.sequence if slot.sound else 0 for slot in slots}
            # The missing slot is replaced, else a damaged one, else the older one.
            target = min(self._paths, key=lambda path: sequences.get(path, -1))
            sequence = 1 + max(sequences.values(), default=0)
            content = {"sequence": sequence, "crc32": _crc32(sequence, groups), "groups": groups}
            self._replace(target, json.dumps(content, indent=1).encode() + b"\n")
        except OSError as error:
            rejected = "stores are rejected (06060000h) until the disk accepts them"
            self._say(f"{error.strerror}; nothing was changed; {rejected}")
            with contextlib.suppress(OSError):
                self._temporary.unlink()  # half a file on a full disk is useless
            return False
        self._said.clear()
        return True

    def load(self, group: str) -> bytes | None:
        """Return the data stored for ``group``; None if absent, bytes with a wrong CRC if the files are damaged."""
        try:
            slots = self._slots()
        except OSError as error:
            self._say(f"{error.strerror}; starting with defaults")
            return _DAMAGED
        newest = _newest(slots)
        if newest is None:
            return _DAMAGED if slots else None
        try:
            return bytes.fromhex(newest.groups[group]) if group in newest.groups else None
        except (TypeError, ValueError):
            return _DAMAGED

    def _slots(self) -> list[_Slot]:
        """The existing slots. Raises OSError for a file that cannot be read: it must not be replaced either."""
        slots = []
        for path in self._paths:
            with contextlib.suppress(FileNotFoundError):
                slots.append(_parsed(path, path.read_bytes()))
        damaged = [slot.path.name for slot in slots if not slot.sound]
        for name in damaged:
            self._say(f"{name} is damaged")
        if 0 < len(damaged) < len(slots):
            self._say("the other slot applies: settings are those of the previous or of the last save")
        return slots

    def _say(self, trouble: str) -> None:
        if trouble not in self._said:
            self._said.add(trouble)
            _LOG.error("store %s: %s", self._path, trouble)

    def _replace(self, path: Path, content: bytes) -> None:
        self._temporary.unlink(missing_ok=True)
        with open(self._temporary, "xb") as file:  # new: a link of that name is not followed
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
    """Return the intact slot that was written last; without one, the slot of which most can be read."""
    usable = [slot for slot in slots if slot.sound or slot.groups]
    return max(usable, key=lambda slot: (slot.sound, slot.sequence if slot.sound else len(slot.groups)), default=None)


def _crc32(sequence: int, groups: dict[str, str]) -> str:
    """Return a CRC-32 that does not depend on the formatting of the file."""
    return f"{binascii.crc32(json.dumps([sequence, groups], sort_keys=True).encode()):08x}"


def _parsed(path: Path, content: bytes) -> _Slot:
    with contextlib.suppress(ValueError, RecursionError, KeyError, TypeError):
        stored = json.loads(content)
        if isinstance(stored, dict) and stored and all(isinstance(text, str) for text in stored.values()):
            return _Slot(path, 0, stored, True)  # earlier format without slots: only the groups
        sequence, groups = stored["sequence"], stored["groups"]
        if isinstance(groups, dict) and isinstance(sequence, int):
            return _Slot(path, sequence, groups, stored["crc32"] == _crc32(sequence, groups))
    return _Slot(path, 0, {}, False)
