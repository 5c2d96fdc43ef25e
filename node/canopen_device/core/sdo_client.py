"""SDO client (CiA 301, 7.2.4): one transfer as a state machine, responses and time in, requests and due time out."""

import struct

from . import codes
from .sdo_block import MAX_BLOCK, crc16

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    Conversation = Generator[bool, "bytes | None", None]
    Exchange = Generator[bool, "bytes | None", bytes]

MAX_UPLOAD_BYTES = 1 << 20  # bounds memory, whatever a server announces or sends; the EDS in 1021h has 72 kB
_ABORT = 0x80
_UPLOAD_SEGMENT, _DOWNLOAD_SEGMENT, _UPLOAD, _DOWNLOAD = 0, 1, 2, 3  # server command specifiers


class TransferError(Exception):
    """The server violated the protocol, or was silent: the abort code that the client sends, and a text."""


class Transfer:
    """One transfer with the default SDO server of a node, led by ``step`` until ``ended``: by ``abort_code``, by
    ``failure`` of the client ("": no response), or with ``data``. ``ignored``: the last foreign frame."""

    def __init__(self, index: int, sub: int, timeout_us: int, deadline_us: int) -> None:
        """``timeout_us`` is the time for each response; ``deadline_us`` is the latest end, on the clock of ``step``."""
        self.place = struct.pack("<HB", index, sub)
        self._timeout_us = timeout_us
        self._deadline_us = deadline_us
        self._due_us = -1  # not started
        self._patient = False
        self.nameless = True  # an abort without an object counts; not where the segments of a block are aborted
        self._requests: "list[bytes]" = []
        self._conversation = self._converse()
        self.ended = False
        self.data = b""
        self.abort_code: "int | None" = None
        self.failure: "str | None" = None
        self.ignored: "bytes | None" = None

    def step(self, now_us: int, response: "bytes | None" = None) -> "tuple[list[bytes], int]":
        """Start, or process a response or the time that has passed; return (requests of 8 bytes, next due time)."""
        self._requests = []
        if not self.ended:
            try:
                self._advance(now_us, response)
            except StopIteration:
                self._end()
            except TransferError as error:
                self._give_up(*error.args)
        return self._requests, self._due_us

    def cancel(self) -> "list[bytes]":
        """End the transfer on the client's own decision; return the abort request, if one is due."""
        self._requests = []
        if not self.ended:
            self._give_up(codes.GENERAL, "cancelled")
        return self._requests

    def _advance(self, now_us: int, response: "bytes | None") -> None:
        accepted = False
        if self._due_us < 0:
            accepted = next(self._conversation)
        elif response is not None and now_us < self._deadline_us:
            accepted = self._receive(response)
        if self.ended:
            return
        if not accepted and now_us >= self._due_us:
            if now_us >= self._deadline_us:
                raise TransferError(codes.TIMEOUT, "the transfer exceeded its deadline")
            if not self._patient:
                raise TransferError(codes.TIMEOUT, "")
            self._patient = False
            accepted = self._conversation.send(None)
        if accepted:
            self._due_us = min(now_us + self._timeout_us, self._deadline_us)

    def _receive(self, response: bytes) -> bool:
        if len(response) != 8:
            return self._ignore(response)
        if response[0] == _ABORT:
            # Some servers do not name the object when no transfer is active.
            if response[1:4] != self.place and not (self.nameless and response[1:4] == b"\0\0\0"):
                return self._ignore(response)
            self.abort_code = int.from_bytes(response[4:], "little")
            self._end()
            return True
        return self._conversation.send(response)

    def _converse(self) -> "Conversation":
        """Send requests and receive responses; a false value yielded says that the response was not for us."""
        raise NotImplementedError

    def _end(self) -> None:
        self.ended = True
        self._due_us = codes.NEVER_US
        self._conversation.close()  # releases its buffers

    def _give_up(self, code: int, text: str) -> None:
        self._send(bytes((_ABORT,)) + self.place + struct.pack("<I", code))
        self.failure = text
        self._end()

    def _send(self, data: bytes) -> None:
        self._requests.append(data + bytes(8 - len(data)))

    def _ignore(self, response: "bytes | None") -> bool:
        self.ignored = response
        return False

    def _awaited(self, belongs: "Callable[[bytes], bool]") -> "Exchange":
        """Return the next response that belongs to what was sent; silence and other responses change nothing."""
        response = yield True
        while response is None or not belongs(response):
            response = yield self._ignore(response)
        return response

    def _initiate(self, command: int, content: bytes, specifiers: "tuple[int, ...]") -> "Exchange":
        self._send(bytes((command,)) + self.place + content)
        return (yield from self._awaited(lambda r: r[1:4] == self.place and r[0] >> 5 in specifiers))

    def _segment(self, request: bytes, specifier: int, toggle: int) -> "Exchange":
        """Send a segment or the request of one; return the response, whose toggle bit must be the request's."""
        self._send(request)
        response = yield from self._awaited(lambda r: r[0] >> 5 == specifier)
        if response[0] & 0x10 != toggle:
            raise TransferError(codes.TOGGLE, "a segment has the wrong toggle bit")
        return response


