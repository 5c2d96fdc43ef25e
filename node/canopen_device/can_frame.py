"""A classic CAN frame in the kernel and in python-can, and its length; identifiers carry the flags of linux/can.h."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG

if TYPE_CHECKING:
    import can

CAN_FRAME = struct.Struct("=IB3x8s")
"""struct can_frame: can_id with flags, data length, data."""

AFTER_CRC = 1 + 2 + 7 + 3  # CRC delimiter, acknowledge slot and delimiter, end of frame, intermission: never stuffed


def raw_can_id(message: can.Message) -> int:
    """Return the can_id of a python-can message, flags included."""
    can_id = message.arbitration_id
    if message.is_error_frame:
        return can_id | ERROR_FLAG
    if message.is_extended_id:
        can_id |= EXTENDED_FLAG
    return can_id | REMOTE_FLAG if message.is_remote_frame else can_id


def least_bits(data_bytes: int, extended: bool = False) -> int:
    """Return the bits of a frame without stuff bits, intermission included: 47 + 8 n, or 67 + 8 n (29-bit ID)."""
    return _stuffable(data_bytes, extended) + AFTER_CRC


def most_bits(data_bytes: int, extended: bool = False) -> int:
    """Return the same with the maximum of stuff bits: one after the first five bits, then one for every four."""
    stuffable = _stuffable(data_bytes, extended)
    return stuffable + AFTER_CRC + (stuffable - 1) // 4


def _stuffable(data_bytes: int, extended: bool) -> int:
    """Return the bits from start of frame to the end of the CRC sequence."""
    return (54 if extended else 34) + 8 * data_bytes
