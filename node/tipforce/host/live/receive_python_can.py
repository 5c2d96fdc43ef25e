"""Live reception through python-can, for every interface except SocketCAN: the same methods, the same blocks."""

from __future__ import annotations

from collections.abc import Iterable

import can
import numpy as np

from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.fd_frame import BIT_RATE_SWITCH, ERROR_STATE, FdFrame
from tipforce.host.frames.frame_array import FRAME, SENT, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.live.can_filter import Selection
from tipforce.host.live.receiver import Receiver, ShortSwitchInterval
from tipforce.socketcan import raw_can_id

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

    @property
    def dropped(self) -> int:
        """0: python-can does not report dropped frames."""
        return 0

    def fileno(self) -> int:
        """Return -1: many interfaces of python-can buffer frames outside the file descriptor."""
        return -1

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
                text = f"the bus failed: {error}; `ip -details link` shows its state"
                raise EnvironmentLackError(text) from error
        return self._block(messages)

    def _block(self, messages: list[can.Message]) -> CandumpBlock:
        block = message_block(messages, self._names, self._channel)
        if self._selection.everything and not any(message.is_error_frame for message in messages):
            return block
        fd_id = np.array([one.can_id for one in block.fd], dtype=np.uint32)
        return block.take(self._selection.passes(block.frames["can_id"]), self._selection.passes(fd_id))


def message_block(messages: Iterable[can.Message], names: dict[str, int], channel: str = "") -> CandumpBlock:
    """Return python-can messages as a block; ``names`` gets new interfaces, from ``channel`` or from each message."""

    def interface(message: can.Message) -> int:
        name = channel or str("can" if message.channel is None else message.channel)
        return names.setdefault(name, len(names))

    classic: list[can.Message] = []
    fd: list[FdFrame] = []
    for message in messages:
        if message.is_fd:
            flags = message.bitrate_switch * BIT_RATE_SWITCH + message.error_state_indicator * ERROR_STATE
            t_ns, data = round(message.timestamp * 1e9), bytes(message.data)
            can_id, sent = raw_can_id(message), not message.is_rx
            fd.append(FdFrame(len(classic), t_ns, can_id, flags, data, interface(message), sent))
        else:
            classic.append(message)
    frames = message_frames(classic)
    number = np.array([interface(message) for message in classic], dtype=np.uint16)
    frames["channel"] = number
    sent_here = np.array([not message.is_rx for message in classic], dtype=np.bool_)
    return CandumpBlock(frames, number, tuple(names), sent_here, fd=tuple(fd))


def message_frames(messages: list[can.Message]) -> FrameArray:
    """Return classic python-can messages as FRAME (n,); ``channel`` stays 0."""
    frames: FrameArray = np.zeros(len(messages), dtype=FRAME)
    frames["t_ns"] = [round(message.timestamp * 1e9) for message in messages]
    frames["can_id"] = [raw_can_id(message) for message in messages]
    frames["length"] = [min(message.dlc, 8) for message in messages]
    frames["flags"] = [0 if message.is_rx else SENT for message in messages]
    data = b"".join(bytes(message.data)[:8].ljust(8, b"\0") for message in messages)
    frames["data"] = np.frombuffer(data, dtype=np.uint8).reshape(-1, 8)
    return frames
