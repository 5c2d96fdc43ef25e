"""Parse all lines of candump text that fit one template at once."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_MASK, STANDARD_MASK
from tipforce.host.frames.frame_array import FRAME, SENT, FrameArray
from tipforce.host.frames.frame_block import FdFrame
from tipforce.host.logs.candump import BadLineError, CandumpBlock, CandumpParser
from tipforce.host.logs.candump_template import (
    FIRST,
    FRONT,
    Rows,
    Template,
    Templates,
    Words,
    decimal,
    fill,
    hexadecimal,
)
from tipforce.host.logs.lines import Text

_RETURN, _SPACE = 13, 32
_SECOND_NS = 1_000_000_000
_FIRST_92 = 92  # of the ten digits of seconds
_DATE = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", re.ASCII)
_DATE_CHARACTERS = 19
_SPACES = np.uint64(0x2020202020202020)
_NO_LENGTH = np.uint64(255)
_MAX_LENGTH = np.uint64(8)
_LOG_DIGITS = 18  # of data, and one more for a length that is too large
_LOG_LENGTH = np.array([n // 2 if n % 2 == 0 and n <= 16 else _NO_LENGTH for n in range(_LOG_DIGITS)], dtype=np.uint64)
_LOG_KEEP = FIRST[np.clip(np.arange(_LOG_DIGITS) - np.array([[0], [8]]), 0, 8)]
_SCREEN_KEEP = FIRST[np.clip(2 * np.arange(9) - np.array([[0], [8]]), 0, 8)]
_32, _40, _48 = (np.uint64(number) for number in (32, 40, 48))

Places = npt.NDArray[np.int64]


class Block:
    """Lines of a text and their frames: ``words`` (n, 3) hold one FRAME per line, ``kept`` (n,) selects the lines
    that are frames."""

    def __init__(self, text: Text, starts: Places, ends: Places, room: FrameArray | None = None) -> None:
        self.text = text
        self.starts = starts
        self.ends = ends
        frames = np.empty(len(starts), dtype=FRAME) if room is None or len(room) < len(starts) else room
        self.words: Words = frames[: len(starts)].view(np.uint64).reshape(-1, 3)
        self.kept: Rows = np.zeros(len(starts), dtype=np.bool_)

    def line(self, row: int) -> bytes:
        """Return the text of a line."""
        return self.text[self.starts[row] : self.ends[row]].tobytes()

    def frames(self) -> FrameArray:
        """Return the frames of the lines that hold one."""
        words = self.words if self.kept.all() else self.words[self.kept]
        frames: FrameArray = words.view(FRAME)[:, 0]
        return frames


def take(block: Block, todo: Places, template: Template, channel: int, parser: CandumpParser) -> tuple[Places, Places]:
    """Parse those of the lines ``todo`` (k,) that fit: (the others, those that fit but are invalid)."""
    rows = _rows(block, todo, template)
    fits = _fits(rows, template)
    others = todo[:0]
    if not fits.all():
        others = todo[~fits]
        rows, todo = rows[fits], todo[fits]
    where: Places | slice = slice(None) if len(todo) == len(block.starts) else todo
    line_ends, last = _without_return(block.text, block.ends[where])
    t_ns, right = _time(rows, template, parser)
    if template.length is None:
        line_ends, sent = _without_way(block.text, line_ends, last)
        digits, length, fitting = _log_data(rows, template, line_ends - block.starts[where])
    else:
        sent = np.uint64(SENT * template.sent)
        digits, length, fitting = _screen_data(rows, template, line_ends - block.starts[where])
    digits[2] = fill(_words(rows, template.identifier[0]), template.identifier[1])
    values, valid = hexadecimal(digits)
    can_id, known = _can_id(values[2].astype(np.uint32).byteswap(), template)
    right &= valid
    right &= known
    right &= fitting
    block.words[where, 0] = t_ns.view(np.uint64)
    can_id |= length << _32 | np.uint64(channel) << _40 | sent << _48
    block.words[where, 1] = can_id
    block.words[where, 2] = values[0] | values[1] << _32
    block.kept[where] = right
    return others, todo[:0] if right.all() else todo[~right]


def _rows(block: Block, todo: Places, template: Template) -> npt.NDArray[np.void]:
    """Return a row of fixed width for each line: one gather through a view that overlaps itself."""
    size = template.row_bytes
    kind = np.dtype((np.void, size))
    everywhere: npt.NDArray[np.void] = np.ndarray((len(block.text) - size + 1,), kind, block.text, strides=(1,))
    starts = block.starts if len(todo) == len(block.starts) else block.starts[todo]
    return everywhere[starts - FRONT]


def _words(rows: npt.NDArray[np.void], offset: int) -> Words:
    """Return eight characters of each row, at any offset: a view."""
    return np.ndarray((len(rows),), np.uint64, rows, offset, (rows.itemsize,))


def _fits(rows: npt.NDArray[np.void], template: Template) -> Rows:
    (offset, mask, value), *others = template.fixed
    differs = (_words(rows, offset) & mask) ^ value
    for offset, mask, value in others:
        word = _words(rows, offset) & mask
        word ^= value
        differs |= word
    fits: Rows = differs == 0
    if template.extended and template.length is not None:  # here candump indents 11-bit identifiers to this width
        fits &= (_words(rows, template.identifier[0]) & FIRST[1]) != _SPACE
    return fits


def _time(rows: npt.NDArray[np.void], template: Template, parser: CandumpParser) -> tuple[Places, Rows]:
    if not template.stamp:
        return np.zeros(len(rows), dtype=np.int64), np.ones(len(rows), dtype=np.bool_)
    *seconds, (offset, keep, unit) = template.stamp
    value, right = decimal(_words(rows, offset), keep)
    t_ns = value.view(np.int64)
    if unit != 1:
        t_ns *= unit
    for offset, keep, unit in seconds:
        words = _words(rows, offset)
        first = words[:1] & keep
        alike = bool(((words & keep) == first).all())  # most digits of the seconds are equal
        value, valid = decimal(first if alike else words, keep)
        if unit > _SECOND_NS:
            valid &= value < _FIRST_92  # from there on the line parser checks the 64-bit range
        if not valid.all():
            right &= valid
            value *= valid
        t_ns += value.view(np.int64) * unit
    if template.date is not None:
        _add_dates(rows, template.date, parser, t_ns, right)
    return t_ns, right


def _add_dates(rows: npt.NDArray[np.void], offset: int, parser: CandumpParser, t_ns: Places, right: Rows) -> None:
    """Add the seconds of candump -tA's dates: a date is parsed once while it stays the same."""
    changes = np.zeros(len(rows) - 1, dtype=np.bool_)
    for place in (offset, offset + 8, offset + _DATE_CHARACTERS - 8):
        words = _words(rows, place)
        changes |= words[1:] != words[:-1]
    firsts = np.concatenate(([0], np.flatnonzero(changes) + 1))
    seconds = np.zeros(len(firsts), dtype=np.int64)
    known = np.ones(len(firsts), dtype=np.bool_)
    for number, first in enumerate(firsts.tolist()):
        date = rows[first].tobytes()[offset : offset + _DATE_CHARACTERS].decode("latin-1")
        try:
            seconds[number] = parser.local_time(date)
            known[number] = _DATE.fullmatch(date) is not None and 0 <= seconds[number] < 9_200_000_000
        except ValueError:
            known[number] = False
    lengths = np.diff(np.append(firsts, len(rows)))
    t_ns += np.repeat(seconds * known * _SECOND_NS, lengths)
    right &= np.repeat(known, lengths)


