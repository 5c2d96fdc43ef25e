"""Any log as blocks of frames: candump's text by the bulk reader, every other format by python-can, and pcap."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import numpy as np

from tipforce.errors import InputError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.logs.candump import BadLine, BadLineError, CandumpParser
from tipforce.host.logs.candump_bulk import CandumpBulk
from tipforce.host.logs.lines import LineBlocks, first_bytes, open_file
from tipforce.host.logs.log_statistics import DROPPED, FD, LogNotes

STDIN = "-"
MESSAGE_SUFFIXES = (".asc", ".blf", ".csv", ".db", ".mf4", ".trc")
"""What python-can's readers take; behind each there may be .gz."""

_BLOCK_FRAMES = 40_000  # decoding a block costs about as much for each node as for a thousand frames
_ROOM_FRAMES = 65_536
_PCAP_STARTS = (b"\xa1\xb2\xc3\xd4", b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x4d\x3c\xb2\xa1", b"\x0a\x0d\x0d\x0a")


class LogReader(LogNotes):
    """Iterates over a log once, giving FRAME arrays; memory stays bounded. A context manager; see LogNotes.

    The notes are complete when the iteration has ended. ``channels`` grows as interfaces show up.
    """

    def __init__(
        self,
        source: Path | None,
        *,
        strict: bool = False,
        follow: bool = False,
        deltas: bool = False,
        start_ns: int | None = None,
        end_ns: int | None = None,
        part: tuple[int, int | None] = (0, None),
    ) -> None:
        """See ``open_log``. ``first_bad_line`` and the number of ``lines`` are those of a text."""
        super().__init__(strict)
        self.first_bad_line: BadLine | None = None
        self.lines = 0
        self._limits = start_ns, end_ns
        self._lines: LineBlocks | None = None
        kind = "text" if source is None else log_kind(source)
        if source is None or kind == "text":
            self._lines = LineBlocks(source, self, follow, part)
            self._blocks = self._text_blocks(self._lines, deltas)
        elif kind == "pcap":
            from tipforce.host.logs.pcap import pcap_blocks

            self._blocks = pcap_blocks(source, self)
        else:
            from tipforce.host.logs.library_formats import message_blocks

            self._blocks = message_blocks(source, self)

    def __iter__(self) -> Iterator[FrameArray]:
        """Blocks of frames with start_ns <= t_ns < end_ns, none empty. Raises InputError as ``open_log`` says."""
        try:
            for block in self._blocks:
                frames = self._within_limits(block)
                if len(frames):
                    self.count_special(frames)
                    yield frames
        finally:
            self.close()

    def _within_limits(self, frames: FrameArray) -> FrameArray:
        start, end = self._limits
        if start is None and end is None:
            return frames
        self._check_timed()
        t_ns = frames["t_ns"]
        wanted = np.ones(len(t_ns), dtype=np.bool_) if start is None else t_ns >= start
        return frames[wanted if end is None else wanted & (t_ns < end)]

    def _check_timed(self) -> None:
        if not self.timed:
            raise InputError("the log has no timestamps, so no part of it can be taken by time")

    def _text_blocks(self, lines: LineBlocks, deltas: bool) -> Iterator[FrameArray]:
        parser = CandumpParser(strict=self.strict, deltas=deltas)
        bulk = CandumpBulk(parser)
        self.channels = bulk.names
        gathered = _Gathered()
        error: InputError | None = None
        try:
            for text, begin, end in lines:
                parser.line_number += lines.left_out
                lines.left_out = 0
                yield from gathered.add(bulk.parse(text, begin, end, gathered.room))
                self.timed = bulk.timed
                self._take_counts(parser)
                if lines.live or gathered.count >= _BLOCK_FRAMES:
                    yield gathered.take()
        except InputError as bad:  # strict: the frames before it come first
            error = bad
            if isinstance(bad, BadLineError):
                self.first_bad_line = bad.bad
                yield from gathered.add(bad.block.frames)
        self.timed = bulk.timed
        self._take_counts(parser)
        self.lines = parser.line_number + lines.left_out
        yield gathered.take()
        if error is not None:
            raise error

    def _take_counts(self, parser: CandumpParser) -> None:
        """Move what the parser has counted to the notes."""
        self.skip(FD, parser.fd_frames)
        self.skip(DROPPED, parser.dropped)
        parser.fd_frames = parser.dropped = 0
        for reason, count in parser.bad.items():
            self.bad[reason] = self.bad.get(reason, 0) + count
        parser.bad.clear()
        if self.first_bad is None and parser.bad_lines:
            self.first_bad_line = parser.bad_lines[0]
            self.first_bad = str(self.first_bad_line)

    def close(self) -> None:
        """Close the file; the end of the iteration does, too."""
        if self._lines is not None:
            self._lines.close()

    def __enter__(self) -> LogReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Gathered:
    """Frames of several blocks of text, made in one array: ``room`` is what is left of it, ``count`` what is filled."""

    def __init__(self) -> None:
        self.count = 0
        self._frames: FrameArray = np.empty(_ROOM_FRAMES, dtype=FRAME)

    @property
    def room(self) -> FrameArray:
        """Where the next frames may be made."""
        return self._frames[self.count :]

    def add(self, frames: FrameArray) -> Iterator[FrameArray]:
        """Take frames that were made in ``room``, or elsewhere; what has to go first to make place for them."""
        if frames.base is not self._frames:
            if len(frames) > len(self.room):
                yield self.take()
                yield frames
                return
            self.room[: len(frames)] = frames
        self.count += len(frames)

    def take(self) -> FrameArray:
        """What there is; the next frames have a new array."""
        frames, self.count = self._frames[: self.count], 0
        self._frames = np.empty(_ROOM_FRAMES, dtype=FRAME)
        return frames


def open_log(
    source: Path | str,
    *,
    strict: bool = False,
    follow: bool = False,
    deltas: bool = False,
    start_ns: int | None = None,
    end_ns: int | None = None,
    part: tuple[int, int | None] = (0, None),
) -> LogReader:
    """A log, by what its name and its first bytes say; "-" is candump's text on stdin.

    ``strict`` raises at the first bad line, after the frames before it. ``follow`` waits at the end of a text for
    more. ``deltas``: the timestamps are those of candump -td. ``start_ns`` and ``end_ns`` leave out what is earlier,
    and what is at that time or later. ``part``: the bytes of a plain text that are read, cut by ``line_borders``; its
    lines are numbered from 1.
    Raises InputError for a file that can't be opened or read, EnvironmentLackError for one that needs a library that
    is not installed; while iterating, InputError for a bad line (strict), and for times wanted where there are none.
    """
    path = None if str(source) == STDIN else Path(source)
    return LogReader(path, strict=strict, follow=follow, deltas=deltas, start_ns=start_ns, end_ns=end_ns, part=part)


def log_kind(path: Path) -> str:
    """How a log is read: "text", "pcap" or "messages" (python-can). Raises InputError for one that can't be opened."""
    if path.is_fifo():  # to open it and close it again would end it
        return "text"
    with open_file(path) as file:
        start = first_bytes(file)
    if start[:4] in _PCAP_STARTS:
        return "pcap"
    suffixes = [suffix.lower() for suffix in path.suffixes[-2:]]
    if suffixes[-1:] == [".gz"]:
        suffixes.pop()
    return "messages" if suffixes and suffixes[-1] in MESSAGE_SUFFIXES else "text"
