"""Combine several receivers into one: frames of all, in the order of their time stamps."""

from __future__ import annotations

import queue
import select
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np

from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.live.receiver import TICK_S, Receiver

_POLL_S = 0.1
_WAITING_BLOCKS = 64  # of all receivers; further frames wait in the buses themselves


class ReceiverGroup(Receiver):
    """Receive from all of ``receivers``, and take ownership of them. A context manager."""

    def __init__(self, receivers: Sequence[Receiver], *, tick_s: float = TICK_S) -> None:
        self._receivers = tuple(receivers)
        self._names: dict[str, int] = {}
        self._tick_s = tick_s
        self._next_s = 0.0
        self._closing = ExitStack()
        for receiver in self._receivers:
            self._closing.callback(receiver.close)
        self._poll: select.poll | None = None
        self._arrived: queue.Queue[CandumpBlock | Exception] = queue.Queue(_WAITING_BLOCKS)
        self._failure: Exception | None = None
        if len(self._receivers) > 1:
            self._prepare()

    def _prepare(self) -> None:
        if all(receiver.fileno() >= 0 for receiver in self._receivers):
            self._poll = select.poll()
            for receiver in self._receivers:
                self._poll.register(receiver.fileno(), select.POLLIN)
            return
        # One thread per bus: not every python-can bus has a file descriptor to wait for.
        stop = threading.Event()
        for receiver in self._receivers:
            thread = threading.Thread(target=_receive, args=(receiver, self._arrived, stop), daemon=True)
            thread.start()
            self._closing.callback(thread.join)
        self._closing.callback(stop.set)  # called first

    @property
    def dropped(self) -> int:
        """Frames that the kernel dropped so far, on all buses."""
        return sum(receiver.dropped for receiver in self._receivers)

    def fileno(self) -> int:
        """Return the file descriptor of a single receiver; -1 for several."""
        return self._receivers[0].fileno() if len(self._receivers) == 1 else -1

    def close(self) -> None:
        """Close all receivers."""
        self._closing.close()

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """See Receiver."""
        if len(self._receivers) == 1:
            return self._receivers[0].receive_block(timeout_s)
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        blocks: list[CandumpBlock] = []
        for item in self._poll_blocks(timeout_s) if self._poll is not None else self._queued_blocks(timeout_s):
            if isinstance(item, CandumpBlock):
                blocks.append(item)
            elif blocks or self._failure is not None:
                self._failure = item  # raised by the next call, so that frames of the other buses are not lost
            else:
                raise item
        return merged(blocks, self._names)

    def _poll_blocks(self, timeout_s: float | None) -> list[CandumpBlock | Exception]:
        assert self._poll is not None
        now = time.monotonic()
        if self._next_s > now:
            time.sleep(self._next_s - now if timeout_s is None else min(self._next_s - now, timeout_s))
        ready = {fd for fd, _ in self._poll.poll(None if timeout_s is None else timeout_s * 1000)}
        self._next_s = time.monotonic() + self._tick_s if ready else 0.0
        items: list[CandumpBlock | Exception] = []
        failures: list[CandumpBlock | Exception] = []
        for receiver in self._receivers:
            if receiver.fileno() in ready:
                try:
                    items.append(receiver.receive_block(0))
                except EnvironmentLackError as error:
                    failures.append(error)
        return items + failures

    def _queued_blocks(self, timeout_s: float | None) -> list[CandumpBlock | Exception]:
        items: list[CandumpBlock | Exception] = []
        try:
            items.append(self._arrived.get(timeout=timeout_s))
            while isinstance(items[-1], CandumpBlock):
                items.append(self._arrived.get_nowait())
        except queue.Empty:
            pass
        return items


def merged(blocks: Sequence[CandumpBlock], names: dict[str, int]) -> CandumpBlock:
    """Return the frames of several blocks in the order of their time stamps; new names are added to ``names``."""
    if not blocks:
        empty = np.zeros(0, dtype=np.uint16)
        return CandumpBlock(np.zeros(0, dtype=FRAME), empty, tuple(names), empty.astype(np.bool_))
    number = [np.array([names.setdefault(name, len(names)) for name in block.names], np.uint16) for block in blocks]
    frames: FrameArray = np.concatenate([block.frames for block in blocks])
    order = np.argsort(frames["t_ns"], kind="stable")
    interface = np.concatenate([table[block.interface] for table, block in zip(number, blocks, strict=True)])[order]
    sent = np.concatenate([block.sent for block in blocks])[order]
    frames = frames[order]
    frames["channel"] = interface
    fd = [
        frame._replace(interface=int(table[frame.interface]))
        for table, block in zip(number, blocks, strict=True)
        for frame in block.fd
    ]
    fd.sort(key=lambda frame: frame.t_ns)
    rows = np.searchsorted(frames["t_ns"], [frame.t_ns for frame in fd]).tolist()
    placed = tuple(frame._replace(row=row) for frame, row in zip(fd, rows, strict=True))
    return CandumpBlock(frames, interface, tuple(names), sent, fd=placed)


def _receive(receiver: Receiver, arrived: queue.Queue[CandumpBlock | Exception], stop: threading.Event) -> None:
    """Pass on the blocks of one receiver until the stop event; runs in its own thread."""
    item: CandumpBlock | Exception
    while not stop.is_set():
        try:
            item = receiver.receive_block(_POLL_S)
        except EnvironmentLackError as error:
            item = error
        if isinstance(item, Exception) or len(item):
            while not stop.is_set():
                try:
                    arrived.put(item, timeout=_POLL_S)
                    break
                except queue.Full:
                    continue
        if isinstance(item, Exception):
            return
