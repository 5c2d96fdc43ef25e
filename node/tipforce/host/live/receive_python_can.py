"""The receive path through python-can, for every interface that is not SocketCAN: the same call, the same blocks."""

from __future__ import annotations

from collections.abc import Iterable

import can
import numpy as np

from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.fd_frame import BIT_RATE_SWITCH, ERROR_STATE, FdFrame
from tipforce.host.frames.frame_array import FRAME, SENT, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.live.can_filter import Selection
from tipforce.host.live.receiver import Receiver
from tipforce.socketcan import raw_can_id

BURST = 512
"""Frames that one receive hands over at most."""


class PythonCanReceiver(Receiver):
    """Over a python-can bus, which it takes over."""

    def __init__(self, bus: can.BusABC, selection: Selection, channel: str = "") -> None:
        """``channel`` is the name of the interface in the blocks; empty: what each message says."""
        self._bus = bus
        self._selection = selection
        self._channel = "" if channel == "any" else channel
        self._names: dict[str, int] = {}

    @property
    def dropped(self) -> int:
        """0: python-can does not tell."""
        return 0

    def fileno(self) -> int:
        """None: many interfaces of python-can keep frames of their own behind the file."""
        return -1

    def close(self) -> None:
        """Shut the bus down."""
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
            if not messages:  # else the next call meets it again
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
    """Messages of python-can as a block; ``names`` grows by new interfaces, that ``channel`` or each message names."""

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
    """Classic messages of python-can as a FRAME array, shape (n,); ``channel`` is left at 0."""
    frames: FrameArray = np.zeros(len(messages), dtype=FRAME)
    frames["t_ns"] = [round(message.timestamp * 1e9) for message in messages]
    frames["can_id"] = [raw_can_id(message) for message in messages]
    frames["length"] = [min(message.dlc, 8) for message in messages]
    frames["flags"] = [0 if message.is_rx else SENT for message in messages]
    data = b"".join(bytes(message.data)[:8].ljust(8, b"\0") for message in messages)
    frames["data"] = np.frombuffer(data, dtype=np.uint8).reshape(-1, 8)
    return frames
