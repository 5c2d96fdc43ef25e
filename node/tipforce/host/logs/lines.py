"""Read the bytes of a log: packed ones with a bound (megabytes can unpack to terabytes, real logs by 5 to 60), and text
as blocks of whole lines, also of a file that is still growing, or stdin. gzip and zstd are streams, the chunks of MCAP
and the containers of BLF are unpacked at once."""

import math
import os
import select
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import FileIO, RawIOBase
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from tipforce.errors import EnvironmentLackError, InputError, LogError, TipforceError, needing
from tipforce.host.frames.frame_block import CandumpBlock, FdFrame, gathered
from tipforce.host.logs.notes import NO_LINE, UNREADABLE, LogNotes

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
        with needing(f"{place} is zstd: `pip install 'tipforce[zstd]'`, or unpack it first"):
            import zstandard
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


BLOCK_ROWS = 8192
BLOCK_BYTES = 1 << 19
"""Small enough that a block and its results stay in the processor's cache; also the longest line."""

_POLL_S = 0.05
_LAST_S = 0.5
_BOM = b"\xef\xbb\xbf"
_KEPT_BYTES = 1 << 24


def row_blocks(path: Path, rows: Iterator[bytes | FdFrame], notes: LogNotes) -> Iterator[CandumpBlock]:
    """Yield the frames of ``rows`` in blocks. Any error of a library at a damaged file is noted as bad."""
    ended = False
    while not ended:
        some, ended, failure = list[bytes | FdFrame](), True, None
        try:
            for row in islice(rows, BLOCK_ROWS):
                ended = False
                some.append(row)
        except Exception as error:  # each library raises various ones
            failure = error
        block = gathered(some, tuple(notes.channels), notes.timed)
        if len(block):
            yield block
        if isinstance(failure, TipforceError):
            raise failure
        if failure is not None:
            notes.note_bad(UNREADABLE, f"{path}: truncated: {failure or type(failure).__name__}")
            ended = not len(block)


def open_file(path: Path) -> FileIO:
    """Open a file, unbuffered. Raises InputError."""
    try:
        return FileIO(path)
    except OSError as error:
        hint = "; a dataset is read by decode, plot, dataset and read_log" if path.is_dir() else ""
        raise InputError(f"{path}: {error.strerror}{hint}") from error


