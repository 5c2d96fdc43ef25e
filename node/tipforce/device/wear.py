"""Budget of wear: how often anyone on the bus may make a device write or erase its flash."""

from . import codes
from .emcy import WEAR_BUDGET_EMPTY

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .node import Device

OPERATIONS, PERIOD_US = 200, 18000000  # so many at once; one back in each period: full again after an hour


class WearBudget:
    """Operations that 1010h, 1011h, the store of LSS, 1F50h and the erase of 1F51h share. A reset does not refill it.

    An operation is the write of one group of parameters, or the erase of one program.
    """

    __slots__ = ("_device", "_full_us", "_reported")

    def __init__(self, device: "Device") -> None:
        self._device = device
        self._full_us = 0  # when every operation will be back
        self._reported = False

    def drain(self) -> None:
        """Take all operations: of a restart without power-off, before which any number may have been used."""
        self._full_us = self._device.now_us + OPERATIONS * PERIOD_US

    def spend(self, operations: int) -> int:
        """Take operations, or none: return 0, or the abort code where there are too few. EMCY until full again: one."""
        now_us = self._device.now_us
        if self._full_us <= now_us:
            self._full_us = now_us
            self._reported = False
        full_us = self._full_us + operations * PERIOD_US
        if full_us - now_us <= OPERATIONS * PERIOD_US:
            self._full_us = full_us
            return 0
        if not self._reported:
            self._reported = True
            self._device.emcy.report(WEAR_BUDGET_EMPTY)
        return codes.DEVICE_STATE
