"""SDO block transfer, server side (CiA 301, 7.2.4.2.9 to 7.2.4.2.16): up to 127 segments per response."""

import struct

from . import codes

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .sdo_server import SdoServer

_NIBBLE = (
    0x0000, 0x1021, 0x2042, 0x3063, 0x4084, 0x50A5, 0x60C6, 0x70E7,
    0x8108, 0x9129, 0xA14A, 0xB16B, 0xC18C, 0xD1AD, 0xE1CE, 0xF1EF,
)  # fmt: skip


def crc16_by_nibbles(data: "bytes | bytearray", crc: int = 0) -> int:
    """Continue ``crc`` (7.2.4.3.16: x^16 + x^12 + x^5 + 1, start 0); 16 entries instead of 256 save memory."""
    for byte in data:
        crc = (crc << 4 & 0xFFFF) ^ _NIBBLE[crc >> 12 ^ byte >> 4]
        crc = (crc << 4 & 0xFFFF) ^ _NIBBLE[crc >> 12 ^ byte & 15]
    return crc


try:
    from binascii import crc_hqx
except ImportError:  # MicroPython has no binascii.crc_hqx
    crc_hqx = None  # type: ignore[assignment]


def crc16(data: "bytes | bytearray", crc: int = 0) -> int:
    """Continue ``crc`` over ``data``, with the interpreter's function if it has one."""
    return crc_hqx(data, crc) if crc_hqx is not None else crc16_by_nibbles(data, crc)


MAX_BLOCK = 127
_ABORT_BY_CLIENT = 0x80
_LAST = 0x80
_WITH_CRC = 4


class BlockDownload:
    """Block download; segments out of order are discarded. The sink gets a block before the response."""

    def __init__(self, server: "SdoServer", size: "int | None", limit: int, with_crc: bool) -> None:
        self._server = server
        self._size = size
        self._limit = limit if size is None else size
        self._with_crc = with_crc
        self._buffer = bytearray()  # what the sink has not: the segments of this block, or the last ones
        self._length = self._crc = 0  # of what the sink has
        self._expected, self._latest = 1, 0  # segment numbers of this block
        self._ending, self._patience = False, True
        server.answer(server.head(0xA0 | _WITH_CRC) + bytes((MAX_BLOCK,)))

    def takes(self, _command: int) -> bool:
        """Return True: every frame belongs to this transfer; a segment's first byte may look like any command."""
        return True

    def receive(self, data: bytes) -> None:
        """Process a frame during this transfer."""
        if data[0] == _ABORT_BY_CLIENT:
            self._server.reset()
        elif self._ending:
            self._end(data)
        else:
            self._segment(data)

    def expire(self) -> None:
        """Handle silence for half the time-out: the last segment of a block may be lost. Acknowledge once."""
        if self._ending or not self._patience:
            self._server.abort(codes.TIMEOUT)
            return
        self._patience = False
        self._acknowledge()

    def _segment(self, data: bytes) -> None:
        number, last = data[0] & 0x7F, data[0] & _LAST
        if not 1 <= number <= MAX_BLOCK:
            self._server.abort(codes.BLOCK_SEQUENCE)
            return
        if number == self._expected:
            self._expected += 1
            self._patience = True
            self._buffer += data[1:]
            self._ending = bool(last)
            # The last segment may contain up to 7 unused bytes; their number is known only at the end.
            if self._length + len(self._buffer) - (7 if last else 0) > self._limit:
                self._server.abort(codes.TOO_LONG)
                return
        latest, self._latest = self._latest, number
        if last or number == MAX_BLOCK:
            self._acknowledge()
        elif number > latest:  # what repeats itself, as a request that starts with 40h does, holds the server no longer
            self._server.wait()

    def _acknowledge(self) -> None:
        received, self._expected, self._latest = self._expected - 1, 1, 0
        if not self._ending:
            part, self._buffer = bytes(self._buffer), bytearray()
            self._count(part)
            if not self._server.write(part):
                return
        self._server.answer(bytes((0xA2, received, MAX_BLOCK)))

    def _count(self, part: bytes) -> None:
        self._length += len(part)
        if self._with_crc:
            self._crc = crc16(part, self._crc)

    def _end(self, data: bytes) -> None:
        if data[0] & 0xE3 != 0xC1:
            self._server.abort(codes.UNKNOWN_COMMAND)
            return
        part = bytes(self._buffer[: len(self._buffer) - (data[0] >> 2 & 7)])
        self._count(part)
        if self._with_crc and self._crc != data[1] | data[2] << 8:
            self._server.abort(codes.BLOCK_CRC)
        elif self._size is not None and self._length != self._size:
            self._server.abort(codes.TOO_LONG if self._length > self._size else codes.TOO_SHORT)
        else:
            self._server.end(part, b"\xa1")


class BlockUpload:
    """Block upload: send blocks; repeat the segments that the client did not acknowledge."""

    def __init__(self, server: "SdoServer", data: bytes, block_size: int, with_crc: bool) -> None:
        self._server = server
        self._data = data
        self._block_size = block_size
        self._with_crc = with_crc
        self._offset = self._sent = self._crc = 0
        self._started = self._ending = False
        # Bit 1: the response contains the size; bit 2: this server computes the CRC.
        server.answer(server.head(0xC0 | _WITH_CRC | 2) + struct.pack("<I", len(data)))

    def takes(self, command: int) -> bool:
        """Return True for a frame of block upload or an abort; any other request ends this transfer."""
        return command & 0xE3 in (0xA1, 0xA2, 0xA3) or command >> 5 == 4

    def receive(self, data: bytes) -> None:
        """Process a frame during this transfer."""
        command = data[0]
        if command >> 5 == 4:
            self._server.reset()
        elif command & 0xE3 == 0xA3 and not self._started:
            self._started = True
            self._send_block()
        elif command & 0xE3 == 0xA2 and self._started and not self._ending:
            self._acknowledged(data[1], data[2])
        elif command & 0xE3 == 0xA1 and self._ending:
            self._server.reset()
        else:
            self._server.abort(codes.UNKNOWN_COMMAND)

    def expire(self) -> None:
        """Abort after the client's time-out."""
        self._server.abort(codes.TIMEOUT)

    def _send_block(self) -> None:
        offset = self._offset
        for number in range(1, self._block_size + 1):
            self._sent = number
            part = self._data[offset : offset + 7]
            offset += 7
            last = offset >= len(self._data)
            self._server.answer(bytes((number | (_LAST if last else 0),)) + part)
            if last:
                break

    def _acknowledged(self, received: int, block_size: int) -> None:
        if received > self._sent or not 1 <= block_size <= MAX_BLOCK:
            self._server.abort(codes.BLOCK_SEQUENCE if received > self._sent else codes.BLOCK_SIZE)
            return
        self._block_size = block_size
        done = self._data[self._offset : self._offset + 7 * received]
        if self._with_crc:  # otherwise the CRC field is 0 (7.2.4.3.16)
            self._crc = crc16(done, self._crc)
        self._offset += 7 * received
        if self._offset < len(self._data) or (received == 0 and not self._data):
            self._send_block()
            return
        self._ending = True
        unused = self._offset - len(self._data)
        self._server.answer(bytes((0xC1 | unused << 2, self._crc & 0xFF, self._crc >> 8)))
