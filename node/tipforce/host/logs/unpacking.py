"""Packed logs, unpacked with a bound (megabytes can be terabytes): gzip and zstd as streams, the chunks of MCAP and the
containers of BLF at once. A real log's timestamps differ: gzip saves a factor of 5 to 15, zstd up to 60."""

import os
import zlib
from contextlib import suppress
from io import FileIO, RawIOBase
from typing import Any

from tipforce.errors import EnvironmentLackError, LogError

MOST_RATIO, FREE_BYTES = 200, 256 << 20
"""A log may unpack to so many times its bytes, and to FREE_BYTES in any case."""

MOST_CHUNK_BYTES = 256 << 20
"""Of one chunk or container, which is in memory as a whole; the usual ones have 0.1 to 4 MiB."""

LONGEST_LINE = 1 << 19
PACKED = _GZIP, _ZSTD = b"\x1f\x8b", b"\x28\xb5\x2f\xfd"
_STEP_BYTES = 1024  # bounds the output of one step


class Expansion:
    """Count what a log unpacks to."""

    def __init__(self, place: str) -> None:
        self._place = place
        self.unpacked_bytes = 0

    def take(self, packed_bytes: int, count: int) -> None:
        """Count bytes unpacked from the first ``packed_bytes`` of the file. Raises LogError beyond the limits."""
        self.unpacked_bytes += count
        if self.unpacked_bytes > max(FREE_BYTES, MOST_RATIO * packed_bytes):
            raise LogError(
                f"{self._place}: {packed_bytes} bytes unpack to more than {self.unpacked_bytes - 1}; allowed is "
                f"{MOST_RATIO} times as many, or {FREE_BYTES}; if it is a log of yours, unpack it first"
            )


def decompressed(file: FileIO, place: str) -> RawIOBase:
    """Return ``file`` itself, or its content if it is gzip or zstd (by its first bytes, not by its name). Reading
    raises LogError where it unpacks to more than ``Expansion`` allows."""
    start = first_bytes(file)
    if start.startswith(_GZIP):
        return _Gzip(file, place)
    return _Zstd(file, place) if start.startswith(_ZSTD) else file


def first_bytes(file: FileIO) -> bytes:
    """Return the first bytes of a file without consuming them; of a pipe none."""
    with suppress(OSError):
        return os.pread(file.fileno(), 16, 0)
    return b""


def unpacked_chunk(place: str, kind: str, data: bytes) -> bytes:
    """Return the content of one chunk, packed with "zlib", "zstd" or "lz4". Raises LogError above MOST_CHUNK_BYTES,
    EnvironmentLackError without the library, else what the library raises."""
    found = bytearray()
    unpack = _unpacker(place, kind)
    for at in range(0, len(data), _STEP_BYTES):
        found += unpack(data[at : at + _STEP_BYTES])
        if len(found) > MOST_CHUNK_BYTES:
            raise LogError(f"{place}: a chunk of {len(data)} bytes unpacks to more than {MOST_CHUNK_BYTES}, the limit")
    return bytes(found)


def _unpacker(place: str, kind: str) -> Any:
    try:
        if kind == "zlib":
            return zlib.decompressobj().decompress
        if kind == "zstd":
            import zstandard

            return zstandard.ZstdDecompressor().decompressobj().decompress
        if kind == "lz4":
            import lz4.frame  # type: ignore[import-untyped]

            return lz4.frame.LZ4FrameDecompressor().decompress
    except ImportError as error:
        raise EnvironmentLackError(f"{place} has {kind}: `pip install {error.name}`") from None
    raise LogError(f"{place}: a chunk is packed with {kind!r}: allowed are zstd and lz4")


class _Source(RawIOBase):
    def __init__(self, file: FileIO) -> None:
        super().__init__()
        self._file = file

    def readable(self) -> bool:
        """As of every source."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


class BoundedLines(_Source):
    """A text whose lines are no longer than LONGEST_LINE: a reader of lines keeps a whole one in memory."""

    def __init__(self, source: RawIOBase, file: FileIO, place: str) -> None:
        super().__init__(file)
        self._source, self._place = source, place
        self._line_bytes = 0

    def readinto(self, buffer: Any, /) -> int:
        """Fill the start of ``buffer``. Raises LogError for a line that is too long, else as the source."""
        count = self._source.readinto(buffer) or 0
        end = bytes(buffer[:count]).rfind(b"\n")
        self._line_bytes = self._line_bytes + count if end < 0 else count - 1 - end
        if self._line_bytes > LONGEST_LINE:
            raise LogError(f"{self._place}: a line of more than {LONGEST_LINE} bytes is not a line of a log")
        return count


class _Gzip(_Source):
    """Unpack gzip; of a truncated file return all data before the end."""

    def __init__(self, file: FileIO, place: str) -> None:
        import gzip

        super().__init__(file)
        self._expansion = Expansion(place)
        self._content = gzip.GzipFile(fileobj=file)

    def readinto(self, buffer: Any, /) -> int:
        """Fill the start of ``buffer``. Raises EOFError, OSError or zlib.error at the end of a truncated file."""
        count = self._content.readinto1(buffer)
        self._expansion.take(self._file.tell(), count)
        return count


class _Zstd(_Source):
    """Unpack zstd in steps of bounded size. zstandard's own stream reader does not detect a truncated file."""

    def __init__(self, file: FileIO, place: str) -> None:
        try:
            import zstandard
        except ImportError:
            raise EnvironmentLackError(f"{place} is zstd: `pip install 'tipforce[zstd]'`, or unpack it first") from None
        super().__init__(file)
        self._expansion = Expansion(place)
        self._library = zstandard
        self._frame: Any = None
        self._packed = b""
        self._unpacked = memoryview(b"")

    def readinto(self, buffer: Any, /) -> int:
        """Fill the start of ``buffer``. Raises EOFError for a truncated file, OSError for data that is not zstd."""
        while not self._unpacked:
            self._packed = self._packed or self._file.read(_STEP_BYTES)
            if not self._packed:
                if self._frame is not None:
                    raise EOFError("the end of the zstd frame is missing")
                return 0
            self._step()
        count = min(len(buffer), len(self._unpacked))
        buffer[:count] = self._unpacked[:count]
        self._unpacked = self._unpacked[count:]
        return count

    def _step(self) -> None:
        if self._frame is None:
            self._frame = self._library.ZstdDecompressor().decompressobj()
        try:
            self._unpacked = memoryview(self._frame.decompress(self._packed))
        except self._library.ZstdError as error:
            raise OSError(str(error)) from None
        self._expansion.take(self._file.tell(), len(self._unpacked))
        self._packed = b""
        if self._frame.eof:
            self._packed, self._frame = self._frame.unused_data, None
