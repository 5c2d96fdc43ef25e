"""Frames and python-can's messages: reception on every interface except SocketCAN, and messages to send and to log."""

from collections.abc import Iterable

import can
import numpy as np

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, EXTENDED_MASK, REMOTE_FLAG
from canopen_device.errors import EnvironmentLackError, cause
from tipforce.host.frames.frame_block import BIT_RATE_SWITCH, ERROR_STATE, CandumpBlock, gathered, packed
from tipforce.host.live.receiver import Receiver, Selection, ShortSwitchInterval

BURST = 512
"""The maximum number of frames per receive."""


class PythonCanReceiver(Receiver):
    """Receiver on a python-can bus, of which it takes ownership."""

    def __init__(self, bus: can.BusABC, selection: Selection, channel: str = "") -> None:
        """``channel`` is the name of the interface in the blocks; empty: the name in each message."""
        self._bus = bus
        self._switch_interval = ShortSwitchInterval()
        self._selection = selection
        self._channel = "" if channel == "any" else channel
        self._names: dict[str, int] = {}

    def close(self) -> None:
        """Shut the bus down."""
        self._switch_interval.close()
        self._bus.shutdown()

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """See Receiver."""
        messages: list[can.Message] = []
        try:
            message = self._bus.recv(timeout_s)
            while message is not None:
                messages.append(message)
                message = self._bus.recv(0) if len(messages) < BURST else None
        except (can.CanError, OSError) as error:
            if not messages:  # otherwise the next call raises it
                text = f"the bus failed: {cause(error)}; `ip -details link` shows its state"
                raise EnvironmentLackError(text) from error
        block = message_block(messages, self._names, self._channel)
        if self._selection.everything and not any(message.is_error_frame for message in messages):
            return block
        fd_id = np.array([frame.can_id for frame in block.fd], dtype=np.uint32)
        return block.take(self._selection.passes(block.frames["can_id"]), self._selection.passes(fd_id))


def message_block(messages: Iterable[can.Message], names: dict[str, int], channel: str = "") -> CandumpBlock:
    """Return python-can messages as a block; ``names`` gets new interfaces, from ``channel`` or from each message."""
    rows = []
    for message in messages:
        name = channel or str("can" if message.channel is None else message.channel)
        rows.append(packed(message, round(message.timestamp * 1e9), names.setdefault(name, len(names))))
    return gathered(rows, tuple(names))


def message(
    t_ns: int, can_id: int, length: int, data: bytes, channel: str, sent: bool, fd_flags: int | None = None
) -> can.Message:
    """Return a frame, with the values of a ``Frame``, as a message."""
    error = bool(can_id & ERROR_FLAG)
    remote = bool(can_id & REMOTE_FLAG) and not error and fd_flags is None
    return can.Message(
        timestamp=t_ns / 1_000_000_000,
        arbitration_id=can_id & EXTENDED_MASK,
        is_extended_id=bool(can_id & EXTENDED_FLAG),
        is_remote_frame=remote,
        is_error_frame=error,
        dlc=length,
        data=None if remote else data,
        channel=channel,
        is_rx=not sent,
        is_fd=fd_flags is not None,
        bitrate_switch=bool((fd_flags or 0) & BIT_RATE_SWITCH),
        error_state_indicator=bool((fd_flags or 0) & ERROR_STATE),
    )
