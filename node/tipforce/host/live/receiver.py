"""Interface of every live receiver, independent of the bus; and a group of several. SocketCAN's filters select frames:
the kernel applies them, or numpy on other interfaces."""

import math
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, STANDARD_MASK
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock, FdFrame

TICK_S = 0.001
"""The minimum time between two batches: it delays faster frames, which are returned together, at most this much."""


SWITCH_INTERVAL_S = 0.0005
"""While a receiver is open, a busy Python thread gives up the interpreter after this time. At Python's default a batch
waits up to 5 ms for it, in which twenty times as many frames arrive. A switch costs 1 % of this interval."""


class ShortSwitchInterval:
    """Sets ``sys.setswitchinterval`` to at most SWITCH_INTERVAL_S until all of these are closed."""

    _lock: ClassVar = threading.Lock()
    _open: ClassVar[set["ShortSwitchInterval"]] = set()
    _before_s: ClassVar[float] = 0.0
    _set_s: ClassVar[float] = 0.0

    def __init__(self) -> None:
        kind = ShortSwitchInterval
        with kind._lock:
            if not kind._open:
                kind._before_s = sys.getswitchinterval()
                sys.setswitchinterval(min(kind._before_s, SWITCH_INTERVAL_S))
                kind._set_s = sys.getswitchinterval()
            kind._open.add(self)

    def close(self) -> None:
        """Restore the interval, if this is the last one and the program did not set another."""
        kind = ShortSwitchInterval
        with kind._lock:
            is_last = kind._open == {self}
            kind._open.discard(self)
            if is_last and sys.getswitchinterval() == kind._set_s:
                sys.setswitchinterval(kind._before_s)


class InterfaceDownError(EnvironmentLackError):
    """The interface went down during reception; the receiver continues when it is up again."""


class Receiver:
    """A receiver on a bus. A context manager; ``names`` are the interfaces of the received frames."""

    @property
    def dropped(self) -> int:
        """Frames that the kernel dropped because they were not read in time, as far as it is known."""
        return 0

    def receive(self, timeout_s: float | None = None) -> FrameArray:
        """Return classic frames, FRAME (n,), as soon as there is one, n = 0 after ``timeout_s``; ``channel`` indexes
        the names. Raises EnvironmentLackError if the bus fails, InterfaceDownError if it may recover."""
        return self.receive_block(timeout_s).frames

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """Return the same frames with interface names and CAN FD frames."""
        raise NotImplementedError

    def fileno(self) -> int:
        """Return a file descriptor to wait on; -1 if there is none: python-can buffers frames outside of one."""
        return -1

    def close(self) -> None:
        """Stop receiving."""
        raise NotImplementedError

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
    """Filters of a socket: a data frame passes if it passes one of ``filters`` (all with ``join``; none: every frame),
    an error frame if it has one of the classes of ``error_mask`` (linux/can/error.h)."""

    filters: tuple[Filter, ...] = ()
    join: bool = False
    error_mask: int = 0
    channel: str = ""
    """That a word of a command line names with them."""

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


class ReceiverGroup(Receiver):
    """Receive from all of ``receivers``, which it owns. A context manager; ``at_end`` is called when it is closed."""

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
        self._failures: deque[EnvironmentLackError] = deque()  # for the next calls: no frame of another bus is lost
        # Not every python-can bus has a file descriptor to wait for: then all are read, every tick.
        self._poll = select.poll() if all(receiver.fileno() >= 0 for receiver in self._receivers) else None
        if self._poll is not None:
            for receiver in self._receivers:
                self._poll.register(receiver.fileno(), select.POLLIN)

    @property
    def dropped(self) -> int:
        """Frames that the kernel dropped so far, on all buses."""
        return sum(receiver.dropped for receiver in self._receivers)

    def close(self) -> None:
        """Close all receivers."""
        self._closing.close()

    def receive_block(self, timeout_s: float | None = None) -> CandumpBlock:
        """See Receiver."""
        if len(self._receivers) == 1:
            return self._receivers[0].receive_block(timeout_s)
        end_s = math.inf if timeout_s is None else time.monotonic() + timeout_s
        blocks: list[CandumpBlock] = []
        while not blocks and not self._failures:
            # Other threads run during the wait, and the frames of all buses are read together.
            time.sleep(max(min(self._next_s, end_s) - time.monotonic(), 0.0))
            left_s = max(end_s - time.monotonic(), 0.0)
            ready = self._receivers
            if self._poll is not None:
                file_descriptors = {fd for fd, _ in self._poll.poll(None if left_s == math.inf else left_s * 1000)}
                ready = tuple(receiver for receiver in ready if receiver.fileno() in file_descriptors)
            for receiver in ready:
                try:
                    blocks += [block for block in (receiver.receive_block(0),) if len(block)]
                except EnvironmentLackError as error:
                    self._failures.append(error)
            self._next_s = time.monotonic() + (self._tick_s if self._poll is not None else max(self._tick_s, TICK_S))
            if time.monotonic() >= end_s:
                break
        if self._failures and not blocks:
            raise self._failures.popleft()
        return merged(blocks, self._names)


def merged(blocks: Sequence[CandumpBlock], names: dict[str, int]) -> CandumpBlock:
    """Return the frames of several blocks in the order of their time stamps; new names are added to ``names``."""
    if not blocks:
        return CandumpBlock(np.zeros(0, dtype=FRAME), tuple(names))
    fd: list[FdFrame] = []
    for block in blocks:
        number = np.array([names.setdefault(name, len(names)) for name in block.names], np.uint8)
        block.frames["channel"] = number[block.frames["channel"]]
        fd += [frame._replace(interface=int(number[frame.interface])) for frame in block.fd]
    fd.sort(key=lambda frame: frame.t_ns)
    frames: FrameArray = np.concatenate([block.frames for block in blocks])
    frames = frames[np.argsort(frames["t_ns"], kind="stable")]
    rows = np.searchsorted(frames["t_ns"], [frame.t_ns for frame in fd]).tolist()
    placed = tuple(frame._replace(row=row) for frame, row in zip(fd, rows, strict=True))
    return CandumpBlock(frames, tuple(names), fd=placed)
