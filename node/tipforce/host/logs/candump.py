"""Parse candump text: its log format (-L, -l) and its screen format with any -t, -x, -a, -c, -e (can-utils).

The inverse is ``candump_format``. CAN FD frames are kept separate from classic ones. Lines that are not frames are
counted, not raised: drop messages and, by reason and with line numbers, bad lines.
"""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_MASK, REMOTE_FLAG, STANDARD_MASK
from tipforce.core import core
from tipforce.errors import InputError
from tipforce.host.frames.frame_array import FRAME, MAX_CHANNELS, SENT, FrameArray
from tipforce.host.frames.frame_block import (
    BIT_RATE_SWITCH,
    ERROR_STATE,
    CandumpBlock,
    FdFrame,
    log_payload,
    screen_payload,
)

__all__ = [
    "BLOCK_LINES", "EXPECTED", "BadLine", "BadLineError", "CandumpBlock", "CandumpParser", "CandumpText",
    "read_candump", "text_blocks",
]  # fmt: skip

EXPECTED = {
    "not a candump line": "expected candump text, as `(1700000000.123456) can0 181#0102` or `  can0  181   [2]  01 02`",
    "timestamp": "expected (seconds.microseconds) or (YYYY-MM-DD hh:mm:ss.microseconds)",
    "interface": f"expected at most {MAX_CHANNELS} different interface names",
    "identifier": "expected 3 hexadecimal digits to 7FF or 8 to 1FFFFFFF (error frames: 20000000 plus their class)",
    "length": "expected 0 to 8 data bytes, as many as [the length] says",
    "data": "expected two hexadecimal digits per data byte, or a remote request",
}
"""Reasons for bad lines, and the expected text."""

BLOCK_LINES = 8192
_CHUNK_BYTES = 1 << 18
_ROOM_BYTES = 65_536 * FRAME.itemsize
_LAST_NS = (1 << 63) - 1  # in the year 2262
_MAX_KEPT = 100
_SHOWN_CHARACTERS = 80

_LOG = re.compile(r"\((?P<stamp>[^)]*)\)\s+(?P<name>\S+)\s+(?P<id>[^\s#]*)#(?P<rest>\S*)(?:\s+(?P<way>[RT]))?\s*")
_SCREEN = re.compile(
    r"\s*(?:\((?P<stamp>[^)]*)\)\s+)?(?P<name>\S+)\s+(?:(?P<way>[RT])X (?P<switch>[-B]) (?P<state>[-E])\s+)?"
    r"(?P<id>\S+)\s+\[(?P<length>\d+)\](?P<rest>.*)"
)
_SECONDS = re.compile(r"(\d{1,10})\.(\d{6}|\d{9})", re.ASCII)
_DATE = r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\.(\d{6})"
_HEX = re.compile(r"[0-9A-Fa-f]+")
_LOG_DATA = re.compile(r"(?:[0-9A-Fa-f]{2}\.?)*(?:_[9A-Fa-f])?")  # _F: the raw DLC of an 8-byte frame
_SCREEN_DATA = re.compile(r"\s*((?:[0-9A-Fa-f]{2}(?:\s|$))*)\s*(ERRORFRAME|'.*')?\s*")
_DROPS = r"\s*DROPCOUNT: dropped (\d+) CAN frames?"
_COLOUR = r"\x1b\[[0-9;]*m"
_PACK = struct.Struct("<qIBBBx8s").pack  # one FRAME


@dataclass(frozen=True, slots=True)
class BadLine:
    """A line that cannot be used: ``reason`` is a key of EXPECTED, ``number`` counts from 1."""

    number: int
    text: str
    reason: str

    def __str__(self) -> str:
        shown = self.text if len(self.text) <= _SHOWN_CHARACTERS else self.text[:_SHOWN_CHARACTERS] + "..."
        return f"line {self.number}: {shown!r}: {self.reason}: {EXPECTED[self.reason]}"


class BadLineError(InputError):
    """The first bad line of a text that is read strictly; ``block`` holds the frames of the lines before it."""

    def __init__(self, bad: BadLine, block: CandumpBlock) -> None:
        super().__init__(str(bad))
        self.bad = bad
        self.block = block


