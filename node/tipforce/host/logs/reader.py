"""Read any log as blocks of frames: candump text in bulk, pcap, MCAP, and every other format by python-can."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path

from tipforce.core import core
from tipforce.errors import InputError
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump import CandumpParser
from tipforce.host.logs.lines import LineBlocks, first_bytes, open_file
from tipforce.host.logs.notes import MESSAGE_SUFFIXES, LogNotes, suffix_of

STDIN = "-"
_BLOCK_FRAMES = 45_000  # decoding a block costs about as much per node as a thousand frames
_BLOCKS_AHEAD = 2
MCAP_MAGIC = b"\x89MCAP"
_PCAP_STARTS = (b"\xa1\xb2\xc3\xd4", b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x4d\x3c\xb2\xa1", b"\x0a\x0d\x0d\x0a")


class LogReader(LogNotes, AbstractContextManager["LogReader"]):
    """Iterate over a log once as FRAME arrays; memory stays bounded. A context manager; see LogNotes. The notes are
    complete at the end of the iteration. ``channels`` grows as new interfaces occur."""

    def __init__(
        self, source: Path | str, *, strict: bool = False, follow: bool = False, deltas: bool = False,
        start_ns: int | None = None, end_ns: int | None = None, part: tuple[int, int | None] = (0, None),
        stop: Callable[[], bool] | None = None, timeout_s: float | None = None,
    ) -> None:  # fmt: skip
        """Open a log by its name and its first bytes; "-" is candump text on stdin.

        ``strict`` raises at the first bad line, after the frames before it. ``follow`` waits at the end of a text,
        until ``stop`` returns True; ``timeout_s`` without more text ends it. ``deltas``: of candump -td. ``start_ns``
        excludes earlier frames, ``end_ns`` those from then on. ``part``: bytes of a plain text (``line_borders``).
        Raises InputError for a file that can't be opened, EnvironmentLackError for a missing library; while iterating,
        InputError for a bad line, and a time selection without timestamps."""
        super().__init__(strict, str(source), goes_on=part[0] > 0)
        path = None if str(source) == STDIN else Path(source)
        self._limits = start_ns, end_ns
        self._lines: LineBlocks | None = None
        self._thread: ThreadPoolExecutor | None = None
        kind = "text" if path is None else log_kind(path)
        if path is None or kind == "text":
            # Parts are read side by side; and a thread that waits for a pipe could not be ended.
            ahead = core is not None and path is not None and path.is_file() and not follow and part == (0, None)
            notes = LogNotes(strict, bad=self.bad, skipped=self.skipped) if ahead else self
            self._lines = LineBlocks(path, notes, follow, part, stop, timeout_s)
            blocks = _text_blocks(self._lines, notes, deltas)
            self._blocks = self._read_ahead(blocks, notes) if ahead else blocks
        elif kind in {"mcap", "pcap"}:
            from tipforce.host.logs.captures import mcap_blocks, pcap_blocks

            self._blocks = mcap_blocks(path, self) if kind == "mcap" else pcap_blocks(path, self)
        else:
            from tipforce.host.logs.library_formats import message_blocks

            self._blocks = message_blocks(path, self)

    def __iter__(self) -> Iterator[FrameArray]:
        """Yield blocks of frames with start_ns <= t_ns < end_ns, none empty. Raises InputError as ``__init__`` says."""
        for block in self.blocks():
            frames = block.frames
            if self._limits != (None, None):
                if not self.timed:
                    raise InputError("the log has no timestamps, so frames cannot be selected by time")
                frames = within(frames, *self._limits)
            if len(frames):
                self.count_special(frames)
                self.frames += len(frames)
                yield frames

    def blocks(self) -> Iterator[CandumpBlock]:
        """Yield all blocks with interface names and CAN FD frames, instead of the iteration; some may be empty."""
        try:
            yield from self._blocks
        finally:
            self.close()

    def _read_ahead(self, blocks: Iterator[CandumpBlock], notes: LogNotes) -> Iterator[CandumpBlock]:
        """Yield the blocks, which a thread reads ahead: the core parses without the interpreter's lock."""
        self._thread = thread = ThreadPoolExecutor(1)
        ready = deque(thread.submit(next, blocks, None) for _ in range(_BLOCKS_AHEAD))
        try:
            while (block := ready.popleft().result()) is not None:
                ready.append(thread.submit(next, blocks, None))
                self.channels += block.names[len(self.channels) :]
                self.timed &= block.timed
                yield block
        finally:
            self.lines, self.first_bad = notes.lines, notes.first_bad

    @property
    def position(self) -> int:
        """Bytes of a text log that have been read, compressed as the file is; 0 of a pipe and of other formats."""
        return 0 if self._lines is None else self._lines.position

    def close(self) -> None:
        """Close the file; the end of the iteration also closes it."""
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)
        if self._lines is not None:
            self._lines.close()

    def __exit__(self, *_: object) -> None:
        self.close()


open_log = LogReader


def within(frames: FrameArray, start_ns: int | None, end_ns: int | None) -> FrameArray:
    """Return the frames with start_ns <= t_ns < end_ns, one of which may be None."""
    t_ns = frames["t_ns"]
    return frames.compress((start_ns is None or t_ns >= start_ns) & (end_ns is None or t_ns < end_ns))


def _text_blocks(lines: LineBlocks, notes: LogNotes, deltas: bool) -> Iterator[CandumpBlock]:
    parser = CandumpParser(notes, deltas=deltas)
    error: InputError | None = None
    try:
        for text, begin, end in lines:
            yield from parser.gather(text, begin, end)
            if lines.live or parser.count + len(parser.fd) >= _BLOCK_FRAMES:
                yield parser.take()
    except InputError as bad:  # strict: return the frames before it first
        error = bad
    yield parser.take()
    if error is not None:
        raise error


def log_kind(path: Path) -> str:
    """Return the type of a log: "text", "pcap", "mcap", "messages" (python-can). Raises InputError if it can't open."""
    if path.is_fifo():  # opening and closing a pipe would end it
        return "text"
    with open_file(path) as file:
        start = first_bytes(file)
    if start[:4] in _PCAP_STARTS:
        return "pcap"
    if start.startswith(MCAP_MAGIC):
        return "mcap"
    return "messages" if suffix_of(path)[0] in MESSAGE_SUFFIXES else "text"
