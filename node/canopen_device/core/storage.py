"""Objects 1010h and 1011h (CiA 301, 7.5.2.13, 7.5.2.14). The content of a group is one byte string: CRC-32, then
records of index, sub-index, length and data. The caller provides ``save(group, data) -> bool``, ``load(group) -> bytes
| None``."""

import binascii
import struct

from . import codes, communication
from .emcy import WEAR_BUDGET_EMPTY
from .object_dictionary import check, decode, encode, is_setting

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from .node import Device
    from .object_dictionary import ObjectDictionary, Value

    Group = tuple[str, Callable[[], bytes], Callable[[bytes | None], None]]
    Blob = tuple[str, bytes]  # name, what is stored: CRC and content, or empty

ALL, COMMUNICATION, APPLICATION = 1, 2, 3  # sub-indices; an application adds groups from 4 on
_COMMUNICATION_NAME = "communication"
LSS_GROUP = "lss"  # of the stored node-id and bit rate: none of 1010h
_HEAD, _HEAD_BYTES, _LONG = "<HBH", 5, 0xFFFF  # a length from _LONG on follows in four bytes
_RESTORED = b""  # stored after a restore: empty, so the defaults apply after the next reset


class Storage:
    """Objects 1010h and 1011h; without ``save`` and ``load`` stores are rejected (06060000h). Storing other content
    clears 1020h, in the store too, unless 1020h was written after the last change (7.5.2.21)."""

    def __init__(
        self, device: "Device", save: "Callable[[str, bytes], bool] | None",
        load: "Callable[[str], bytes | None] | None",
    ) -> None:  # fmt: skip
        self._device = device
        self._save = save
        self._load = load
        self.available = save is not None  # parameters can be stored
        self.damaged: "list[str]" = []  # groups whose stored bytes failed their CRC at the last start
        self.after_communication: "Callable[[], None] | None" = None  # called when that group was restored
        self._groups: "dict[int, Group]" = {}
        self._verified = False  # 1020h was written since the last reset; ``od.edited``: a setting was changed since
        self.add_range(COMMUNICATION, _COMMUNICATION_NAME, communication.FIRST, communication.LAST)
        self.add_range(APPLICATION, "application", communication.FIRST_PROFILE, communication.LAST_PROFILE)
        od, store, restore = device.od, communication.STORE_PARAMETERS, communication.RESTORE_DEFAULTS
        od.writers[store] = lambda sub, value: self._write_command(sub, value, codes.SIGNATURE_SAVE)
        od.writers[restore] = lambda sub, value: self._write_command(sub, value, codes.SIGNATURE_LOAD)
        od.writers[communication.VERIFY_CONFIGURATION] = self._write_verification
        od.readers[store] = lambda sub: 1 if sub else od.values[store << 8]  # bit 0: stores on command, never
        od.readers[restore] = lambda sub: 1 if sub else od.values[restore << 8]  # autonomously

    def add_range(self, sub: int, name: str, first: int, last: int) -> None:
        """Add a group of every setting among the objects ``first`` to ``last`` that differs from its default."""
        od = self._device.od
        self.add_group(
            sub, name, lambda: pack_settings(od, first, last), lambda data: unpack_settings(od, first, last, data)
        )

    def add_group(
        self, sub: int, name: str, dump: "Callable[[], bytes]", restore: "Callable[[bytes | None], None]"
    ) -> None:
        """Add a group that the application serialises; ``restore(None)`` requests its defaults."""
        self._groups[sub] = (name, dump, restore)

    def restore(self, subs: "list[int] | None" = None) -> None:
        """Set the groups (all, or those given) to their stored values or their defaults; called on each reset."""
        self._verified = False
        for sub in sorted(self._groups):
            if subs is None or sub in subs:
                name, _dump, restore = self._groups[sub]
                self.damaged = [other for other in self.damaged if other != name]
                data = self.read_blob(name)
                if data is None:
                    self.damaged.append(name)
                restore(data or None)
                if sub == COMMUNICATION and self.after_communication is not None:
                    self.after_communication()

    def save_blob(self, name: str, data: bytes) -> int:
        """Store ``data`` under its own name, outside the groups of 1010h; return 0 or an abort code."""
        return self._write([(name, with_crc(data))], False)

    def read_blob(self, name: str) -> "bytes | None":
        """Return the data stored by ``save_blob``, empty if there is none, None if it is damaged."""
        blob = self._load(name) if self._load is not None else None
        if not blob:
            return b""
        sound = len(blob) >= 4 and struct.unpack("<I", blob[:4])[0] == binascii.crc32(blob[4:]) & 0xFFFFFFFF
        return blob[4:] if sound else None

    def _write_command(self, sub: int, value: "Value", signature: int) -> int:
        if value != signature:
            return codes.NOT_TRANSFERRED
        chosen = [self._groups[number] for number in sorted(self._groups) if sub in (ALL, number)]
        if signature == codes.SIGNATURE_LOAD:
            return self._write([(name, _RESTORED) for name, _dump, _restore in chosen], False)
        groups = [(name, with_crc(dump())) for name, dump, _restore in chosen]
        return self._write(groups, self._verified and not self._device.od.edited)

    def _write(self, blobs: "list[Blob]", verified: bool) -> int:
        """Write all blobs if the budget of wear allows it; return 0 or an abort code. Every write passes here."""
        if self._save is None:
            return codes.HARDWARE
        # Whether boot-up will load other content than before, besides 1020h.
        changes = [_without_1020(n, blob[4:]) != _without_1020(n, self.read_blob(n) or b"") for n, blob in blobs]
        clears = not verified and True in changes
        if clears:  # 1020h is left out, and out of what is stored already, which is written first
            name = _COMMUNICATION_NAME
            stored = self.read_blob(name) or b""
            content = _without_1020(name, stored)
            if name not in [other for other, _blob in blobs] and content != stored:
                blobs = [(name, with_crc(content))] + blobs
            else:
                blobs = [(other, with_crc(_without_1020(other, blob[4:])) if blob else blob) for other, blob in blobs]
        abort = self._device.wear.spend(len(blobs))
        if abort:
            return abort
        if clears:
            self._device.od.restore_defaults(communication.VERIFY_CONFIGURATION, communication.VERIFY_CONFIGURATION)
        for name, blob in blobs:
            if not self._save(name, blob):
                return codes.HARDWARE
        return 0

    def _write_verification(self, _sub: int, _value: "Value") -> int:
        self._verified = True
        self._device.od.edited = False
        return 0


