"""CAN FD frames beside classic ones: displayed, recorded and replayed, but not decoded, because CiA 301 has none."""

from __future__ import annotations

import re
from typing import NamedTuple

BIT_RATE_SWITCH, ERROR_STATE = 0x01, 0x02
"""Bits of ``flags``: CANFD_BRS and CANFD_ESI of linux/can.h."""

LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""The valid data lengths of an FD frame."""


class FdFrame(NamedTuple):
    """One CAN FD frame of a block; it came just before the classic frame ``row`` of the block (or after the last)."""

    row: int
    t_ns: int
    can_id: int  # with SocketCAN's flags
    flags: int
    data: bytes  # 0 to 64 bytes
    interface: int  # index into the block's names
    sent: bool


_LOG = re.compile(r"#([0-9A-Fa-f])((?:[0-9A-Fa-f]{2}\.?)*)")
_SCREEN = re.compile(r"\s*((?:[0-9A-Fa-f]{2}(?:\s|$))*)\s*(ERRORFRAME|'.*')?\s*")


def log_payload(text: str) -> tuple[int, bytes]:
    """Return (flags, data) after the first # of a line in candump's log format. ValueError: the reason."""
    match = _LOG.fullmatch(text)
    if match is None:
        raise ValueError("data")
    return int(match[1], 16), _checked(bytes.fromhex(match[2].replace(".", "")))


def screen_payload(length: int, text: str) -> bytes:
    """Return the data from the text after the [length] in candump's screen format. ValueError: the reason."""
    match = _SCREEN.fullmatch(text)
    if match is None:
        raise ValueError("data")
    data = _checked(bytes.fromhex(match[1]))
    if len(data) != length:
        raise ValueError("length")
    return data


def _checked(data: bytes) -> bytes:
    if len(data) not in LENGTHS:
        raise ValueError("length")
    return data
