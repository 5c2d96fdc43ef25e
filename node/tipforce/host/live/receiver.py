"""Interface of every live receiver, independent of the bus.

SocketCAN's filters select frames: the kernel applies them, or numpy on other interfaces.
"""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass
from typing import ClassVar, Protocol, Self

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, STANDARD_MASK
from tipforce.errors import EnvironmentLackError
from tipforce.host.frames.frame_array import FrameArray
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