def with_crc(data: bytes) -> bytes:
    """Return the content of a group as it is stored: CRC-32, then ``data``."""
    return struct.pack("<I", binascii.crc32(data) & 0xFFFFFFFF) + data


def pack_settings(od: "ObjectDictionary", first: int, last: int) -> bytes:
    """Return the settings that differ from their defaults, as records."""
    records = []
    for index in od.indices(first, last):
        for sub in od.subs(index):
            entry, value = od.find(index, sub), od.values[index << 8 | sub]
            if is_setting(entry) and value != od.default(index, sub):  # type: ignore[arg-type]
                data = encode(entry[0], value)  # type: ignore[index]
                head = struct.pack(_HEAD, index, sub, min(len(data), _LONG))
                records.append(head + (struct.pack("<I", len(data)) if len(data) >= _LONG else b"") + data)
    return b"".join(records)


def unpack_settings(od: "ObjectDictionary", first: int, last: int, data: "bytes | None") -> None:
    """Set the defaults, then apply the records of ``data``. A record that no longer fits the dictionary is skipped."""
    od.restore_defaults(first, last)
    for index, sub, _head, content in _records(data or b""):
        if first <= index <= last and not od.writable(index, sub, len(content)):
            entry = od.find(index, sub)
            try:
                value = decode(entry[0], content)  # type: ignore[index]
            except UnicodeError:
                continue
            if not check(entry, value):  # type: ignore[arg-type]
                od.values[index << 8 | sub] = value


def _records(data: bytes) -> "Iterator[tuple[int, int, bytes, bytes]]":
    start = _HEAD_BYTES
    while start <= len(data):
        offset = start - _HEAD_BYTES
        index, sub, length = struct.unpack(_HEAD, data[offset:start])
        if length == _LONG:
            long = int.from_bytes(data[start : start + 4], "little")
            if _LONG <= long <= len(data) - start - 4:  # else an earlier version wrote it, and it is the length
                start, length = start + 4, long
        if start + length <= len(data):
            yield index, sub, data[offset:start], data[start : start + length]
        start += length + _HEAD_BYTES


def _without_1020(name: str, data: bytes) -> bytes:
    if name != _COMMUNICATION_NAME:
        return data
    return b"".join([h + c for index, _sub, h, c in _records(data) if index != communication.VERIFY_CONFIGURATION])


OPERATIONS, PERIOD_US = 200, 18000000  # so many at once; one back in each period: full again after an hour


class WearBudget:
    """Writes of a group (1010h, 1011h, LSS) and erases (1F50h, 1F51h) that are allowed; a reset does not refill it."""

    def __init__(self, device: "Device") -> None:
        self._device = device
        self._full_us = 0  # when every operation will be back
        self._reported = False

    def drain(self) -> None:
        """Take all operations: of a restart without power-off, before which any number may have been used."""
        self._full_us = self._device.now_us + OPERATIONS * PERIOD_US

    def spend(self, operations: int) -> int:
        """Take operations, or none: return 0, or the abort code where there are too few. EMCY until full again: one."""
        now_us = self._device.now_us
        if self._full_us <= now_us:
            self._full_us = now_us
            self._reported = False
        full_us = self._full_us + operations * PERIOD_US
        if full_us - now_us <= OPERATIONS * PERIOD_US:
            self._full_us = full_us
            return 0
        if not self._reported:
            self._reported = True
            self._device.emcy.report(WEAR_BUDGET_EMPTY)
        return codes.DEVICE_STATE
