"""SDO transfers seen from outside: one node's requests and responses as text (CiA 301, 7.2.4), with objects' names."""

import struct
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

from canopen_device import types
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import describe
from tipforce.dictionary.service_texts import abort_text
from tipforce.errors import InputError

_SHOWN_BYTES = 32
_MOST_BYTES = 1 << 20  # of a transfer that never ends


Describe: TypeAlias = Callable[[int, int, int], Entry[Any] | None]
"""(node-id, index, sub-index) -> name, unit and type of the object, or None."""


def fingertip_names(gauges: int = 3) -> Describe:
    """Return the names of fingertips with so many gauges."""
    return lambda _node_id, index, sub: describe(index, sub, gauges)


def eds_names(files: Iterable[tuple[int, str]], otherwise: Describe) -> Describe:
    """Return names by (node-id, EDS or DCF), else ``otherwise``. Raises InputError for a file that is no EDS."""
    from canopen_device.eds.reader import read_eds

    known = {node_id: read_eds(path, node_id) for node_id, path in files}

    def of_file(node_id: int, index: int, sub: int) -> Entry[Any] | None:
        if node_id not in known:
            return otherwise(node_id, index, sub)
        entry = known[node_id].entry(index, sub)
        return None if entry is None else Entry(index, sub, entry.letter, entry.name, entry.access, entry.unit)

    return of_file