def _without_return(text: Text, ends: Places) -> tuple[Places, Text]:
    """Return line ends without a carriage return, and the characters before them."""
    last = text[ends - 1]
    returns = last == _RETURN
    if returns.any():
        ends = ends - returns
        last = text[ends - 1]
    return ends, last


def _without_way(text: Text, ends: Places, last: Text) -> tuple[Places, Words | np.uint64]:
    """Return line ends without python-can's " R" or " T", and SENT as flag for a T."""
    if (last <= ord("F")).all():
        return ends, np.uint64(0)
    way = ((last == ord("R")) | (last == ord("T"))) & (text[ends - 2] == _SPACE)
    sent: Words = (way & (last == ord("T"))).astype(np.uint64) * np.uint64(SENT)
    return ends - 2 * way, sent


def _log_data(
    rows: npt.NDArray[np.void], template: Template, length: Places
) -> tuple[Words, Words | np.uint64, Rows | np.bool_]:
    """Return (digits (3, n) with the last row free, data length (n,) or one for all, True) for ``length`` (n,)."""
    count = length - (template.data - FRONT)
    digits = np.empty((3, len(rows)), dtype=np.uint64)
    if (count == 16).all():
        digits[0], digits[1] = _words(rows, template.data), _words(rows, template.data + 8)
        return digits, _MAX_LENGTH, np.True_
    place = np.minimum(count.view(np.uint64), np.uint64(_LOG_DIGITS - 1)).view(np.int64)  # negative counts become large
    digits[0] = fill(_words(rows, template.data), _LOG_KEEP[0][place])
    digits[1] = fill(_words(rows, template.data + 8), _LOG_KEEP[1][place])
    length_bytes = _LOG_LENGTH[place]
    return digits, length_bytes, length_bytes <= _MAX_LENGTH


def _screen_data(
    rows: npt.NDArray[np.void], template: Template, length: Places
) -> tuple[Words, Words | np.uint64, Rows | np.bool_]:
    """Parse as ``_log_data``, for " 01 02"; also check the spaces between the bytes and their stated number."""
    assert template.length is not None
    size = rows.itemsize
    told = np.ndarray((len(rows),), np.uint8, rows, template.length, (size,)).astype(np.int64) - ord("0")
    right = (told >= 0) & (told <= 8)
    told *= right
    right &= (length - (template.data - FRONT)) == 3 * told
    spaces: Text = np.ndarray((len(rows), 8), np.uint8, rows, template.data, (size, 3)).copy()
    right &= (spaces.view(np.uint64)[:, 0] ^ _SPACES) & FIRST[told] == 0
    pairs = np.ndarray((len(rows), 8), np.uint16, rows, template.data + 1, (size, 3)).copy().view(np.uint64)
    digits = np.empty((3, len(rows)), dtype=np.uint64)
    digits[0] = fill(pairs[:, 0], _SCREEN_KEEP[0][told])
    digits[1] = fill(pairs[:, 1], _SCREEN_KEEP[1][told])
    return digits, told.astype(np.uint64), right


def _can_id(number: npt.NDArray[np.uint32], template: Template) -> tuple[Words, Rows]:
    if not template.extended:
        return number.astype(np.uint64), number <= STANDARD_MASK
    error = (number & np.uint32(ERROR_FLAG)) != 0
    known = number <= np.uint32(ERROR_FLAG | EXTENDED_MASK)
    return np.where(error, number, number | np.uint32(EXTENDED_FLAG)).astype(np.uint64), known


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
