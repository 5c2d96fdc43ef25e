"""SDO block transfer, client side (CiA 301, 7.2.4.2.9 to 7.2.4.2.16): up to 127 segments per response."""

import struct

from . import codes
from .crc16 import crc16
from .sdo_block import MAX_BLOCK
from .sdo_client import Download, TransferError, Upload

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .sdo_client import Conversation, Exchange


SWITCH_BYTES = 28  # four segments: data this short is as fast without blocks (protocol switch threshold, 7.2.4.3.13)
_UPLOAD, _BLOCK_DOWNLOAD, _BLOCK_UPLOAD = 2, 5, 6  # server command specifiers
_LAST, _WITH_CRC, _WITH_SIZE = 0x80, 4, 2
_MOST_EMPTY_BLOCKS = 3


class BlockUpload(Upload):
    """Block upload; the server may switch to segments if the data is short."""

    __slots__ = ("_complete", "_empty_blocks", "_received", "_size")

    def _converse(self) -> "Conversation":
        content = bytes((MAX_BLOCK, SWITCH_BYTES))
        first = yield from self._initiate(0xA0 | _WITH_CRC, content, (_UPLOAD, _BLOCK_UPLOAD))
        if first[0] >> 5 == _UPLOAD:
            yield from self._uploaded(first)
            return
        self._size = self._announced(first) if first[0] & _WITH_SIZE else None
        self._received = bytearray()
        self._complete = False
        self._empty_blocks = 0
        self._send(b"\xa3")
        while not self._complete:
            yield from self._block()
        response = yield True
        while response is None or response[0] & 0xE3 != 0xC1:
            response = yield self._ignore(response)
        self._finish(response, bool(first[0] & _WITH_CRC))

    def _block(self) -> "Conversation":
        """Receive one block and acknowledge its segments up to the first that is missing; the server repeats these."""
        count = 0
        accepted = True  # the request before this block
        while True:
            segment = yield accepted
            if segment is None:  # the last segments of the block may be lost
                break
            number, last = segment[0] & 0x7F, segment[0] & _LAST
            if not number:
                raise TransferError(codes.BLOCK_SEQUENCE, "a segment has the sequence number 0")
            accepted = number == count + 1
            if accepted:
                count = number
                self._append(segment[1:], bool(last))
            else:
                self._ignore(segment)
            if last or number == MAX_BLOCK:
                break
        self._empty_blocks = 0 if count else self._empty_blocks + 1
        if self._empty_blocks == _MOST_EMPTY_BLOCKS:
            raise TransferError(codes.BLOCK_SEQUENCE, f"{_MOST_EMPTY_BLOCKS} blocks had no segment in order")
        self._patient = self._patient and not self._complete
        self._send(bytes((0xA2, count, MAX_BLOCK)))

    def _append(self, part: bytes, last: bool) -> None:
        self._received += part
        self._complete = last
        self._patient = True
        # The last segment may contain up to 7 unused bytes; their number is known only at the end.
        self._check_size(len(self._received) - (7 if last else 0), self._size, False)

    def _finish(self, end: bytes, with_crc: bool) -> None:
        content = bytes(self._received[: len(self._received) - (end[0] >> 2 & 7)])
        if with_crc and crc16(content) != end[1] | end[2] << 8:
            raise TransferError(codes.BLOCK_CRC, "the CRC of the blocks is wrong")
        self._check_size(len(content), self._size, True)
        self._send(b"\xa1")
        self.data = content


class BlockDownload(Download):
    """Block download; segments that the server does not acknowledge are repeated."""

    __slots__ = ()

    def _converse(self) -> "Conversation":
        content = self._content
        first = yield from self._initiate(
            0xC0 | _WITH_CRC | _WITH_SIZE, struct.pack("<I", len(content)), (_BLOCK_DOWNLOAD,)
        )
        offset, block_size, empty_blocks = 0, first[4], 0
        while offset < (len(content) or 1):
            sent = self._send_block(offset, block_size)
            response = yield from self._response(0xA2)
            if response[1] > sent:
                raise TransferError(codes.BLOCK_SEQUENCE, f"{response[1]} segments acknowledged of {sent} sent")
            empty_blocks = 0 if response[1] else empty_blocks + 1
            if empty_blocks == _MOST_EMPTY_BLOCKS:
                raise TransferError(codes.BLOCK_SEQUENCE, f"no segment of {_MOST_EMPTY_BLOCKS} blocks was acknowledged")
            offset, block_size = offset + 7 * response[1], response[2]
            self._arrived(offset)
        crc = crc16(content) if first[0] & _WITH_CRC else 0
        self._send(bytes((0xC1 | (offset - len(content)) << 2, crc & 0xFF, crc >> 8)))
        yield from self._response(0xA1)

    def _send_block(self, offset: int, block_size: int) -> int:
        """Send the segments of one block; return their number."""
        if not 1 <= block_size <= MAX_BLOCK:
            raise TransferError(codes.BLOCK_SIZE, f"block size {block_size}, allowed are 1 to {MAX_BLOCK}")
        content = self._content
        for number in range(1, block_size + 1):
            last = offset + 7 >= len(content)
            part = content[offset : offset + 7]
            self._send(bytes((number | (_LAST if last else 0),)) + part)
            offset += 7
            if last:
                break
        return number

    def _response(self, command: int) -> "Exchange":
        response = yield True
        while response is None or response[0] & 0xE3 != command:
            response = yield self._ignore(response)
        return response
