"""Select frames of a bus by SocketCAN filters: applied by the kernel, or by numpy on other interfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, STANDARD_MASK

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
        passed = [one.passes(can_id) for one in self.filters] or [np.ones(len(can_id), dtype=np.bool_)]
        data = np.logical_and.reduce(passed) if self.join else np.logical_or.reduce(passed)
        wanted: npt.NDArray[np.bool_] = np.where(error, can_id & np.uint32(self.error_mask) != 0, data)
        return wanted
