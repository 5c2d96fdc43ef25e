"""Parse candump text: its log format (-L, -l) and its screen format with any -t, -x, -a, -c, -e (can-utils). Lines that
are not frames are counted: drop messages and, by reason, bad lines. The inverse is ``candump_format``."""

import re
import time
from collections.abc import Iterator

import numpy as np

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_MASK, REMOTE_FLAG, STANDARD_MASK
from tipforce.core import core
from tipforce.host.frames.frame_array import FRAME, MAX_CHANNELS, PACK_FRAME, SENT, FrameArray
from tipforce.host.frames.frame_block import BIT_RATE_SWITCH, ERROR_STATE, LENGTHS, CandumpBlock, FdFrame
from tipforce.host.logs.notes import DROPPED, FD, NO_LINE, BadLine, LogNotes

_ROOM_BYTES = 65_536 * FRAME.itemsize
_LAST_NS = (1 << 63) - 1  # in the year 2262

_LOG = re.compile(r"\((?P<stamp>[^)]*)\)\s+(?P<name>\S+)\s+(?P<id>[^\s#]*)#(?P<rest>\S*)(?:\s+(?P<way>[RT]))?\s*")
_SCREEN = re.compile(
    r"\s*(?:\((?P<stamp>[^)]*)\)\s+)?(?P<name>\S+)\s+(?:(?P<way>[RT])X (?P<switch>[-B]) (?P<state>[-E])\s+)?"
    r"(?P<id>\S+)\s+\[(?P<length>\d+)\](?P<rest>.*)"
)
_SECONDS = re.compile(r"(\d{1,10})\.(\d{6}|\d{9})", re.ASCII)
_DATE = r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\.(\d{6})"
_HEX = re.compile(r"[0-9A-Fa-f]+")
_LOG_DATA = re.compile(r"((?:[0-9A-Fa-f]{2}\.?)*)(?:_[9A-Fa-f])?")  # _F: the raw DLC of an 8-byte frame
_LOG_FD_DATA = re.compile(r"#([0-9A-Fa-f])((?:[0-9A-Fa-f]{2}\.?)*)")
_SCREEN_DATA = re.compile(r"\s*((?:[0-9A-Fa-f]{2}(?:\s|$))*)\s*(ERRORFRAME|'.*')?\s*")
_DROPS = r"\s*DROPCOUNT: dropped (\d+) CAN frames?"
_COLOUR = r"\x1b\[[0-9;]*m"


