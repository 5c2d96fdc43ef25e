"""Parse candump text in bulk: blocks of lines to FRAME arrays, many lines at a time with numpy.

Most lines of a log differ only in their digits. The first line yields a template; all lines that fit it are
parsed together; the first of the remaining lines yields the next. Lines that fit no template, or prove invalid, go
to the line parser, so that only one parser defines frames and the reasons of bad lines.
"""

from __future__ import annotations

import numpy as np

from tipforce.host.frames.fd_frame import FdFrame
from tipforce.host.frames.frame_array import SENT, FrameArray
from tipforce.host.logs.candump import BadLineError, CandumpBlock, CandumpParser
from tipforce.host.logs.candump_rows import Block, Places, take
from tipforce.host.logs.candump_template import Templates
from tipforce.host.logs.lines import Text

_MAX_TRIES = 32  # for a template, in a block; the remaining lines go to the line parser
_NEWLINE = 10
_LONGEST_EVEN = 128
_SAFE_NS = 9.2e18  # near the end of 64 bits the line parser decides


class CandumpBulk:
    """Convert blocks of text to frames. ``parser`` has the counts, and parses lines that do not fit the bulk path.

    ``names`` are the interfaces by number; ``timed`` is False after a line without a timestamp.
    """

    def __init__(self, parser: CandumpParser) -> None:
        self.parser = parser
        self.names: list[str] = []
        self.timed = True
        self._templates = Templates()

    def parse(self, text: Text, begin: int, end: int, room: FrameArray | None = None) -> FrameArray:
        """Return the frames of the lines in ``text[begin:end]``; 8 bytes before and 128 after them must be readable.

        If each line holds a frame and ``room`` is large enough, they are written at its start.
        Raises BadLineError with the frames before, if the parser is strict.
        """
        even = _even_ends(text, begin, end)
        block, left = self._taken(text, _line_ends(text, begin, end) if even is None else even, begin, room)
        if even is not None and len(left):
            block, left = self._taken(text, _line_ends(text, begin, end), begin, room)
        if self.parser.deltas and (len(left) or not self._add_up(block)):
            block.kept[:] = False
            left = np.arange(len(block.starts))
        self._take_lines(block, left)
        return block.frames()

    def _taken(self, text: Text, ends: Places, begin: int, room: FrameArray | None) -> tuple[Block, Places]:
        """Return the block of these lines, parsed in bulk as far as possible, and the remaining lines."""
        starts = np.empty_like(ends)
        starts[0] = begin
        np.add(ends[:-1], 1, out=starts[1:])
        block = Block(text, starts, ends, room)
        return block, self._take_all(block)

    def _take_all(self, block: Block) -> Places:
        """Parse lines in bulk; return the remaining lines."""
        todo = np.arange(len(block.starts))
        left: list[Places] = []
        for _ in range(_MAX_TRIES):
            if not len(todo):
                break
            template = self._templates.of(block.line(int(todo[0])))
            channel = None if template is None else self._channel(template.name)
            if template is None or channel is None:
                left.append(todo[:1])
                todo = todo[1:]
                continue
            others, wrong = take(block, todo, template, channel, self.parser)
            if len(wrong):
                left.append(wrong)
            if not template.timed and len(wrong) + len(others) < len(todo):
                self.timed = False
            todo = others
        return np.sort(np.concatenate([*left, todo])) if left else todo

    def _channel(self, name: str) -> int | None:
        try:
            return self.parser.interface_number(name)
        except ValueError:
            return None

    def _add_up(self, block: Block) -> bool:
        """Convert the deltas of a block to times; False if the line parser has to decide."""
        steps = block.words[:, 0].view(np.int64)
        if not self.timed or float(steps.sum(dtype=np.float64)) + self.parser.last_ns > _SAFE_NS:
            return False
        block.words[:, 0] = (np.cumsum(steps) + self.parser.last_ns).view(np.uint64)
        self.parser.last_ns = int(block.words[-1, 0])
        return True

    def _take_lines(self, block: Block, left: Places) -> None:
        """Pass lines to the line parser; its line numbers continue after the block."""
        parser = self.parser
        before = parser.line_number
        for row in left.tolist():
            try:
                found = parser.frame(before + row + 1, block.line(row).decode("utf-8", "replace"))
            except BadLineError as error:
                block.kept[row:] = False
                raise BadLineError(error.bad, self._as_candump_block(block.frames())) from None
            if isinstance(found, FdFrame):
                self.timed = self.timed and found.t_ns >= 0
            elif found is not None:
                block.words[row] = np.frombuffer(found[0], dtype=np.uint64)
                block.kept[row] = True
                self.timed = self.timed and found[1]
        parser.line_number = before + len(block.starts)
        self.names[:] = parser.names

    def _as_candump_block(self, frames: FrameArray) -> CandumpBlock:
        self.names[:] = self.parser.names
        channel, sent = frames["channel"].astype(np.uint16), frames["flags"] & SENT != 0
        return CandumpBlock(frames, channel, self.parser.names, sent, self.timed)


def _line_ends(text: Text, begin: int, end: int) -> Places:
    ends = np.flatnonzero(text[begin:end] == _NEWLINE) + begin
    return ends if len(ends) and ends[-1] == end - 1 else np.append(ends, end)


def _even_ends(text: Text, begin: int, end: int) -> Places | None:
    """Return the line ends if all lines are as long as the first, which is common; None if not.

    A line end inside a line is found when the line is parsed: a valid line has none.
    """
    first = text[begin : min(end, begin + _LONGEST_EVEN)].tobytes().find(b"\n") + 1
    if first and not (end - begin) % first and (text[begin + first - 1 : end : first] == _NEWLINE).all():
        return np.arange(begin + first - 1, end, first)
    return None
