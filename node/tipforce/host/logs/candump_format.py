"""Format frames as candump text, byte for byte: the screen format and the log format of can-utils 2020.11."""

from __future__ import annotations

import time
from collections.abc import Sequence

from tipforce.device.codes import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_MASK, REMOTE_FLAG, STANDARD_MASK
from tipforce.errors import InputError
from tipforce.host.frames.fd_frame import FdFrame
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump_errors import error_text

TIMESTAMPS = ("", "a", "z", "d", "A")
"""None, absolute, from zero, since the previous frame, absolute with the local date."""

_EXTRA = ("- -", "B -", "- E", "B E")  # bit rate switch and error state, by the flags of a CAN FD frame
_ERROR_MASK = ERROR_FLAG | EXTENDED_MASK


class CandumpFormat:
    """Format frames as candump does, one string per frame without line end.

    ``timestamps`` is one of TIMESTAMPS; ``log`` is -L, ``extra`` -x, ``errors`` -e, ``ascii`` -a; ``width`` is the
    length of the longest interface name on the command line. Like candump, it keeps state: interface names align with
    the longest so far (not with ``align`` False), and 11-bit identifiers are indented after the first 29-bit one.
    """

    def __init__(
        self,
        timestamps: str = "",
        *,
        log: bool = False,
        extra: bool = False,
        errors: bool = False,
        ascii: bool = False,
        width: int = 0,
        align: bool = True,
    ) -> None:
        """Create a formatter. Raises InputError for an unknown kind of timestamp."""
        if timestamps not in TIMESTAMPS:
            raise InputError(f"timestamps {timestamps!r}: allowed are {', '.join(TIMESTAMPS[1:])}")
        self._kind = timestamps
        self._log = log
        self._extra = extra
        self._errors = errors
        self._ascii = ascii
        self._width = width
        self._align = align
        self._indent = ""
        self._reference_us: int | None = None
        self._second = (-1, "")

    def lines(self, block: CandumpBlock) -> list[str]:
        """Return the text of each frame of a block, CAN FD included, in order (error frames with -e: several lines)."""
        line = self._log_line if self._log else self._screen_line
        frames = block.frames
        names = block.names
        found = []
        data = frames["data"].tobytes()
        fd = iter(block.fd)
        next_fd = next(fd, None)
        numbers = zip(
            frames["t_ns"].tolist(), frames["can_id"].tolist(), frames["length"].tolist(),
            block.interface.tolist(), block.sent.tolist(), strict=True,
        )  # fmt: skip
        for row, (t_ns, can_id, length, interface, sent) in enumerate(numbers):
            while next_fd is not None and next_fd.row <= row:
                found.append(self._fd_line(next_fd, names))
                next_fd = next(fd, None)
            payload = data[8 * row : 8 * row + length]
            found.append(line(t_ns // 1000, can_id, length, payload, self._name(names[interface]), sent))
        if next_fd is not None:
            found += [self._fd_line(one, names) for one in (next_fd, *fd)]
        return found

    def _name(self, name: str) -> str:
        if not self._align:
            return name
        self._width = max(self._width, len(name))
        return name.rjust(self._width)

    def _fd_line(self, frame: FdFrame, names: Sequence[str]) -> str:
        t_us, can_id, data = frame.t_ns // 1000, frame.can_id, frame.data
        name = self._name(names[frame.interface])
        if self._log:
            payload = f"#{frame.flags & 0xF:X}{data.hex().upper()}"
            return f"({_seconds(t_us, 10)}) {name} {identifier_text(can_id)}#{payload}{self._way(frame.sent)}"
        start = self._start(t_us, can_id, name, frame.sent, frame.flags)
        return self._data(f"{start}  [{len(data):02d}] ", can_id, data)

    def _log_line(self, t_us: int, can_id: int, length: int, data: bytes, name: str, sent: bool) -> str:
        payload = (f"R{length}" if length else "R") if can_id & REMOTE_FLAG else data.hex().upper()
        return f"({_seconds(t_us, 10)}) {name} {identifier_text(can_id)}#{payload}{self._way(sent)}"

    def _way(self, sent: bool) -> str:
        return "" if not self._extra else " T" if sent else " R"

    def _screen_line(self, t_us: int, can_id: int, length: int, data: bytes, name: str, sent: bool) -> str:
        start = f"{self._start(t_us, can_id, name, sent, 0)}   [{length}] "
        if can_id & REMOTE_FLAG:
            return self._with_errors(start + " remote request", can_id, data)
        return self._data(start, can_id, data)

    def _start(self, t_us: int, can_id: int, name: str, sent: bool, flags: int) -> str:
        """Return the part before the length."""
        if can_id & EXTENDED_FLAG and not self._indent:
            self._indent = "     "
        way = f"  {'TX' if sent else 'RX'} {_EXTRA[flags & 3]}" if self._extra else ""
        indent = "" if can_id & (EXTENDED_FLAG | ERROR_FLAG) else self._indent
        stamp = self._stamp(t_us) if self._kind else ""
        return f" {stamp} {name}{way}  {indent}{identifier_text(can_id)}"

    def _data(self, start: str, can_id: int, data: bytes) -> str:
        text = f"{start} {data.hex(' ').upper()}" if data else start
        if len(data) > 8:  # candump appends nothing after this many bytes
            return self._with_errors(text, can_id, data)
        gap = " " * (3 * (8 - len(data)) + 3)
        if can_id & ERROR_FLAG:
            return self._with_errors(f"{text}{gap}ERRORFRAME", can_id, data)
        if self._ascii:
            return f"{text}{gap}'{''.join(chr(byte) if 0x1F < byte < 0x7F else '.' for byte in data)}'"
        return text

    def _with_errors(self, text: str, can_id: int, data: bytes) -> str:
        if not self._errors or not can_id & ERROR_FLAG:
            return text
        return text + "\n\t" + error_text(can_id, data).replace("\n", "\n\t")

    def _stamp(self, t_us: int) -> str:
        if self._kind == "a":
            return f"({_seconds(t_us, 10)}) "
        if self._kind == "A":
            return f"({self._date(t_us // 1_000_000)}.{t_us % 1_000_000:06d}) "
        since = t_us if self._reference_us is None else self._reference_us
        if self._reference_us is None or self._kind == "d":
            self._reference_us = t_us
        return f"({_seconds(max(t_us - since, 0), 3)}) "

    def _date(self, second: int) -> str:
        if self._second[0] != second:
            self._second = second, time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(second))
        return self._second[1]


def identifier_text(can_id: int) -> str:
    """Return 3 hexadecimal digits for an 11-bit identifier; 8 for a 29-bit one, and for error frames (with flag)."""
    if can_id & ERROR_FLAG:
        return f"{can_id & _ERROR_MASK:08X}"
    if can_id & EXTENDED_FLAG:
        return f"{can_id & EXTENDED_MASK:08X}"
    return f"{can_id & STANDARD_MASK:03X}"


def _seconds(t_us: int, digits: int) -> str:
    return f"{t_us // 1_000_000:0{digits}d}.{t_us % 1_000_000:06d}"