class Upload(Transfer):
    """Expedited or segmented upload: read an object. ``limit`` bounds its size in bytes."""

    def __init__(self, index: int, sub: int, timeout_us: int, deadline_us: int, limit: int = MAX_UPLOAD_BYTES) -> None:
        super().__init__(index, sub, timeout_us, deadline_us)
        self._limit = limit

    def _converse(self) -> "Conversation":
        first = yield from self._initiate(_UPLOAD << 5, b"", (_UPLOAD,))
        yield from self._uploaded(first)

    def _uploaded(self, first: bytes) -> "Conversation":
        command = first[0]
        if command & 2:
            # Without a size the server leaves the number of bytes to the object's type.
            self.data = first[4 : 8 - (command >> 2 & 3)] if command & 1 else first[4:]
            return
        size = self._announced(first) if command & 1 else None
        content, toggle, last = bytearray(), 0, 0
        while not last:
            response = yield from self._segment(bytes((0x60 | toggle,)), _UPLOAD_SEGMENT, toggle)
            part, last = response[1 : 8 - (response[0] >> 1 & 7)], response[0] & 1
            if not part and not last:
                raise TransferError(codes.UNKNOWN_COMMAND, "an empty segment is not the last one")
            content += part
            self._check_size(len(content), size, last)
            toggle ^= 0x10
        self.data = bytes(content)

    def _announced(self, first: bytes) -> int:
        size = int.from_bytes(first[4:], "little")
        if size > self._limit:
            raise TransferError(codes.OUT_OF_MEMORY, f"{size} bytes announced, allowed are {self._limit}")
        return size

    def _check_size(self, length: int, size: "int | None", complete: "int | bool") -> None:
        allowed = self._limit if size is None else size
        if length > allowed:
            what = "allowed" if size is None else "announced"
            raise TransferError(codes.TOO_LONG, f"more bytes than the {allowed} {what}")
        if complete and size is not None and length < size:
            raise TransferError(codes.TOO_SHORT, f"{length} bytes of {size} announced")


class Download(Transfer):
    """Expedited (1 to 4 bytes) or segmented download; ``progress`` gets the number of acknowledged bytes."""

    def __init__(
        self, index: int, sub: int, timeout_us: int, deadline_us: int, content: bytes,
        progress: "Callable[[int], None] | None" = None,
    ) -> None:  # fmt: skip
        super().__init__(index, sub, timeout_us, deadline_us)
        self._content = content
        self._progress = progress or (lambda _length: None)

    def _converse(self) -> "Conversation":
        content = self._content
        if 0 < len(content) <= 4:
            yield from self._initiate(0x23 | (4 - len(content)) << 2, content, (_DOWNLOAD,))
            return
        yield from self._initiate(0x21, struct.pack("<I", len(content)), (_DOWNLOAD,))
        toggle = 0
        for start in range(0, len(content) or 1, 7):
            part = content[start : start + 7]
            command = toggle | (7 - len(part)) << 1 | (start + 7 >= len(content))
            yield from self._segment(bytes((command,)) + part, _DOWNLOAD_SEGMENT, toggle)
            self._progress(min(start + 7, len(content)))
            toggle ^= 0x10


SWITCH_BYTES = 28  # four segments: data this short is as fast without blocks (protocol switch threshold, 7.2.4.3.13)
_BLOCK_DOWNLOAD, _BLOCK_UPLOAD = 5, 6  # server command specifiers
_LAST, _WITH_CRC, _WITH_SIZE = 0x80, 4, 2
_MOST_EMPTY_BLOCKS = 3


class BlockUpload(Upload):
    """Block upload; the server may switch to segments if the data is short."""

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
        end = yield from self._awaited(lambda r: r[0] & 0xE3 == 0xC1)
        content = bytes(self._received[: len(self._received) - (end[0] >> 2 & 7)])
        if first[0] & _WITH_CRC and crc16(content) != end[1] | end[2] << 8:
            raise TransferError(codes.BLOCK_CRC, "the CRC of the blocks is wrong")
        self._check_size(len(content), self._size, True)
        self._send(b"\xa1")
        self.data = content

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
                self._received += segment[1:]
                self._complete = bool(last)
                self._patient = True
                # The last segment may contain up to 7 unused bytes; their number is known only at the end.
                self._check_size(len(self._received) - (7 if last else 0), self._size, False)
            else:
                self._ignore(segment)
            if last or number == MAX_BLOCK:
                break
        self._empty_blocks = 0 if count else self._empty_blocks + 1
        if self._empty_blocks == _MOST_EMPTY_BLOCKS:
            raise TransferError(codes.BLOCK_SEQUENCE, f"{_MOST_EMPTY_BLOCKS} blocks had no segment in order")
        self._patient = self._patient and not self._complete
        self._send(bytes((0xA2, count, MAX_BLOCK)))


class BlockDownload(Download):
    """Block download; segments that the server does not acknowledge are repeated."""

    def _converse(self) -> "Conversation":
        content = self._content
        command = 0xC0 | _WITH_CRC | _WITH_SIZE
        first = yield from self._initiate(command, struct.pack("<I", len(content)), (_BLOCK_DOWNLOAD,))
        offset, block_size, empty_blocks = 0, first[4], 0
        while offset < (len(content) or 1):
            sent = self._send_block(offset, block_size)
            response = yield from self._awaited(lambda r: r[0] & 0xE3 == 0xA2)
            if response[1] > sent:
                raise TransferError(codes.BLOCK_SEQUENCE, f"{response[1]} segments acknowledged of {sent} sent")
            empty_blocks = 0 if response[1] else empty_blocks + 1
            if empty_blocks == _MOST_EMPTY_BLOCKS:
                raise TransferError(codes.BLOCK_SEQUENCE, f"no segment of {_MOST_EMPTY_BLOCKS} blocks was acknowledged")
            offset, block_size = offset + 7 * response[1], response[2]
            self._progress(min(offset, len(content)))
        crc = crc16(content) if first[0] & _WITH_CRC else 0
        self._send(bytes((0xC1 | (offset - len(content)) << 2, crc & 0xFF, crc >> 8)))
        yield from self._awaited(lambda r: r[0] & 0xE3 == 0xA1)

    def _send_block(self, offset: int, block_size: int) -> int:
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