class SdoConversation:
    """The transfer with one node. Values of segmented and block transfers are shown when they are complete. ``written``
    is (index, sub-index, content) of a download that the last ``response`` confirms, otherwise None."""

    def __init__(self, node_id: int, describe: Describe) -> None:
        self._node_id, self._describe = node_id, describe
        self._place = (0, 0)
        self._data, self._segments = bytearray(), bytearray()
        self._sent: tuple[int, int, bytes] | None = None  # a complete download, not confirmed yet
        self.written: tuple[int, int, bytes] | None = None
        self._block, self._block_size = "", 0  # "download" or "upload" while raw block segments follow
        self._ended = False  # the last segment of the block transfer has passed

    def request(self, data: bytes) -> str:
        """Return the text of a client's frame."""
        if self._block == "download" and data[0] != 0x80:
            return self._block_segment(data)
        command = data[0] >> 5
        if data[0] == 0x80:
            return self._abort(data, "client")
        if command == 0:
            return self._segment(data, "write")
        if command == 1:
            self._start(data)
            if data[0] & 2:
                self._sent = *self._place, _expedited(data)
            return f"SDO write {self._name()}{self._initiated(data)}"
        if command == 2:
            self._start(data)
            return f"SDO read {self._name()}"
        if command == 3:
            return f"SDO read {self._name()}: next segment"
        if command == 6:
            return self._block_download(data)
        return self._block_upload(data) if command == 5 else f"SDO request {data.hex(' ').upper()}"

    def response(self, data: bytes) -> str:
        """Return the text of a server's frame."""
        self.written = None
        if self._block == "upload" and data[0] != 0x80:
            return self._block_segment(data)
        command = data[0] >> 5
        if data[0] == 0x80:
            return self._abort(data, "node")
        if command == 2:
            self._start(data)
            return f"SDO {self._name()}{self._initiated(data)}"
        if command == 3:
            self._place = struct.unpack_from("<HB", data, 1)
            self._confirm()
            return f"SDO written {self._name()}"
        if command == 0:
            return self._segment(data, "read")
        if command == 1:
            self._confirm()
            return f"SDO write {self._name()}: segment received"
        if command == 5:
            return self._block_download_response(data)
        return self._block_upload_response(data) if command == 6 else f"SDO response {data.hex(' ').upper()}"

    def _start(self, data: bytes) -> None:
        self._place = struct.unpack_from("<HB", data, 1)
        self._data.clear()
        self._sent = None
        self._block, self._ended = "", False

    def _confirm(self) -> None:
        if self._sent is not None and self._sent[:2] == self._place:
            self.written, self._sent = self._sent, None

    def _initiated(self, data: bytes) -> str:
        if data[0] & 2:  # expedited
            return f" = {self._value(_expedited(data), exact=bool(data[0] & 1))}"
        return f": {struct.unpack_from('<I', data, 4)[0]} bytes follow" if data[0] & 1 else ": segments follow"

    def _segment(self, data: bytes, verb: str) -> str:
        self._add(data[1 : 8 - (data[0] >> 1 & 7)])
        if not data[0] & 1:
            return f"SDO {verb} {self._name()}: segment, {len(self._data)} bytes so far"
        if verb == "write":
            self._sent = *self._place, bytes(self._data)
        return f"SDO {verb} {self._name()} = {self._value(bytes(self._data))}"

    def _add(self, data: bytes) -> None:
        if len(self._data) < _MOST_BYTES:
            self._data += data

    def _abort(self, data: bytes, side: str) -> str:
        self._block, self._sent = "", None
        index, sub, code = struct.unpack_from("<HBI", data, 1)
        self._place = index, sub
        return f"SDO abort by the {side} {self._name()}: 0x{code:08X}, {abort_text(code)}"

    def _block_download(self, data: bytes) -> str:
        if data[0] & 1:
            content = self._block_content(data)
            self._sent = *self._place, content
            return f"SDO block write {self._name()} = {self._value(content)}"
        self._start(data)
        return f"SDO block write {self._name()}{_size(data)}"

    def _block_content(self, data: bytes) -> bytes:
        return bytes(self._data[: len(self._data) - (data[0] >> 2 & 7)])

    def _block_download_response(self, data: bytes) -> str:
        kind = data[0] & 3
        if kind == 1:
            self._confirm()
            return f"SDO block written {self._name()}"
        if kind == 0:
            self._block_size = data[4]
        else:
            self._take_segments(data[1])
            self._block_size = data[2]
        whole = kind == 2 and self._ended
        self._block, self._segments = "" if whole else "download", bytearray()
        now = "segments received" if whole else f"ready for {self._block_size} segments"
        return f"SDO block write {self._name()}: {now}"

    def _block_upload(self, data: bytes) -> str:
        kind = data[0] & 3
        if kind == 0:
            self._start(data)
            self._block_size = data[4]
            return f"SDO block read {self._name()}"
        if kind == 1:
            return f"SDO block read {self._name()}: end"
        if kind == 2:
            self._take_segments(data[1])
            self._block_size = self._block_size if self._ended else data[2]
        self._block, self._segments = "" if kind == 2 and self._ended else "upload", bytearray()
        return f"SDO block read {self._name()}: {'start' if kind == 3 else 'segments received'}"

    def _block_upload_response(self, data: bytes) -> str:
        if data[0] & 1:
            return f"SDO block read {self._name()} = {self._value(self._block_content(data))}"
        return f"SDO block {self._name()}{_size(data)}"

    def _block_segment(self, data: bytes) -> str:
        number, self._ended = data[0] & 0x7F, bool(data[0] & 0x80)
        self._segments += data[1:]
        if self._ended or number >= self._block_size:
            self._block = ""  # the receiver confirms now
        return f"SDO block {self._name()}: segment {number}{', the last' if self._ended else ''}"

    def _take_segments(self, confirmed: int) -> None:
        self._add(bytes(self._segments[: 7 * confirmed]))
        if 7 * confirmed < len(self._segments):
            self._ended = False
        self._segments = bytearray()

    def _name(self) -> str:
        entry, place = self._describe(self._node_id, *self._place), "0x{:04X}:{:02X}".format(*self._place)
        return place if entry is None or entry.name == place else f"{entry.name} ({place})"

    def _value(self, content: bytes, *, exact: bool = True) -> str:
        found = self._describe(self._node_id, *self._place)
        if found is not None:
            size = types.data_type(found.type).size
            data = content[:size] if not exact and size is not None else content
            try:
                value = types.decode(found.type, data)
                if not isinstance(value, bytes):
                    return f"{types.format_value(found.type, value)} {found.unit}".rstrip()
            except InputError:
                pass
        shown = content[:_SHOWN_BYTES].hex(" ").upper()
        return shown if len(content) <= _SHOWN_BYTES else f"{shown} ... ({len(content)} bytes)"


def _expedited(data: bytes) -> bytes:
    return data[4 : 8 - (data[0] >> 2 & 3) if data[0] & 1 else 8]


def _size(data: bytes) -> str:
    return f", {struct.unpack_from('<I', data, 4)[0]} bytes" if data[0] & 2 else ""
