"""Interface of every live receiver, independent of the bus; and a group of several.

SocketCAN's filters select frames: the kernel applies them, or numpy on other interfaces.
"""

from __future__ import annotations

import queue
import select
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import ClassVar, Protocol, Self

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, STANDARD_MASK
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock

TICK_S = 0.001
"""The minimum time between two batches: it delays faster frames, which are returned together, at most this much."""


SWITCH_INTERVAL_S = 0.0005
"""While a receiver is open, a busy Python thread gives up the interpreter after this time; Python's default is 5 ms.

At the default a batch waits up to 5 ms for the interpreter each time that the receiving thread blocked, and twenty
times as many frames arrive meanwhile. A switch costs some microseconds, 1 % of this interval.
"""


class ShortSwitchInterval:
    """Sets ``sys.setswitchinterval`` to at most SWITCH_INTERVAL_S until all of these are closed."""

    _lock: ClassVar = threading.Lock()
    _open: ClassVar[int] = 0
    _before_s: ClassVar[float] = 0.0
    _set_s: ClassVar[float] = 0.0

    def __init__(self) -> None:
        self._closed = False
        kind = ShortSwitchInterval
        with kind._lock:
            if not kind._open:
                kind._before_s = sys.getswitchinterval()
                sys.setswitchinterval(min(kind._before_s, SWITCH_INTERVAL_S))
                kind._set_s = sys.getswitchinterval()
            kind._open += 1

    def close(self) -> None:
        """Restore the interval, if this is the last one and the program did not set another."""
        kind = ShortSwitchInterval
        with kind._lock:
            if self._closed:
                return
            self._closed = True
            kind._open -= 1
            if not kind._open and sys.getswitchinterval() == kind._set_s:
                sys.setswitchinterval(kind._before_s)


class InterfaceDownError(EnvironmentLackError):
    """The interface went down during reception; the receiver continues when it is up again."""


class Receiver(Protocol):
    """A receiver on a bus. A context manager; ``names`` are the interfaces of the received frames."""

    @property
    def dropped(self) -> int:
        """Frames that the kernel dropped because they were not read in time, as far as it is known."""

    def receive(self, timeout_s: float | None = None) -> FrameArray:
        """Return the classic frames received, FRAME (n,), as soon as there is one; n is 0 after ``timeout_s``.

        ``channel`` indexes the names of the block. Raises EnvironmentLackError if the bus fails,
        InterfaceDownError if it may recover.
        """
        return self.receive_block(timeout_s).frames

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """Return the same frames with interface names and CAN FD frames."""

    def fileno(self) -> int:
        """Return a file descriptor to wait on; -1 if there is none."""

    def close(self) -> None:
        """Stop receiving."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


INVERSE_FLAG = 1 << 29
"""CAN_INV_FILTER of linux/can.h: this bit in a filter's identifier inverts the match."""


@dataclass(frozen=True, slots=True)
class Filter:
    """Pass a frame if ((its can_id ^ ``can_id``) & ``mask``) is zero; with ``inverse``, if it is not."""

    can_id: int
    mask: int
    inverse: bool = False

    def passes(self, can_id: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
        """Return which of these can_ids (n,), flags included, pass: (n,)."""
        mask = self.mask
        if mask & EXTENDED_FLAG and not self.can_id & EXTENDED_FLAG:
            mask &= STANDARD_MASK | EXTENDED_FLAG | REMOTE_FLAG  # as the kernel: a filter for 11 bits compares 11 bits
        differs: npt.NDArray[np.bool_] = ((can_id ^ np.uint32(self.can_id)) & np.uint32(mask)).astype(np.bool_)
        return differs if self.inverse else ~differs

    def kernel_words(self) -> tuple[int, int]:
        """Return the filter as in ``struct can_filter``: identifier and mask."""
        return self.can_id | (INVERSE_FLAG if self.inverse else 0), self.mask


@dataclass(frozen=True, slots=True)
class Selection:
    """Filters of one socket: without filters every data frame passes; with an ``error_mask`` of 0 no error frame.

    A data frame passes if it passes one of ``filters``, or all of them with ``join``. An error frame passes if it
    has one of the classes of ``error_mask`` (linux/can/error.h).
    """

    filters: tuple[Filter, ...] = ()
    join: bool = False
    error_mask: int = 0

    @property
    def everything(self) -> bool:
        """True without filters and without an error mask."""
        return not self.filters and not self.error_mask

    def passes(self, can_id: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
        """Return which of these can_ids (n,), flags included, the kernel would pass to the socket: (n,)."""
        error = can_id & np.uint32(ERROR_FLAG) != 0
        passed = [rule.passes(can_id) for rule in self.filters] or [np.ones(len(can_id), dtype=np.bool_)]
        data = np.logical_and.reduce(passed) if self.join else np.logical_or.reduce(passed)
        wanted: npt.NDArray[np.bool_] = np.where(error, can_id & np.uint32(self.error_mask) != 0, data)
        return wanted


_POLL_S = 0.1
_WAITING_BLOCKS = 64  # of all receivers; further frames wait in the buses themselves


class ReceiverGroup(Receiver):
    """Receive from all of ``receivers``, and take ownership of them. A context manager.

    ``at_end``: called when it is closed.
    """

    def __init__(
        self, receivers: Sequence[Receiver], *, tick_s: float = TICK_S, at_end: Sequence[Callable[[], None]] = ()
    ) -> None:
        self._receivers = tuple(receivers)
        self._names: dict[str, int] = {}
        self._tick_s = tick_s
        self._next_s = 0.0
        self._closing = ExitStack()
        for close in (*(receiver.close for receiver in self._receivers), *at_end):
            self._closing.callback(close)
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
