"""SDO server (CiA 301, 7.2.4): expedited and segmented transfers, one at a time."""

import struct

from . import codes

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device

TIMEOUT_US = 1000000  # a client that says nothing for so long has lost its transfer
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 0, 1, 2, 3, 4  # client command specifiers
_IDLE = 0
MAX_DOWNLOAD_BYTES = 4096  # bound on memory where an object itself states no length


class SdoServer:
    """The default SDO server: frames of 8 bytes in on 0x600 + id, answers out on 0x580 + id."""

    __slots__ = ("_buffer", "_device", "_index", "_offset", "_size", "_sub", "_toggle", "_transfer", "due_us")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self.reset()

    def reset(self) -> None:
        """Forget any transfer."""
        self._transfer = _IDLE
        self._buffer: "bytes | bytearray" = b""
        self._index = self._sub = self._offset = self._toggle = 0
        self._size: "int | None" = None
        self.due_us = codes.NEVER_US

    def receive(self, data: bytes) -> None:
        """Act on a request. A frame that has not 8 bytes is no SDO and is ignored (7.2.4.3)."""
        if len(data) != 8:
            return
        specifier = data[0] >> 5
        if specifier == _DOWNLOAD:
            self._begin(data)
            self._download_initiate(data)
        elif specifier == _UPLOAD:
            self._begin(data)
            self._upload_initiate()
        elif specifier == _ABORT:
            self.reset()
        elif self._transfer == _DOWNLOAD and specifier == _DOWNLOAD_SEGMENT:
            self._download_segment(data)
        elif self._transfer == _UPLOAD and specifier == _UPLOAD_SEGMENT:
            self._upload_segment(data)
        else:
            if self._transfer == _IDLE:
                # No transfer to name: answer with the multiplexer that the request itself carries.
                self._begin(data)
            self._abort(codes.UNKNOWN_COMMAND)

    def expire(self, _now_us: int) -> None:
        """The client was silent for too long: end the transfer and say so."""
        self._abort(codes.TIMEOUT)

    def _begin(self, data: bytes) -> None:
        self.reset()
        self._index, self._sub = data[1] | data[2] << 8, data[3]

    def _answer(self, data: bytes) -> None:
        self._device.send(0x580 + self._device.node_id, data + bytes(8 - len(data)))
        if self._transfer != _IDLE:
            self.due_us = self._device.now_us + TIMEOUT_US

    def _head(self, command: int) -> bytes:
        return struct.pack("<BHB", command, self._index, self._sub)

    def _abort(self, code: int) -> None:
        head = self._head(0x80)
        self.reset()
        self._answer(head + struct.pack("<I", code))

    # --- upload: the client reads ---------------------------------------------------------------------------

    def _upload_initiate(self) -> None:
        data = self._device.upload(self._index, self._sub)
        if isinstance(data, int):
            self._abort(data)
        elif 0 < len(data) <= 4:
            self._answer(self._head(0x43 | (4 - len(data)) << 2) + data)
        else:
            self._transfer, self._buffer = _UPLOAD, data
            self._answer(self._head(0x41) + struct.pack("<I", len(data)))

    def _upload_segment(self, data: bytes) -> None:
        if data[0] >> 4 & 1 != self._toggle:
            self._abort(codes.TOGGLE)
            return
        part = bytes(self._buffer[self._offset : self._offset + 7])
        self._offset += len(part)
        last = self._offset >= len(self._buffer)
        command = self._toggle << 4 | (7 - len(part)) << 1 | last
        self._toggle ^= 1
        if last:
            self.reset()
        self._answer(bytes((command,)) + part)

    # --- download: the client writes ------------------------------------------------------------------------

    def _download_initiate(self, data: bytes) -> None:
        command = data[0]
        if command & 2:
            self._download_expedited(data)
            return
        # Bit 0 says that the size stands in the data; without it the size is known at the end only.
        self._size = struct.unpack("<I", data[4:])[0] if command & 1 else None
        abort = self._device.od.writable(self._index, self._sub, self._size)
        if not abort and self._size is not None and self._size > self._limit():
            abort = codes.TOO_LONG
        if abort:
            self._abort(abort)
            return
        self._transfer, self._buffer = _DOWNLOAD, bytearray()
        self._answer(self._head(0x60))

    def _download_expedited(self, data: bytes) -> None:
        length = 4
        if data[0] & 1:
            length = 4 - (data[0] >> 2 & 3)
        elif not self._device.od.writable(self._index, self._sub, None):
            # No size stated: the object's own length decides, as far as four bytes can carry it.
            length = min(4, self._device.od.expected_size(self._index, self._sub) or 4)
        self._finish(data[4 : 4 + length])

    def _download_segment(self, data: bytes) -> None:
        if data[0] >> 4 & 1 != self._toggle:
            self._abort(codes.TOGGLE)
            return
        part = data[1 : 8 - (data[0] >> 1 & 7)]
        self._buffer += part
        if len(self._buffer) > (self._limit() if self._size is None else self._size):
            self._abort(codes.TOO_LONG)
        elif not data[0] & 1:
            command = 0x20 | self._toggle << 4
            self._toggle ^= 1
            self._answer(bytes((command,)))
        elif self._size is not None and len(self._buffer) < self._size:
            self._abort(codes.TOO_SHORT)
        else:
            self._finish(bytes(self._buffer), 0x20 | self._toggle << 4)

    def _limit(self) -> int:
        return self._device.od.expected_size(self._index, self._sub) or MAX_DOWNLOAD_BYTES

    def _finish(self, data: bytes, command: "int | None" = None) -> None:
        """Hand the complete data over; the answer says whether it was taken."""
        head = self._head(0x60) if command is None else bytes((command,))
        abort = self._device.od.download(self._index, self._sub, data)
        if abort:
            self._abort(abort)
        else:
            self.reset()
            self._answer(head)