class LineBlocks:
    """Yield blocks of whole lines as (text, begin, end), the lines ``text[begin:end]``, in memory that is reused.

    Lines above BLOCK_BYTES and truncated data are noted as bad. ``source`` None is stdin; ``follow`` waits at the end
    of a file, and restarts a shorter one; ``stop`` ends both by True: a file at its end, stdin after 0.5 s; so does
    ``timeout_s`` without anything. ``live``: a consumer waits for each block. ``part``: first byte and end, both of
    ``line_borders``."""

    def __init__(
        self, source: Path | None, notes: LogNotes, follow: bool = False, part: tuple[int, int | None] = (0, None),
        stop: Callable[[], bool] | None = None, timeout_s: float | None = None,
    ) -> None:  # fmt: skip
        """Open the source. Raises InputError if that fails, EnvironmentLackError if zstd is not installed."""
        self._place = "stdin" if source is None else str(source)
        self._file = FileIO(sys.stdin.fileno(), closefd=False) if source is None else open_file(source)
        is_pipe = source is None or not source.is_file()
        if is_pipe:
            with suppress(ImportError, AttributeError, OSError):  # Linux: a pipe's buffer of a whole block
                import fcntl

                fcntl.fcntl(self._file.fileno(), fcntl.F_SETPIPE_SZ, BLOCK_BYTES)
        try:
            self._readable = decompressed(self._file, self._place)
        except BaseException:
            self._file.close()
            raise
        self._notes = notes
        self._follow = follow and self._readable is self._file
        self.live = is_pipe or self._follow
        self._stop = stop or (lambda: False)
        self._end_s: float | None = None
        self._timeout_s = math.inf if timeout_s is None else timeout_s
        self._waits = self._readable is self._file and bool(timeout_s or (source is None and stop))
        self._broken = False
        self._start, self._end = part
        if self._start:
            self._file.seek(self._start)
        # Allocated and freed once, so that the C library keeps memory freed later, up to twice as much. Otherwise each
        # block's arrays are returned to the system and mapped again, which doubles the time. It is never written.
        np.empty(_KEPT_BYTES, dtype=np.uint8)
        self._storage = bytearray(BLOCK_BYTES)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def position(self) -> int:
        """Bytes of the file that have been read; 0 of a pipe, and after ``close``."""
        try:
            return self._file.tell()
        except (OSError, ValueError):
            return 0

    def __iter__(self) -> Iterator[tuple[bytearray, int, int]]:
        storage = self._storage
        filled = 0
        skipping, first = False, not self._start
        while count := self._read(filled):
            end = storage.rfind(b"\n", filled, filled + count) + 1
            filled += count
            if not end:
                if filled == BLOCK_BYTES:
                    skipping, filled = True, 0
                continue
            begin = self._mark_bytes() if first else 0
            if skipping:
                begin = storage.index(b"\n") + 1
                self._too_long()
            if begin < end:
                yield storage, begin, end
            storage[: filled - end] = storage[end:filled]
            filled -= end
            skipping = first = False
        if skipping:
            self._too_long()
        elif filled and not self._broken:
            yield storage, self._mark_bytes() if first else 0, filled

    def _mark_bytes(self) -> int:
        """Return the size of the byte order mark, if there is one. Raises InputError for packed text."""
        if self._storage.startswith(PACKED):  # the first bytes of a pipe cannot be looked at beforehand
            raise InputError(f"{self._place}: gzip or zstd in a pipe: unpack it first, with zcat or zstdcat")
        return len(_BOM) if self._storage.startswith(_BOM) else 0

    def _read(self, filled: int) -> int:
        with memoryview(self._storage) as view:
            while not self._waits or self._wait():
                limit, stopped = BLOCK_BYTES, self._stop()  # before the read: all that stood in front of it is read
                if self._end is not None:
                    limit = min(limit, filled + self._end - self._file.tell())
                try:
                    count = self._readable.readinto(view[filled:limit]) or 0
                except (OSError, EOFError, zlib.error) as error:
                    self._broken = True
                    self._notes.note_bad(UNREADABLE, f"{self._place}: truncated: {error}")
                    return 0
                if count or not self._follow:
                    return count
                if os.fstat(self._file.fileno()).st_size < self._file.tell():
                    self._file.seek(0)
                elif stopped:
                    break
                else:
                    time.sleep(_POLL_S)
            return 0

    def _wait(self) -> bool:
        silent_s = time.monotonic() + self._timeout_s
        while True:
            now_s = time.monotonic()
            if self._end_s is not None and now_s > self._end_s:
                return False
            if self._end_s is None and self._stop():
                self._end_s = now_s + _LAST_S
            if select.select([self._file], [], [], max(min(_POLL_S, silent_s - now_s), 0.0))[0]:
                return True
            if now_s >= silent_s:  # when the last look began: it saw all that came in time
                return False

    def _too_long(self) -> None:
        text = f"{self._place}: a line of more than {BLOCK_BYTES} bytes is not a line of a log"
        self._notes.lines += 1
        self._notes.note_bad(NO_LINE, text)


def line_borders(path: Path, count: int, start: int = 0) -> list[int]:
    """Return line starts that split a plain file into ``count`` parts of similar size, fewer if lines are long. The
    first is ``start``, the last the size of the file. Raises InputError for a file that can't be opened."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        borders = [start]
        for number in range(1, count):
            place = start + (size - start) * number // count
            behind = os.pread(file.fileno(), BLOCK_BYTES, place).find(b"\n") + 1
            if behind and borders[-1] < place + behind < size:
                borders.append(place + behind)
    return [*borders, size]


def is_plain(path: Path) -> bool:
    """Return whether a file's bytes are its text: a regular file, neither gzip nor zstd. Raises InputError."""
    if not path.is_file():
        return False
    with open_file(path) as file:
        return not first_bytes(file).startswith(PACKED)