@dataclass(slots=True)
class CandumpParser:
    """Convert lines to blocks of frames, and count the lines that are skipped.

    ``strict`` raises BadLineError at the first bad line. ``deltas``: the timestamps are those of -td, each the time
    since the previous line. ``bad`` counts by reason; ``bad_lines`` keeps the first hundred; ``fd_frames``
    counts the CAN FD frames, ``dropped`` the drops that candump -d reported; ``last_ns`` is the time of the last line.
    """

    strict: bool = False
    deltas: bool = False
    line_number: int = 0
    last_ns: int = 0
    bad: dict[str, int] = field(default_factory=dict)
    bad_lines: list[BadLine] = field(default_factory=list)
    fd_frames: int = 0
    dropped: int = 0
    _names: dict[str, int] = field(default_factory=dict)
    _spaced: bytes = b""  # the names, each followed by a space
    _dates: dict[str, int] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The interfaces so far, by number."""
        return tuple(self._names)

    def parse(self, lines: Iterable[str]) -> CandumpBlock:
        """Return the frames of some lines, with or without line ends; line numbers continue from call to call."""
        frames = bytearray()
        fd: list[FdFrame] = []
        timed = True
        bad = None
        for line in lines:
            try:
                found = self.frame(self.line_number + 1, line)
            except BadLineError as error:
                bad = error.bad
                break
            if isinstance(found, FdFrame):
                timed = timed and found.t_ns >= 0
                fd.append(found._replace(row=len(frames) // FRAME.itemsize, t_ns=max(found.t_ns, 0)))
            elif found is not None:
                frames += found[0]
                timed = timed and found[1]
        block = _block(frames, self.names, timed, tuple(fd))
        if bad is not None:
            raise BadLineError(bad, block)
        return block

    def frame(self, number: int, line: str) -> tuple[bytes, bool] | FdFrame | None:
        """Return the content of line ``number``: (bytes of a FRAME, whether it is timed), a CAN FD frame, or no frame.

        For a reader that parses most lines itself. An FD frame without a timestamp has t_ns -1. Raises
        BadLineError with no frames for a bad line, if strict.
        """
        self.line_number = number
        try:
            found = self._line(line)
        except ValueError as reason:
            bad = BadLine(number, line.rstrip("\r\n"), str(reason))
            if self.strict:
                raise BadLineError(bad, _block(bytearray(), (), True, ())) from None
            self._note(bad)
            return None
        if found is None:
            return None
        if isinstance(found, FdFrame):
            self.fd_frames += 1
            return found
        t_ns, interface, can_id, length, data, way = found
        packed = _PACK(t_ns or 0, can_id, length, interface, SENT if way == "T" else 0, data)
        return packed, t_ns is not None

    def _line(self, line: str) -> tuple[int | None, int, int, int, bytes, str | None] | FdFrame | None:
        """Return one frame as (t_ns, interface, can_id, length, data, R or T), or CAN FD; None: no frame.

        An FD frame of a line without a timestamp has t_ns -1. ValueError: the reason.
        """
        match = _LOG.fullmatch(line)
        if match is not None:
            payload = _log_payload(match["rest"])
        else:
            if "\x1b" in line:
                line = re.sub(_COLOUR, "", line)
            match = _SCREEN.fullmatch(line.rstrip())
            if match is None:
                self._no_frame(line)
                return None
            payload = _screen_payload(match["length"], match["rest"])
        t_ns = None if match["stamp"] is None else self._time(match["stamp"])
        can_id = _identifier(match["id"])
        if payload is None:
            return self._fd_frame(match, -1 if t_ns is None else t_ns, can_id)
        length, data, flags = payload
        return t_ns, self.interface_number(match["name"]), can_id | flags, length, data, match["way"]

    def _fd_frame(self, match: re.Match[str], t_ns: int, can_id: int) -> FdFrame:
        parts = match.groupdict()
        if "length" in parts:
            flags = (parts["switch"] == "B") * BIT_RATE_SWITCH + (parts["state"] == "E") * ERROR_STATE
            data = screen_payload(int(parts["length"]), parts["rest"])
        else:
            flags, data = log_payload(parts["rest"])
        return FdFrame(0, t_ns, can_id, flags, data, self.interface_number(parts["name"]), parts["way"] == "T")

    def _no_frame(self, line: str) -> None:
        drops = re.match(_DROPS, line)
        if drops is not None:
            self.dropped += int(drops[1])
        elif line.strip() and not line.startswith("\t"):  # tabs: candump -e describes the error frame above
            raise ValueError("not a candump line")

    def _time(self, stamp: str) -> int:
        seconds = _SECONDS.fullmatch(stamp)
        if seconds is not None:
            t_ns = int(seconds[1]) * 1_000_000_000 + int(seconds[2].ljust(9, "0"))
        else:
            date = re.fullmatch(_DATE, stamp, re.ASCII)
            if date is None:
                raise ValueError("timestamp")
            t_ns = self.local_time(date[1]) * 1_000_000_000 + int(date[2]) * 1000
        if self.deltas:
            t_ns += self.last_ns
        if not 0 <= t_ns <= _LAST_NS:
            raise ValueError("timestamp")
        self.last_ns = t_ns
        return t_ns

    def local_time(self, date: str) -> int:
        """Return seconds since 1970 of candump -tA's local time. ValueError: it is not a date."""
        if date not in self._dates:
            self._dates.clear()  # the previous second does not occur again
            try:
                self._dates[date] = int(time.mktime(time.strptime(date, "%Y-%m-%d %H:%M:%S")))
            except (ValueError, OverflowError):
                raise ValueError("timestamp") from None
        return self._dates[date]

    def interface_number(self, name: str) -> int:
        """Return the number of an interface, assigned in order of appearance. ValueError: there are too many."""
        number = self._names.get(name)
        if number is None:
            if len(self._names) >= MAX_CHANNELS:
                raise ValueError("interface")
            number = self._names[name] = len(self._names)
            self._spaced += name.encode("utf-8", "surrogatepass") + b" "
        return number

    def plain(self, text: bytearray, begin: int, end: int, room: bytearray, count: int) -> tuple[int, int, bool]:
        """Store the frames of plain lines, up to the first line for ``frame``: see ``parse`` of the compiled core.

        Return the place behind the last line, the number of frames in ``room``, and whether all lines had a time.
        Without the core no line is plain.
        """
        if core is None:
            return begin, count, True
        date, seconds = next(iter(self._dates.items()), ("", 0))
        if not 0 <= seconds <= _LAST_NS // 1_000_000_000:
            date, seconds = "", 0
        place, count, lines, self.last_ns, timed = core.parse(
            text, begin, end, room, count, self._spaced, self.last_ns, self.deltas, date.encode(), seconds
        )
        self.line_number += lines
        return place, count, timed != 0

    def _note(self, bad: BadLine) -> None:
        self.bad[bad.reason] = self.bad.get(bad.reason, 0) + 1
        if len(self.bad_lines) < _MAX_KEPT:
            self.bad_lines.append(bad)