class CandumpParser:
    """Convert lines to frames, in bulk where they are plain; ``notes`` get all else that they tell."""

    def __init__(self, notes: LogNotes | None = None, *, strict: bool = False, deltas: bool = False) -> None:
        """``deltas``: the timestamps are those of -td, each the time since the previous line. Without ``notes``,
        ``strict`` ones raise BadLineError at the first bad line."""
        self.notes = LogNotes(strict) if notes is None else notes
        self.count = 0
        """Classic frames since the last ``take``."""
        self.fd: list[FdFrame] = []
        """CAN FD frames since then."""
        self._timed = True
        self._deltas = deltas
        self._last_ns = 0
        self._numbers: dict[str, int] = {}
        self._spaced = b""  # the names, each followed by a space
        self._dates: dict[str, int] = {}
        self._room = bytearray()

    def frame(self, line: str) -> tuple[bytes, bool] | FdFrame | None:
        """Return the content of the next line: (bytes of a FRAME, whether it is timed), a CAN FD frame, or no frame. An
        FD frame without a timestamp has t_ns -1. Raises BadLineError for a bad line, if strict."""
        notes = self.notes
        notes.lines += 1
        try:
            return self._frame(line)
        except ValueError as reason:
            bad = BadLine(notes.lines, line.rstrip("\r\n"), str(reason))
        notes.note_bad(bad.reason, bad)
        return None

    def _frame(self, line: str) -> tuple[bytes, bool] | FdFrame | None:
        """Return as ``frame``. ValueError: the reason."""
        match = _LOG.fullmatch(line)
        if match is not None:
            is_fd, flags, length, data = _log_payload(match["rest"])
        else:
            if "\x1b" in line:
                line = re.sub(_COLOUR, "", line)
            match = _SCREEN.fullmatch(line.rstrip())
            if match is None:
                self._note(line)
                return None
            is_fd, flags, length, data = _screen_payload(match)
        t_ns = None if match["stamp"] is None else self._time(match["stamp"])
        can_id, number = _identifier(match["id"]), self._number(match["name"])
        sent = match["way"] == "T"
        if is_fd:
            self.notes.skip(FD)
            return FdFrame(0, -1 if t_ns is None else t_ns, can_id, flags, data, number, sent)
        return PACK_FRAME(t_ns or 0, can_id | flags, length, number, SENT if sent else 0, data), t_ns is not None

    def _note(self, line: str) -> None:
        """Note a line that is no frame."""
        drops = re.match(_DROPS, line)
        if drops is not None:
            self.notes.skip(DROPPED, int(drops[1]))
        elif line.strip() and not line.startswith("\t"):  # tabs: candump -e describes the error frame above
            raise ValueError(NO_LINE)

    def _time(self, stamp: str) -> int:
        seconds = _SECONDS.fullmatch(stamp)
        if seconds is not None:
            t_ns = int(seconds[1]) * 1_000_000_000 + int(seconds[2].ljust(9, "0"))
        else:
            date = re.fullmatch(_DATE, stamp, re.ASCII)
            if date is None:
                raise ValueError("timestamp")
            t_ns = self._local_time(date[1]) * 1_000_000_000 + int(date[2]) * 1000
        if self._deltas:
            t_ns += self._last_ns
        if not 0 <= t_ns <= _LAST_NS:
            raise ValueError("timestamp")
        self._last_ns = t_ns
        return t_ns

    def _local_time(self, date: str) -> int:
        """Return seconds since 1970 of candump -tA's local time."""
        if date not in self._dates:
            self._dates.clear()  # the previous second does not occur again
            try:
                self._dates[date] = int(time.mktime(time.strptime(date, "%Y-%m-%d %H:%M:%S")))
            except (ValueError, OverflowError):
                raise ValueError("timestamp") from None
        return self._dates[date]

    def _number(self, name: str) -> int:
        """Return the number of an interface, assigned in order of appearance."""
        number = self._numbers.get(name)
        if number is None:
            if len(self._numbers) >= MAX_CHANNELS:
                raise ValueError("interface")
            number = self._numbers[name] = len(self._numbers)
            self.notes.channels.append(name)
            self._spaced += name.encode("utf-8", "surrogatepass") + b" "
        return number

    def gather(self, text: bytearray, begin: int, end: int) -> Iterator[CandumpBlock]:
        """Read the whole lines ``text[begin:end]``, and yield blocks that are full. Raises BadLineError if strict;
        ``take`` returns the frames before the bad line."""
        while begin < end:
            if self.count * FRAME.itemsize == _ROOM_BYTES:
                yield self.take()
            self._room = self._room or bytearray(_ROOM_BYTES)
            begin = self._plain(text, begin, end)
            if begin == end or self.count * FRAME.itemsize == _ROOM_BYTES:
                continue
            line_end = text.find(b"\n", begin, end)
            line_end = end if line_end < 0 else line_end
            frame = self.frame(text[begin:line_end].decode("utf-8", "replace"))
            begin = line_end + 1
            if isinstance(frame, FdFrame):
                self._timed &= frame.t_ns >= 0
                self.fd.append(frame._replace(row=self.count, t_ns=max(frame.t_ns, 0)))
            elif frame is not None:
                place = self.count * FRAME.itemsize
                self._room[place : place + FRAME.itemsize], timed = frame
                self._timed &= timed
                self.count += 1

    def _plain(self, text: bytearray, begin: int, end: int) -> int:
        """Gather the frames of plain lines, by ``parse`` of the compiled core; return the place of the first other."""
        if core is None:
            return begin
        date, seconds = next(iter(self._dates.items()), ("", 0))
        if not 0 <= seconds <= _LAST_NS // 1_000_000_000:
            date, seconds = "", 0
        place: int
        place, self.count, lines, self._last_ns, timed = core.parse(
            text, begin, end, self._room, self.count, self._spaced, self._last_ns, self._deltas, date.encode(), seconds
        )
        self.notes.lines += lines
        self._timed &= timed != 0
        return place

    def take(self) -> CandumpBlock:
        """Return the gathered frames."""
        frames: FrameArray = np.frombuffer(self._room, dtype=FRAME, count=self.count)
        block = CandumpBlock(frames, tuple(self._numbers), self._timed, tuple(self.fd))
        self.notes.timed &= self._timed
        self._room, self.count, self.fd, self._timed = bytearray(), 0, [], True
        return block


def _identifier(text: str) -> int:
    """Return the can_id with flags, except the remote flag."""
    if _HEX.fullmatch(text) is None or len(text) not in {3, 8}:
        raise ValueError("identifier")
    can_id = int(text, 16)
    if len(text) == 3 and can_id <= STANDARD_MASK:
        return can_id
    if len(text) == 8 and can_id <= EXTENDED_MASK:
        return can_id | EXTENDED_FLAG
    if len(text) == 8 and can_id & ERROR_FLAG and can_id <= ERROR_FLAG | EXTENDED_MASK:
        return can_id
    raise ValueError("identifier")


_Payload = tuple[bool, int, int, bytes]  # is CAN FD, its flags or the remote flag, length, data


def _log_payload(text: str) -> _Payload:
    """Return what the text after the # of a line in the log format says."""
    if text[:1] in {"R", "r"}:
        if text[1:] not in {"", *"012345678"}:
            raise ValueError("length" if text[1:].isdigit() else "data")
        return False, REMOTE_FLAG, int(text[1:] or 0), b""
    is_fd = text.startswith("#")
    match = (_LOG_FD_DATA if is_fd else _LOG_DATA).fullmatch(text)
    if match is None:
        raise ValueError("data")
    data = bytes.fromhex(match[2 if is_fd else 1].replace(".", ""))
    if len(data) > 8 and not (is_fd and len(data) in LENGTHS):
        raise ValueError("length")
    return is_fd, int(match[1], 16) if is_fd else 0, len(data), data


def _screen_payload(line: re.Match[str]) -> _Payload:
    """Return what a line in the screen format says; the length of CAN FD has two digits."""
    is_fd, length, text = len(line["length"]) == 2, int(line["length"]), line["rest"]
    if not is_fd and length > 8:
        raise ValueError("length")
    if not is_fd and text.strip() == "remote request":
        return False, REMOTE_FLAG, length, b""
    match = _SCREEN_DATA.fullmatch(text)
    if match is None:
        raise ValueError("data")
    data = bytes.fromhex(match[1])
    if len(data) != length or length not in LENGTHS:
        raise ValueError("length")
    flags = (line["switch"] == "B") * BIT_RATE_SWITCH + (line["state"] == "E") * ERROR_STATE
    return is_fd, flags if is_fd else 0, length, data
