"""Format frames as candump text, byte for byte: the screen format and the log format of can-utils 2020.11."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_MASK, REMOTE_FLAG, STANDARD_MASK
from tipforce.host.frames.frame_block import CandumpBlock, Frame

_EXTRA = ("- -", "B -", "- E", "B E")  # bit rate switch and error state, by the flags of a CAN FD frame
_ERROR_MASK = ERROR_FLAG | EXTENDED_MASK


@dataclass(slots=True)
class CandumpFormat:
    """Format frames as candump does, one string per frame without line end.

    ``timestamps``: "", "a", "z", "d", "A" (its -t); ``log`` is -L, ``extra`` -x, ``errors`` -e, ``ascii`` -a;
    ``width``: of the longest interface name of the command line. Like candump, it keeps state: names align with the
    longest so far (not with ``align`` False), and 11-bit identifiers are indented after the first 29-bit one."""

    timestamps: str = ""
    log: bool = field(default=False, kw_only=True)
    extra: bool = field(default=False, kw_only=True)
    errors: bool = field(default=False, kw_only=True)
    ascii: bool = field(default=False, kw_only=True)
    width: int = field(default=0, kw_only=True)
    align: bool = field(default=True, kw_only=True)
    _indent: str = ""
    _reference_us: int | None = None
    _second: tuple[int, str] = (-1, "")

    def lines(self, block: CandumpBlock) -> list[str]:
        """Return the text of each frame of a block, CAN FD included, in order (error frames with -e: several lines)."""
        names = block.names
        return [self._line(frame, names) for frame in block.in_order()]

    def _line(self, frame: Frame, names: Sequence[str]) -> str:
        t_ns, can_id, length, data, interface, sent, fd_flags = frame
        is_fd, flags = fd_flags is not None, fd_flags or 0
        name, remote = names[interface], can_id & REMOTE_FLAG
        if self.align:
            self.width = max(self.width, len(name))
            name = name.rjust(self.width)
        if self.log:
            payload = (f"R{length}" if length else "R") if remote else data.hex().upper()
            payload = f"#{flags & 0xF:X}{payload}" if is_fd else payload
            way = "" if not self.extra else " T" if sent else " R"
            return f"({_seconds(t_ns // 1000, 10)}) {name} {identifier_text(can_id)}#{payload}{way}"
        start = self._start(t_ns // 1000, can_id, name, sent, flags)
        start += f"  [{length:02d}] " if is_fd else f"   [{length}] "
        return self._with_errors(f"{start} remote request", can_id, data) if remote else self._data(start, can_id, data)

    def _start(self, t_us: int, can_id: int, name: str, sent: bool, flags: int) -> str:
        if can_id & EXTENDED_FLAG and not self._indent:
            self._indent = "     "
        way = f"  {'TX' if sent else 'RX'} {_EXTRA[flags & 3]}" if self.extra else ""
        indent = "" if can_id & (EXTENDED_FLAG | ERROR_FLAG) else self._indent
        stamp = self._stamp(t_us) if self.timestamps else ""
        return f" {stamp} {name}{way}  {indent}{identifier_text(can_id)}"

    def _data(self, start: str, can_id: int, data: bytes) -> str:
        text = f"{start} {data.hex(' ').upper()}" if data else start
        if len(data) > 8:  # candump appends nothing after this many bytes
            return self._with_errors(text, can_id, data)
        gap = " " * (3 * (8 - len(data)) + 3)
        if can_id & ERROR_FLAG:
            return self._with_errors(f"{text}{gap}ERRORFRAME", can_id, data)
        if self.ascii:
            return f"{text}{gap}'{''.join(chr(byte) if 0x1F < byte < 0x7F else '.' for byte in data)}'"
        return text

    def _with_errors(self, text: str, can_id: int, data: bytes) -> str:
        if not self.errors or not can_id & ERROR_FLAG:
            return text
        return text + "\n\t" + error_text(can_id, data).replace("\n", "\n\t")

    def _stamp(self, t_us: int) -> str:
        if self.timestamps == "a":
            return f"({_seconds(t_us, 10)}) "
        if self.timestamps == "A":
            second = t_us // 1_000_000
            if self._second[0] != second:
                self._second = second, time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(second))
            return f"({self._second[1]}.{t_us % 1_000_000:06d}) "
        since = t_us if self._reference_us is None else self._reference_us
        if self._reference_us is None or self.timestamps == "d":
            self._reference_us = t_us
        return f"({_seconds(max(t_us - since, 0), 3)}) "


def identifier_text(can_id: int) -> str:
    """Return 3 hexadecimal digits for an 11-bit identifier; 8 for a 29-bit one, and for error frames (with flag)."""
    if can_id & ERROR_FLAG:
        return f"{can_id & _ERROR_MASK:08X}"
    if can_id & EXTENDED_FLAG:
        return f"{can_id & EXTENDED_MASK:08X}"
    return f"{can_id & STANDARD_MASK:03X}"


def _seconds(t_us: int, digits: int) -> str:
    return f"{t_us // 1_000_000:0{digits}d}.{t_us % 1_000_000:06d}"


ERROR_CLASSES = (
    "tx-timeout lost-arbitration controller-problem protocol-violation transceiver-status no-acknowledgement-on-tx "
    "bus-off bus-error restarted-after-bus-off"
)
"""Words for the bits of an error frame's identifier, from bit 0."""

CONTROLLER = (
    "rx-overflow tx-overflow rx-error-warning tx-error-warning rx-error-passive tx-error-passive back-to-error-active"
)
PROTOCOL = (
    "single-bit-error frame-format-error bit-stuffing-error tx-dominant-bit-error tx-recessive-bit-error bus-overload "
    "active-error error-on-tx"
)
LOCATIONS = (
    " unspecified id.28-to-id.21 start-of-frame bit-srtr bit-ide id.20-to-id.18 id.17-to-id.13 crc-sequence "
    "reserved-bit-0 data-field data-length-code bit-rtr reserved-bit-1 id.4-to-id.0 id.12-to-id.5 unspecified "
    "active-error-flag intermission tolerate-dominant-bits unspecified unspecified passive-error-flag error-delimiter "
    "crc-delimiter acknowledge-slot end-of-frame acknowledge-delimiter overload-flag unspecified unspecified "
    "unspecified"
)
"""Where in a frame the error is, by the number in byte 3; 0: not stated."""


def error_text(can_id: int, data: bytes) -> str:
    """Return the text of an error frame, one class a line, the counters last; ``data`` may be shorter than 8 bytes. A
    class that candump does not know is given by its number (candump repeats the previous line instead)."""
    data = data.ljust(8, b"\0")
    error_class = can_id & EXTENDED_MASK
    if error_class > 1 << len(ERROR_CLASSES.split()):
        return f"error class 0x{error_class:X} is unknown"
    location = dict(enumerate(LOCATIONS.split(" "))).get(data[3], "")
    details = {
        "lost-arbitration": f"{{at bit {data[0]}}}",
        "controller-problem": f"{{{','.join(_set(data[1], CONTROLLER))}}}",
        "protocol-violation": f"{{{{{','.join(_set(data[2], PROTOCOL))}}}{{{location}}}}}",
    }
    text = "\n".join(name + details.get(name, "") for name in _set(error_class, ERROR_CLASSES))
    if data[6] or data[7]:
        text += f"\nerror-counter-tx-rx{{{{{data[6]}}}{{{data[7]}}}}}"
    return text


def _set(bits: int, words: str) -> list[str]:
    return [word for position, word in enumerate(words.split()) if bits >> position & 1]
