"""Texas Instruments ADS1220: 24 bits, two differential inputs on one converter, SPI in mode 1 (CPOL 0, CPHA 1).

Register facts (SBAS501C, section 8.6): 0: MUX 7-4, GAIN 3-1, PGA_BYPASS 0. 1: DR 7-5, MODE 4-3, CM 2, TS 1, BCS 0.
2: VREF 7-6, 50/60 5-4, PSW 3, IDAC 2-0. 3: DRDYM 1. Commands: RESET 06h, START 08h, RREG 2rh | count - 1, WREG 4rh |
count - 1. DRDY falls when a result is ready and rises with the first clock of its 24 bits. Writing a register while it
converts continuously restarts the conversion, and the filter settles in one. MUX 0000: AIN0 - AIN1, 0101: AIN2 - AIN3,
1110: both inputs to mid-supply, which shows the offset. TS: 14 bits at the left, 0.03125 degC each.
"""

from .source import CONVERSIONS_LOST, SUPPLY, Chip, choice, signed24

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Protocol

    class Spi(Protocol):
        """The used part of ``machine.SPI``."""

        def write(self, data: bytes) -> None: ...  # what is received is ignored
        def readinto(self, buffer: bytearray, write: int = 0) -> None: ...  # receive while sending ``write``

    class Pin(Protocol):
        """The used part of ``machine.Pin``."""

        def value(self, level: int = ...) -> int: ...


RESET, START, RREG_ALL, WREG_ALL, WREG_0, WREG_1 = 0x06, 0x08, 0x23, 0x43, 0x40, 0x44
MUX = (0x00, 0x50)  # AIN0 - AIN1, AIN2 - AIN3
MUX_SHORTED = 0xE0
CONTINUOUS, TEMPERATURE, TURBO = 0x04, 0x02, 0x10
GAINS = (1, 2, 4, 8, 16, 32, 64, 128)
RATES = (20, 45, 90, 175, 330, 600, 1000)  # normal mode, by DR
TURBO_RATES = (40, 90, 180, 350, 660, 1200, 2000)
REFERENCES = {"internal": 0x00, "ref0": 0x40, "ref1": 0x80, "supply": 0xC0}

RESET_US = 1000  # at least 50 us and 32 clocks
OFFSET_READINGS = 8
TEMPERATURE_EVERY_US = 10000000

_RESET, _CONFIGURE, _OFFSET, _RUN = 0, 1, 2, 3


class Ads1220(Chip):
    """One chip: ``spi`` at up to 5 MHz in mode 1, ``cs`` and ``drdy`` pins.

    ``reference`` is "ref0" for a bridge supplied from REFP0 and REFN0 (ratiometric), "ref1", "supply" or "internal".
    The offset is measured at the start with shorted inputs, and subtracted. The chip's temperature is read every ten
    seconds, at the cost of one conversion. Raises ValueError for a setting that the chip does not have.
    """

    def __init__(
        self, spi: "Spi", cs: "Pin", drdy: "Pin", channels: int = 1, gain: int = 128, rate: int = 1000,
        reference: str = "ref0",
    ) -> None:  # fmt: skip
        choice("channels", channels, (1, 2))
        if reference not in REFERENCES:
            raise ValueError("reference: %r, allowed %s" % (reference, ", ".join(sorted(REFERENCES))))
        turbo = rate not in RATES
        rates = TURBO_RATES if turbo else RATES
        if rate not in rates:
            choice("rate", rate, RATES + TURBO_RATES)
        self._reg0 = choice("gain", gain, GAINS) << 1
        self._reg1 = rates.index(rate) << 5 | (TURBO if turbo else 0) | CONTINUOUS
        self._reg2 = REFERENCES[reference]
        self._spi, self._cs, self._drdy = spi, cs, drdy
        self._cs.value(1)
        self.channels = channels
        self.period_us = 1000000 // rate * channels
        self._patience_us = 1000000 // rate * CONVERSIONS_LOST + RESET_US
        self.offset = 0
        self._three, self._four = bytearray(3), bytearray(4)
        self._counts = [0] * channels
        self._channel = self._left = self._sum = 0
        self._warming = False  # the current conversion measures the temperature
        self._temperature_us = 0

    def poll(self, now_us: int) -> "tuple[int, ...] | None":
        """Run one small step; return the counts of all channels after the last of them."""
        if now_us < self._next_us:
            return None
        if self._state == _RESET:
            self._command(bytes((RESET,)))
            self._state, self._next_us = _CONFIGURE, now_us + RESET_US
        elif self._state == _CONFIGURE:
            self._configure(now_us)
        elif self._drdy.value() == 0:
            return self._take(now_us)
        elif now_us > self._deadline_us:
            self._again(now_us)
        return None

    def _configure(self, now_us: int) -> None:
        wanted = bytes((MUX_SHORTED | self._reg0, self._reg1, self._reg2, 0))
        self._command(bytes((WREG_ALL,)) + wanted)
        self._cs.value(0)
        self._spi.write(bytes((RREG_ALL,)))
        self._spi.readinto(self._four)
        self._cs.value(1)
        if bytes(self._four) != wanted:
            self.faults |= SUPPLY  # the chip is missing, or without its supply
            self._again(now_us)
            return
        self._command(bytes((START,)))
        self._state, self._left, self._sum = _OFFSET, OFFSET_READINGS, 0
        self._channel, self._warming, self._temperature_us = 0, False, now_us
        self._deadline_us = now_us + self._patience_us

    def _take(self, now_us: int) -> "tuple[int, ...] | None":
        self._cs.value(0)
        self._spi.readinto(self._three)
        self._cs.value(1)
        raw = signed24(self._three)
        self._deadline_us = now_us + self._patience_us
        if self._state == _OFFSET:
            self._sum += raw
            self._left -= 1
            if not self._left:
                self.offset = self._sum // OFFSET_READINGS
                self._state = _RUN
                self._select()
            return None
        if self._warming:
            self.temperature = (raw >> 10) * 25 // 8  # 0.03125 degC in steps of 0.01
            self._warming = False
            self._command(bytes((WREG_1, self._reg1)))
            return None
        # A count at the end of the range is not corrected: subtracting the offset would hide the saturation.
        inside = self.count_min < raw < self.count_max
        self._counts[self._channel] = raw - self.offset if inside else raw
        self._channel = (self._channel + 1) % self.channels
        if self.channels > 1:
            self._select()
        if self._channel:
            return None
        if now_us - self._temperature_us >= TEMPERATURE_EVERY_US:
            self._temperature_us, self._warming = now_us, True
            self._command(bytes((WREG_1, self._reg1 | TEMPERATURE)))
        return tuple([max(self.count_min, min(self.count_max, count)) for count in self._counts])

    def _select(self) -> None:
        self._command(bytes((WREG_0, MUX[self._channel] | self._reg0)))

    def _command(self, data: bytes) -> None:
        self._cs.value(0)
        self._spi.write(data)
        self._cs.value(1)
