"""SDO server (CiA 301, 7.2.4): expedited, segmented and block transfers, one at a time."""

import struct

from . import codes
from .sdo_block import MAX_BLOCK, BlockDownload, BlockUpload
from .timed import Timed

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Protocol

    from .node import Device

    class Sink(Protocol):
        """Where the content of a segmented or block download goes, in parts and in order; 0 or an abort code each."""

        def write(self, part: bytes) -> int: ...
        def end(self) -> int: ...  # all bytes have arrived, with the right CRC and length
        def cancel(self) -> None: ...  # the transfer has ended early


TIMEOUT_US = 1000000  # a client that is silent for this time loses its transfer
# Client command specifiers.
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT, _BLOCK_UPLOAD, _BLOCK_DOWNLOAD = 0, 1, 2, 3, 4, 5, 6
_IDLE = 0
MAX_DOWNLOAD_BYTES = 4096  # bounds memory for objects that state no length


class SdoServer(Timed):
    """Default SDO server: receives frames of 8 bytes on 0x600 + node-id, responds on 0x580 + node-id."""

    def __init__(self, device: "Device") -> None:
        super().__init__(device)
        self.max_download_bytes = MAX_DOWNLOAD_BYTES
        self.sink: "Sink | None" = None
        self.reset()

    def reset(self) -> None:
        """Discard any transfer."""
        self._transfer = _IDLE
        self._block: "BlockDownload | BlockUpload | None" = None
        self._buffer: "bytes | bytearray" = b""
        sink, self.sink = self.sink, None
        if sink is not None:
            sink.cancel()
        self._index = self._sub = self._offset = self._toggle = 0
        self._size: "int | None" = None
        self.due_us = codes.NEVER_US

    def receive(self, data: bytes) -> None:
        """Process a request. A frame without exactly 8 bytes is not an SDO and is ignored (7.2.4.3)."""
        if len(data) != 8:
            return
        if self._block is not None and self._block.takes(data[0]):
            self._block.receive(data)
            return
        specifier = data[0] >> 5
        if specifier in (_DOWNLOAD, _UPLOAD, _BLOCK_DOWNLOAD, _BLOCK_UPLOAD):
            self.reset()  # an initiate request ends an active transfer (7.2.4.2)
            self._name(data)
            self._begin(specifier, data)
        elif specifier == _ABORT:
            self.reset()
        elif (self._transfer, specifier) in ((_DOWNLOAD, _DOWNLOAD_SEGMENT), (_UPLOAD, _UPLOAD_SEGMENT)):
            if data[0] >> 4 & 1 != self._toggle:
                self.abort(codes.TOGGLE)
            elif specifier == _DOWNLOAD_SEGMENT:
                self._download_segment(data)
            else:
                self._upload_segment()
        else:
            if self._transfer == _IDLE:
                # No transfer is active: respond with the multiplexer of the request.
                self._name(data)
            self.abort(codes.UNKNOWN_COMMAND)

    def expire(self, _now_us: int) -> None:
        """Abort the transfer of a client that was silent for too long."""
        if self._block is not None:
            self._block.expire()
        else:
            self.abort(codes.TIMEOUT)

    def _begin(self, specifier: int, data: bytes) -> None:
        """Process an initiate request. Where the size is not stated, it is known only at the end."""
        command, size = data[0], struct.unpack("<I", data[4:])[0]
        if specifier == _DOWNLOAD and command & 2:
            self._download_expedited(data)
        elif specifier == _DOWNLOAD:
            if self._may_download(size if command & 1 else None):
                self._transfer = _DOWNLOAD
                self.answer(self.head(0x60))
        elif specifier == _UPLOAD:
            self._upload_initiate(self._device.upload(self._index, self._sub))
        elif specifier == _BLOCK_UPLOAD and command & 3 == 0:
            self._block_upload_initiate(data[4], data[5], bool(command & 4))
        elif specifier == _BLOCK_DOWNLOAD and command & 1 == 0:
            if self._may_download(size if command & 2 else None):
                self._transfer = _BLOCK_DOWNLOAD
                self._block = BlockDownload(self, self._size, self._limit(), bool(command & 4))
        else:
            self.abort(codes.UNKNOWN_COMMAND)

    def _name(self, data: bytes) -> None:
        self._index, self._sub = data[1] | data[2] << 8, data[3]

    def head(self, command: int) -> bytes:
        """Return the command byte, index and sub-index of the transfer."""
        return struct.pack("<BHB", command, self._index, self._sub)

    def answer(self, data: bytes) -> None:
        """Send a response, padded to 8 bytes, and wait for the client while a transfer is active."""
        self._device.send(codes.SDO_RESPONSE_BASE + self._device.node_id, data + bytes(8 - len(data)))
        if self._transfer != _IDLE:
            self.wait()

    def wait(self) -> None:
        """Restart the client's time-out; after half of it, a block download acknowledges what it has received."""
        patience_us = TIMEOUT_US // 2 if self._transfer == _BLOCK_DOWNLOAD else TIMEOUT_US
        self.due_us = self._device.now_us + patience_us

    def abort(self, code: int) -> None:
        """End the transfer and send the abort code to the client."""
        head = self.head(0x80)
        self.reset()
        self.answer(head + struct.pack("<I", code))

    def write(self, part: bytes) -> bool:
        """Write the next part of a download; return False where it was aborted."""
        abort = 0
        if self.sink is None:
            self._buffer += part  # of an ordinary object: written when it is complete
        elif part:
            abort = self.sink.write(part)
        if abort:
            self.abort(abort)
        return not abort

    def end(self, part: bytes, confirmation: bytes) -> None:
        """Write the last part of a download and end it; confirm it, or abort if the object rejects the content."""
        if self.write(part):
            sink, self.sink, od = self.sink, None, self._device.od
            abort = od.download(self._index, self._sub, bytes(self._buffer)) if sink is None else sink.end()
            self._finish(abort, confirmation)

    def _finish(self, abort: int, confirmation: bytes) -> None:
        if abort:
            self.abort(abort)
        else:
            self.reset()
            self.answer(confirmation)

    def _upload_initiate(self, data: "bytes | int") -> None:
        if isinstance(data, int):
            self.abort(data)
        elif 0 < len(data) <= 4:
            self.answer(self.head(0x43 | (4 - len(data)) << 2) + data)
        else:
            self._transfer, self._buffer = _UPLOAD, data
            self.answer(self.head(0x41) + struct.pack("<I", len(data)))

    def _upload_segment(self) -> None:
        part = bytes(self._buffer[self._offset : self._offset + 7])
        self._offset += len(part)
        last = self._offset >= len(self._buffer)
        command = self._toggle << 4 | (7 - len(part)) << 1 | last
        self._toggle ^= 1
        if last:
            self.reset()
        self.answer(bytes((command,)) + part)

    def _block_upload_initiate(self, block_size: int, switch_bytes: int, with_crc: bool) -> None:
        data = self._device.upload(self._index, self._sub)
        if not isinstance(data, int) and not 1 <= block_size <= MAX_BLOCK:
            self.abort(codes.BLOCK_SIZE)
        elif isinstance(data, int) or (switch_bytes and len(data) <= switch_bytes):
            # Protocol switch (pst): data this short is faster without blocks (7.2.4.3.13); pst 0 forbids the switch.
            self._upload_initiate(data)
        else:
            self._transfer = _BLOCK_UPLOAD
            self._block = BlockUpload(self, data, block_size, with_crc)

    def _may_download(self, size: "int | None") -> bool:
        self._size = size
        od, index, sub = self._device.od, self._index, self._sub
        abort = od.writable(index, sub, size)
        if not abort and index in od.sinks:
            sink = od.sinks[index](sub, size)
            if isinstance(sink, int):
                abort = sink
            else:
                self.sink = sink
        elif not abort:
            self._buffer = bytearray()
            abort = codes.TOO_LONG if size is not None and size > self._limit() else 0
        if abort:
            self.abort(abort)
        return not abort

    def _download_expedited(self, data: bytes) -> None:
        length = 4
        if data[0] & 1:
            length = 4 - (data[0] >> 2 & 3)
        elif not self._device.od.writable(self._index, self._sub, None):
            # No size given: the object's own length decides, up to four bytes.
            length = min(4, self._device.od.expected_size(self._index, self._sub) or 4)
        self._finish(self._device.od.download(self._index, self._sub, data[4 : 4 + length]), self.head(0x60))

    def _download_segment(self, data: bytes) -> None:
        part = data[1 : 8 - (data[0] >> 1 & 7)]
        self._offset += len(part)
        confirmation = bytes((0x20 | self._toggle << 4,))
        self._toggle ^= 1
        if self._offset > (self._limit() if self._size is None else self._size):
            self.abort(codes.TOO_LONG)
        elif data[0] & 1 and self._size is not None and self._offset < self._size:
            self.abort(codes.TOO_SHORT)
        elif data[0] & 1:
            self.end(part, confirmation)
        elif self.write(part):
            self.answer(confirmation)

    def _limit(self) -> int:
        return self._device.od.expected_size(self._index, self._sub) or self.max_download_bytes