class CandumpText:
    """The frames of text in blocks of whole lines, gathered in larger ones. ``timed``: all had a timestamp."""

    def __init__(self, parser: CandumpParser) -> None:
        self.parser = parser
        self.timed = True
        self.count = 0
        """Frames gathered since the last block."""
        self._room = bytearray(_ROOM_BYTES)

    def parse(self, text: bytearray, begin: int, end: int) -> Iterator[FrameArray]:
        """Read the lines ``text[begin:end]``, and yield blocks that are full.

        Raises BadLineError with no frames if the parser is strict; ``take`` returns those before the bad line.
        """
        parser = self.parser
        while begin < end:
            if self.count * FRAME.itemsize == _ROOM_BYTES:
                yield self.take()
            begin, self.count, timed = parser.plain(text, begin, end, self._room, self.count)
            self.timed &= timed
            if begin == end or self.count * FRAME.itemsize == _ROOM_BYTES:
                continue
            line_end = text.find(b"\n", begin, end)
            line_end = end if line_end < 0 else line_end
            content = parser.frame(parser.line_number + 1, text[begin:line_end].decode("utf-8", "replace"))
            begin = line_end + 1
            if isinstance(content, FdFrame):
                self.timed &= content.t_ns >= 0
            elif content is not None:
                place = self.count * FRAME.itemsize
                self._room[place : place + FRAME.itemsize], timed = content
                self.timed &= timed
                self.count += 1

    def take(self) -> FrameArray:
        """Return the gathered frames."""
        frames: FrameArray = np.frombuffer(self._room, dtype=FRAME, count=self.count)
        self._room, self.count = bytearray(_ROOM_BYTES), 0
        return frames


