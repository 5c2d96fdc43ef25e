"""candump's text as frames: its log format (-L, -l) and its screen format with any -t, -x, -a, -c, -e (can-utils).

The other direction is ``candump_format``. What can't be a classic frame is counted, not raised: CAN FD frames,
drop messages and, by reason and with line numbers, bad lines.
"""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, STANDARD_MASK
from tipforce.errors import InputError
from tipforce.host.frames import FRAME, FrameArray

EXPECTED = {
    "no candump line": "expected candump's text, as `(1700000000.123456) can0 181#0102` or `  can0  181   [2]  01 02`",
    "timestamp": "expected (seconds.microseconds) or (YYYY-MM-DD hh:mm:ss.microseconds)",
    "interface": "expected at most 4096 different interface names",
    "identifier": "expected 3 hexadecimal digits to 7FF or 8 to 1FFFFFFF (error frames: 20000000 plus their class)",
    "length": "expected 0 to 8 data bytes, as many as [the length] says",
    "data": "expected two hexadecimal digits per data byte, or a remote request",
}
"""Why a line is bad, and what was expected in its place."""

BLOCK_LINES = 8192
_MAX_INTERFACES = 4096
_MAX_IDENTIFIER = 0x1FFFFFFF
_LAST_NS = (1 << 63) - 1  # in the year 2262
_MAX_KEPT = 100
_SHOWN_CHARACTERS = 80

_LOG = re.compile(r"\((?P<stamp>[^)]*)\)\s+(?P<name>\S+)\s+(?P<id>[^\s#]*)#(?P<rest>\S*)(?:\s+(?P<way>[RT]))?\s*")
_SCREEN = re.compile(
    r"\s*(?:\((?P<stamp>[^)]*)\)\s+)?(?P<name>\S+)\s+(?:(?P<way>[RT])X [-B] [-E]\s+)?"
    r"(?P<id>\S+)\s+\[(?P<length>\d+)\](?P<rest>.*)"
)
_SECONDS = re.compile(r"(\d{1,10})\.(\d{6}|\d{9})", re.ASCII)
_DATE = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\.(\d{6})", re.ASCII)
_HEX = re.compile(r"[0-9A-Fa-f]+")
_LOG_DATA = re.compile(r"(?:[0-9A-Fa-f]{2}\.?)*(?:_[9A-Fa-f])?")  # _F: the raw DLC of an 8-byte frame
_SCREEN_DATA = re.compile(r"\s*((?:[0-9A-Fa-f]{2}(?:\s|$))*)\s*(ERRORFRAME|'.*')?\s*")
_DROPS = re.compile(r"\s*DROPCOUNT: dropped (\d+) CAN frames?")
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_PACK = struct.Struct("<qIB8s").pack  # one FRAME


@dataclass(frozen=True, slots=True, eq=False)
class CandumpBlock:
    """Frames from text: ``frames`` FRAME (n,); ``interface`` (n,) indexes ``names``; ``sent`` (n,): -x said TX.

    ``timed`` is False where a line had no timestamp; its ``t_ns`` is 0.
    """

    frames: FrameArray
    interface: npt.NDArray[np.uint16]
    names: tuple[str, ...]
    sent: npt.NDArray[np.bool_]
    timed: bool = True

    def take(self, rows: npt.NDArray[np.bool_] | slice) -> CandumpBlock:
        """The block with some of its frames only."""
        return CandumpBlock(self.frames[rows], self.interface[rows], self.names, self.sent[rows], self.timed)


@dataclass(frozen=True, slots=True)
class BadLine:
    """A line that is not usable: ``reason`` is a key of EXPECTED, ``number`` counts from 1."""

    number: int
    text: str
    reason: str

    def __str__(self) -> str:
        shown = self.text if len(self.text) <= _SHOWN_CHARACTERS else self.text[:_SHOWN_CHARACTERS] + "..."
        return f"line {self.number}: {shown!r}: {self.reason}: {EXPECTED[self.reason]}"


class BadLineError(InputError):
    """The first bad line of a text that is read strictly; ``block`` has the frames of the lines before it."""

    def __init__(self, bad: BadLine, block: CandumpBlock) -> None:
        super().__init__(str(bad))
        self.block = block


