"""Avia HX711: 24 bits, with a clock and a data pin driven by software.

Facts of the data sheet: DOUT low says that a conversion is ready; each rising edge of PD_SCK then brings a bit, most
significant first, and the 25th puts DOUT high again. 25, 26 or 27 pulses in all choose what is converted next: channel
A with gain 128, B with 32, A with 64. PD_SCK high for 60 us switches the chip off; low again resets it, to channel A
with gain 128. After a reset or a change of input the output settles within four conversions. The pin RATE chooses 10 or
80 conversions a second."""

from .source import CONVERSIONS_LOST, Chip, choice, signed24

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from .source import Steps

PULSES = {128: 25, 32: 26, 64: 27}
SETTLING = 4  # conversions
RESET_US = 100  # PD_SCK high for 60 us or more


class Hx711(Chip):
    """One chip with one gauge, at two ``machine.Pin``.

    ``lock`` and ``unlock`` disable interrupts while 25 bits are read: ``machine.disable_irq`` and
    ``machine.enable_irq``. An interrupt while PD_SCK is high would power the chip down. Raises ValueError for a gain or
    a rate that the chip does not have."""

    _retry_us = 0

    def __init__(
        self, dout: "Any", sck: "Any", gain: int = 128, rate: int = 80,
        lock: "Callable[[], int]" = lambda: 0, unlock: "Callable[[int], None]" = lambda _state: None,
    ) -> None:  # fmt: skip
        choice("gain", gain, (32, 64, 128))
        choice("rate", rate, (10, 80))
        self._dout, self._sck, self._lock, self._unlock = dout, sck, lock, unlock
        self._pulses = PULSES[gain]
        self.period_us = 1000000 // rate
        self._sck.value(1)

    def _run(self) -> "Steps":
        self._sck.value(1)  # a reset from any state of the chip
        self._next_us = self._now_us + RESET_US
        yield None
        self._sck.value(0)
        left, shown = SETTLING, None
        # The oscillator's error is up to a third, and the first conversion takes four periods.
        deadline_us = self._now_us + 2 * SETTLING * self.period_us
        while True:
            yield shown
            shown = None
            if self._dout.value():
                if self._now_us > deadline_us:
                    raise OSError("HX711: no conversion")
                continue
            count = self._take()
            deadline_us = self._now_us + CONVERSIONS_LOST * self.period_us
            if left:
                left -= 1
            else:
                shown = (count,)

    def _take(self) -> int:
        sck, dout = self._sck.value, self._dout.value
        value = 0
        state = self._lock()
        for _ in range(24):
            sck(1)
            value = value << 1 | dout()
            sck(0)
        sck(1)
        after = dout()  # the 25th pulse sets it high: if not, bits were lost or inserted
        sck(0)
        for _ in range(self._pulses - 25):
            sck(1)
            sck(0)
        self._unlock(state)
        if not after:
            raise OSError("HX711: out of step")
        return signed24(value)