def read_candump(
    lines: Iterable[str], parser: CandumpParser | None = None, block_lines: int = BLOCK_LINES
) -> Iterator[CandumpBlock]:
    """Yield blocks of frames from lines, at most ``block_lines`` at a time, so that any log fits into memory."""
    parser = CandumpParser() if parser is None else parser
    iterator = iter(lines)
    while chunk := list(islice(iterator, block_lines)):
        yield parser.parse(chunk)


def text_blocks(read: Callable[[int], bytes], parser: CandumpParser) -> Iterator[CandumpBlock]:
    """Yield blocks of frames from what ``read(bytes)`` returns, until that is nothing, in bounded memory.

    Raises BadLineError at a bad line if ``parser`` is strict, after the frames before it.
    """
    rest, ended = b"", False
    while not ended:
        chunk = read(_CHUNK_BYTES)
        ended = not chunk
        *lines, rest = (rest + chunk).split(b"\n")
        if rest and (ended or len(rest) > _CHUNK_BYTES):  # the last line, or no text
            lines, rest = [*lines, rest], b""
        try:
            yield parser.parse([line.decode("utf-8", "replace") for line in lines])
        except BadLineError as error:
            yield error.block
            raise


def _block(frames: bytearray, names: tuple[str, ...], timed: bool, fd: tuple[FdFrame, ...]) -> CandumpBlock:
    array: FrameArray = np.frombuffer(frames, dtype=FRAME)
    return CandumpBlock(array, names, timed, fd)


def _identifier(text: str) -> int:
    """Return the can_id with flags, except the remote flag."""
    if _HEX.fullmatch(text) is None or len(text) not in {3, 8}:
        raise ValueError("identifier")
    can_id = int(text, 16)
    if len(text) == 3:
        if can_id > STANDARD_MASK:
            raise ValueError("identifier")
        return can_id
    if can_id & ERROR_FLAG and can_id <= ERROR_FLAG | EXTENDED_MASK:
        return can_id
    if can_id > EXTENDED_MASK:
        raise ValueError("identifier")
    return can_id | EXTENDED_FLAG


def _log_payload(text: str) -> tuple[int, bytes, int] | None:
    """Return (length, data, remote flag) from the text after the # in a log; None: CAN FD."""
    if text.startswith("#"):
        return None
    if text[:1] in {"R", "r"}:
        if text[1:] not in {"", *"012345678"}:
            raise ValueError("length" if text[1:].isdigit() else "data")
        return int(text[1:] or 0), b"", REMOTE_FLAG
    if _LOG_DATA.fullmatch(text) is None:
        raise ValueError("data")
    data = bytes.fromhex(text.partition("_")[0].replace(".", ""))
    if len(data) > 8:
        raise ValueError("length")
    return len(data), data, 0


def _screen_payload(length_text: str, text: str) -> tuple[int, bytes, int] | None:
    """Return (length, data, remote flag) after the identifier in the screen format; None: CAN FD, with two digits."""
    if len(length_text) == 2:
        return None
    length = int(length_text)
    if length > 8:
        raise ValueError("length")
    if text.strip() == "remote request":
        return length, b"", REMOTE_FLAG
    match = _SCREEN_DATA.fullmatch(text)
    if match is None:
        raise ValueError("data")
    data = bytes.fromhex(match[1])
    if len(data) != length:
        raise ValueError("length")
    return length, data, 0
