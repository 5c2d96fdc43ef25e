"""Which frames of a bus are wanted, in SocketCAN's terms: the kernel applies it, and numpy does where no kernel can."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.device.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, STANDARD_MASK

INVERSE_FLAG = 1 << 29
"""CAN_INV_FILTER of linux/can.h: in a filter's identifier this bit says that the match is to fail."""


@dataclass(frozen=True, slots=True)
class Filter:
    """A frame passes when ((its can_id ^ ``can_id``) & ``mask``) is zero, or is not, where ``inverse``."""

    can_id: int
    mask: int
    inverse: bool = False

    def passes(self, can_id: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
        """Which of these can_ids (n,), flags included, pass: (n,)."""
        mask = self.mask
        if mask & EXTENDED_FLAG and not self.can_id & EXTENDED_FLAG:
            mask &= STANDARD_MASK | EXTENDED_FLAG | REMOTE_FLAG  # the kernel: a filter for 11 bits looks at 11 bits
        differs: npt.NDArray[np.bool_] = ((can_id ^ np.uint32(self.can_id)) & np.uint32(mask)).astype(np.bool_)
        return differs if self.inverse else ~differs

    def kernel_words(self) -> tuple[int, int]:
        """The filter as ``struct can_filter`` has it: identifier and mask."""
        return self.can_id | (INVERSE_FLAG if self.inverse else 0), self.mask


@dataclass(frozen=True, slots=True)
class Selection:
    """The filters of one socket: no filter passes every data frame, an ``error_mask`` of 0 no error frame.

    A data frame passes when it passes one of ``filters``, or with ``join`` all of them. An error frame passes when it
    has one of the classes of ``error_mask`` (linux/can/error.h).
    """

    filters: tuple[Filter, ...] = ()
    join: bool = False
    error_mask: int = 0

    @property
    def everything(self) -> bool:
        """No filter and no error mask were given."""
        return not self.filters and not self.error_mask

    def passes(self, can_id: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
        """Which of these can_ids (n,), flags included, the kernel would hand to the socket: (n,)."""
        error = can_id & np.uint32(ERROR_FLAG) != 0
        passed = [one.passes(can_id) for one in self.filters] or [np.ones(len(can_id), dtype=np.bool_)]
        data = np.logical_and.reduce(passed) if self.join else np.logical_or.reduce(passed)
        wanted: npt.NDArray[np.bool_] = np.where(error, can_id & np.uint32(self.error_mask) != 0, data)
        return wanted