@dataclass(slots=True)
class CandumpParser:
    """Turns lines into blocks of frames, and keeps count of what it leaves out.

    ``strict`` raises BadLineError at the first bad line. ``deltas``: the timestamps are those of -td, each the time
    since the line before. ``bad`` counts by reason; ``bad_lines`` keeps the first hundred; ``fd_frames`` and
    ``dropped`` (told by candump -d) count what is not a bad line but no classic frame either.
    """

    strict: bool = False
    deltas: bool = False
    line_number: int = 0
    bad: dict[str, int] = field(default_factory=dict)
    bad_lines: list[BadLine] = field(default_factory=list)
    fd_frames: int = 0
    dropped: int = 0
    _names: dict[str, int] = field(default_factory=dict)
    _dates: dict[str, int] = field(default_factory=dict)
    _last_ns: int = 0

    def parse(self, lines: Iterable[str]) -> CandumpBlock:
        """The frames of some lines, with or without line ends; line numbers go on from call to call."""
        frames = bytearray()
        interfaces: list[int] = []
        sent: list[bool] = []
        timed = True
        bad = None
        for line in lines:
            self.line_number += 1
            try:
                found = self._line(line)
            except ValueError as reason:
                bad = BadLine(self.line_number, line.rstrip("\r\n"), str(reason))
                if self.strict:
                    break
                self._note(bad)
                continue
            if found is not None:
                t_ns, interface, can_id, length, data, way = found
                timed = timed and t_ns is not None
                frames += _PACK(t_ns or 0, can_id, length, data)
                interfaces.append(interface)
                sent.append(way == "T")
        array: FrameArray = np.frombuffer(frames, dtype=FRAME)
        which = np.array(interfaces, dtype=np.uint16)
        block = CandumpBlock(array, which, tuple(self._names), np.array(sent, dtype=np.bool_), timed)
        if self.strict and bad is not None:
            raise BadLineError(bad, block)
        return block

    def _line(self, line: str) -> tuple[int | None, int, int, int, bytes, str | None] | None:
        """One frame as (t_ns, interface, can_id, length, data, R or T); None: no frame. ValueError: the reason."""
        match = _LOG.fullmatch(line)
        if match is not None:
            payload = _log_payload(match["rest"])
        else:
            if "\x1b" in line:
                line = _COLOUR.sub("", line)
            match = _SCREEN.fullmatch(line.rstrip())
            if match is None:
                self._no_frame(line)
                return None
            payload = _screen_payload(match["length"], match["rest"])
        t_ns = None if match["stamp"] is None else self._time(match["stamp"])
        can_id = _identifier(match["id"])
        if payload is None:
            self.fd_frames += 1
            return None
        length, data, flags = payload
        return t_ns, self._interface(match["name"]), can_id | flags, length, data, match["way"]

    def _no_frame(self, line: str) -> None:
        drops = _DROPS.match(line)
        if drops is not None:
            self.dropped += int(drops[1])
        elif line.strip() and not line.startswith("\t"):  # tabs: what candump -e says about the error frame above
            raise ValueError("no candump line")

    def _time(self, stamp: str) -> int:
        seconds = _SECONDS.fullmatch(stamp)
        if seconds is not None:
            t_ns = int(seconds[1]) * 1_000_000_000 + int(seconds[2].ljust(9, "0"))
        else:
            date = _DATE.fullmatch(stamp)
            if date is None:
                raise ValueError("timestamp")
            t_ns = self._local_time(date[1]) * 1_000_000_000 + int(date[2]) * 1000
        if self.deltas:
            t_ns += self._last_ns
        if not 0 <= t_ns <= _LAST_NS:
            raise ValueError("timestamp")
        self._last_ns = t_ns
        return t_ns

    def _local_time(self, date: str) -> int:
        """Seconds since 1970 of candump -tA's local time."""
        if date not in self._dates:
            self._dates.clear()  # the second before will not come again
            try:
                self._dates[date] = int(time.mktime(time.strptime(date, "%Y-%m-%d %H:%M:%S")))
            except (ValueError, OverflowError):
                raise ValueError("timestamp") from None
        return self._dates[date]

    def _interface(self, name: str) -> int:
        number = self._names.get(name)
        if number is None:
            if len(self._names) >= _MAX_INTERFACES:
                raise ValueError("interface")
            number = self._names[name] = len(self._names)
        return number

    def _note(self, bad: BadLine) -> None:
        self.bad[bad.reason] = self.bad.get(bad.reason, 0) + 1
        if len(self.bad_lines) < _MAX_KEPT:
            self.bad_lines.append(bad)


def read_candump(
    lines: Iterable[str], parser: CandumpParser | None = None, block_lines: int = BLOCK_LINES
) -> Iterator[CandumpBlock]:
    """Blocks of frames from lines, at most ``block_lines`` at a time, so that any log fits into the memory."""
    parser = CandumpParser() if parser is None else parser
    iterator = iter(lines)
    while chunk := list(islice(iterator, block_lines)):
        yield parser.parse(chunk)


def _identifier(text: str) -> int:
    """The can_id with flags, except the remote flag."""
    if _HEX.fullmatch(text) is None or len(text) not in {3, 8}:
        raise ValueError("identifier")
    can_id = int(text, 16)
    if len(text) == 3:
        if can_id > STANDARD_MASK:
            raise ValueError("identifier")
        return can_id
    if can_id & ERROR_FLAG and can_id <= ERROR_FLAG | _MAX_IDENTIFIER:
        return can_id
    if can_id > _MAX_IDENTIFIER:
        raise ValueError("identifier")
    return can_id | EXTENDED_FLAG


def _log_payload(text: str) -> tuple[int, bytes, int] | None:
    """(length, data, remote flag) of what follows the # in a log; None: CAN FD."""
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
    """(length, data, remote flag) of what follows the identifier on the screen; None: CAN FD, with two digits."""
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
