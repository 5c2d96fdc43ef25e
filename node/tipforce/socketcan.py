"""Convert frames between the kernel's ``struct can_frame`` and python-can's Message.

Inside tipforce an identifier always carries its type in the flag bits of linux/can.h.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from tipforce.device.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG

if TYPE_CHECKING:
    import can

CAN_FRAME = struct.Struct("=IB3x8s")
"""struct can_frame: can_id with flags, data length, data."""


def raw_can_id(message: can.Message) -> int:
    """Return the can_id of a python-can message, flags included."""
    can_id = message.arbitration_id
    if message.is_error_frame:
        return can_id | ERROR_FLAG
    if message.is_extended_id:
        can_id |= EXTENDED_FLAG
    return can_id | REMOTE_FLAG if message.is_remote_frame else can_id
