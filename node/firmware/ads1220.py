"""Texas Instruments ADS1220: 24 bits, two differential inputs on one converter, SPI in mode 1 (CPOL 0, CPHA 1).

Register facts (SBAS501C, section 8.6): 0: MUX 7-4, GAIN 3-1, PGA_BYPASS 0. 1: DR 7-5, MODE 4-3, CM 2, TS 1, BCS 0.
2: VREF 7-6, 50/60 5-4, PSW 3, IDAC 2-0. 3: DRDYM 1. Commands: RESET 06h, START 08h, RREG 2rh | count - 1, WREG 4rh |
count - 1. DRDY falls when a result is ready and rises with the first clock of its 24 bits. Writing a register while it
converts continuously restarts the conversion, and the filter settles in one. MUX 0000: AIN0 - AIN1, 0101: AIN2 - AIN3,
1110: both inputs to mid-supply, which shows the offset. TS: 14 bits at the left, 0.03125 degC each."""

from .source import CONVERSIONS_LOST, SUPPLY, Chip, choice, signed24

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Generator
    from typing import Any

    from .source import Steps

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


class Ads1220(Chip):
    """One chip: ``spi`` is a ``machine.SPI`` at up to 5 MHz in mode 1, ``cs`` and ``drdy`` are each a ``machine.Pin``.

    ``reference`` is "ref0" for a bridge supplied from REFP0 and REFN0 (ratiometric), "ref1", "supply" or "internal".
    The offset is measured at the start with shorted inputs, and subtracted. The chip's temperature is read every ten
    seconds, at the cost of one conversion. Raises ValueError for a setting that the chip does not have."""

    def __init__(
        self, spi: "Any", cs: "Any", drdy: "Any", channels: int = 1, gain: int = 128, rate: int = 1000,
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

    def _run(self) -> "Steps":
        self._command(bytes((RESET,)))
        self._next_us = self._now_us + RESET_US
        yield None
        self._configure()
        temperature_us, total = self._now_us, 0
        for _ in range(OFFSET_READINGS):
            total += yield from self._conversion(None)
        self.offset = total // OFFSET_READINGS
        counts, shown = [0] * self.channels, None
        self._select(0)
        while True:
            for channel in range(self.channels):
                if self.channels > 1:
                    self._select(channel)
                raw = yield from self._conversion(shown)
                # A count at the end of the range is not corrected: subtracting the offset would hide the saturation.
                inside = self.count_min < raw < self.count_max
                counts[channel] = max(self.count_min, min(self.count_max, raw - self.offset)) if inside else raw
                shown = None
            shown = tuple(counts)
            if self._now_us - temperature_us >= TEMPERATURE_EVERY_US:
                temperature_us = self._now_us
                self._command(bytes((WREG_1, self._reg1 | TEMPERATURE)))
                raw = yield from self._conversion(shown)
                self.temperature = (raw >> 10) * 25 // 8  # 0.03125 degC in steps of 0.01
                self._command(bytes((WREG_1, self._reg1)))
                shown = None

    def _configure(self) -> None:
        wanted = bytes((MUX_SHORTED | self._reg0, self._reg1, self._reg2, 0))
        self._command(bytes((WREG_ALL,)) + wanted)
        self._cs.value(0)
        self._spi.write(bytes((RREG_ALL,)))
        self._spi.readinto(self._four)
        self._cs.value(1)
        if bytes(self._four) != wanted:
            self.faults |= SUPPLY
            raise OSError("ADS1220: missing, or without its supply")
        self._command(bytes((START,)))

    def _conversion(self, shown: "tuple[int, ...] | None") -> "Generator[tuple[int, ...] | None, None, int]":
        """Yield what the step before shows, and None until a conversion is there; return it."""
        deadline_us = self._now_us + self._patience_us
        yield shown
        while self._drdy.value():
            if self._now_us > deadline_us:
                raise OSError("ADS1220: no conversion")
            yield None
        self._cs.value(0)
        self._spi.readinto(self._three)
        self._cs.value(1)
        return signed24(int.from_bytes(self._three, "big"))

    def _select(self, channel: int) -> None:
        self._command(bytes((WREG_0, MUX[channel] | self._reg0)))

    def _command(self, data: bytes) -> None:
        self._cs.value(0)
        self._spi.write(data)
        self._cs.value(1)
