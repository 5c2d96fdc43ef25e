"""Frames as candump's text, to the byte: the screen format and the log format of can-utils 2020.11."""

from __future__ import annotations

import time

from tipforce.device.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, STANDARD_MASK
from tipforce.errors import InputError
from tipforce.host.candump import CandumpBlock
from tipforce.host.candump_errors import error_text

TIMESTAMPS = ("", "a", "z", "d", "A")
"""None, absolute, from zero, since the frame before, absolute with the local date."""

_ERROR_MASK = ERROR_FLAG | 0x1FFFFFFF
_IDENTIFIER_MASK = 0x1FFFFFFF


class CandumpFormat:
    """candump's text for frames, one string per frame and without the line end.

    ``timestamps`` is one of TIMESTAMPS; ``log`` is -L, ``extra`` -x, ``errors`` -e; ``width`` is the length of the
    longest interface name on the command line. As candump, it remembers: interface names align from the longest
    seen on, and 11-bit identifiers are indented once a 29-bit one has been shown.
    """

    def __init__(
        self, timestamps: str = "", *, log: bool = False, extra: bool = False, errors: bool = False, width: int = 0
    ) -> None:
        """Raises InputError for another kind of timestamp."""
        if timestamps not in TIMESTAMPS:
            raise InputError(f"timestamps {timestamps!r}: allowed are {', '.join(TIMESTAMPS[1:])}")
        self._kind = timestamps
        self._log = log
        self._extra = extra
        self._errors = errors
        self._width = width
        self._indent = ""
        self._reference_us: int | None = None
        self._second = (-1, "")

    def lines(self, block: CandumpBlock) -> list[str]:
        """The text of each frame of a block, in order. With -e, an error frame's text has several lines."""
        line = self._log_line if self._log else self._screen_line
        frames = block.frames
        names = block.names
        found = []
        data = frames["data"].tobytes()
        numbers = zip(
            frames["t_ns"].tolist(), frames["can_id"].tolist(), frames["length"].tolist(),
            block.interface.tolist(), block.sent.tolist(), strict=True,
        )  # fmt: skip
        for row, (t_ns, can_id, length, interface, sent) in enumerate(numbers):
            name = names[interface]
            self._width = max(self._width, len(name))
            payload = data[8 * row : 8 * row + length]
            found.append(line(t_ns // 1000, can_id, length, payload, name.rjust(self._width), sent))
        return found

    def _log_line(self, t_us: int, can_id: int, length: int, data: bytes, name: str, sent: bool) -> str:
        if can_id & REMOTE_FLAG and not can_id & ERROR_FLAG:
            payload = f"R{length}" if length else "R"
        else:
            payload = data.hex().upper()
        way = "" if not self._extra else " T" if sent else " R"
        return f"({_seconds(t_us, 10)}) {name} {identifier_text(can_id)}#{payload}{way}"

    def _screen_line(self, t_us: int, can_id: int, length: int, data: bytes, name: str, sent: bool) -> str:
        if can_id & EXTENDED_FLAG and not self._indent:
            self._indent = "     "
        way = "" if not self._extra else "  TX - -" if sent else "  RX - -"
        indent = "" if can_id & (EXTENDED_FLAG | ERROR_FLAG) else self._indent
        stamp = self._stamp(t_us) if self._kind else ""
        start = f" {stamp} {name}{way}  {indent}{identifier_text(can_id)}   [{length}] "
        if can_id & ERROR_FLAG:
            text = start + "".join(f" {byte:02X}" for byte in data).ljust(27) + "ERRORFRAME"
            return text + "\n\t" + error_text(can_id, data).replace("\n", "\n\t") if self._errors else text
        if can_id & REMOTE_FLAG:
            return start + " remote request"
        return start + " " + data.hex(" ").upper() if length else start

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
    """3 hexadecimal digits for an 11-bit identifier; 8 for a 29-bit one, and for an error frame, with its flag."""
    if can_id & ERROR_FLAG:
        return f"{can_id & _ERROR_MASK:08X}"
    if can_id & EXTENDED_FLAG:
        return f"{can_id & _IDENTIFIER_MASK:08X}"
    return f"{can_id & STANDARD_MASK:03X}"


def _seconds(t_us: int, digits: int) -> str:
    return f"{t_us // 1_000_000:0{digits}d}.{t_us % 1_000_000:06d}"
