"""Nuvoton NAU7802: 24 bits, two channels on one converter, I2C address 2Ah.

Register facts (data sheet revision 1.7, section 11): 00h PU_CTRL: RR 0, PUD 1, PUA 2, PUR 3, CS 4, CR 5, OSCS 6,
AVDDS 7. 01h CTRL1: GAINS 2-0, VLDO 5-3. 02h CTRL2: CALMOD 1-0, CALS 2, CAL_ERR 3, CRS 6-4, CHS 7. 12h-14h ADCO, most
significant byte first. 15h: 30h turns the chopper's clock off. 1Ch: PGA_CAP_EN 7, the capacitor across the second
channel's inputs. Power-up: RR, then PUD, PUR within 200 us. CALS goes back to zero when a calibration ends; CAL_ERR
then tells whether it failed. After a change of channel the filter needs some conversions to settle."""

from .source import CONVERSIONS_LOST, SUPPLY, Chip, choice, signed24

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from .source import Steps

ADDRESS = 0x2A
PU_CTRL, CTRL1, CTRL2, ADCO, ADC_CTRL, PGA_POWER = 0x00, 0x01, 0x02, 0x12, 0x15, 0x1C
RR, PUD, PUA, PUR, CS, CR, AVDDS = 0x01, 0x02, 0x04, 0x08, 0x10, 0x20, 0x80
CALS, CAL_ERR = 0x04, 0x08
GAINS = (1, 2, 4, 8, 16, 32, 64, 128)
RATES = (10, 20, 40, 80, 0, 0, 0, 320)  # by CRS
LDO_MILLIVOLTS = (4500, 4200, 3900, 3600, 3300, 3000, 2700, 2400)  # by VLDO

POWER_UP_US = 10000  # time-out of PUR
REGULATOR_US = 250000  # settling time of the analogue supply
CALIBRATION_US = 2000000  # time-out of CALS


class Nau7802(Chip):
    """One chip on a ``machine.I2C``; two chips need two buses or a multiplexer, because the address is fixed.

    ``channels`` is 1 or 2; with two each reading takes ``discard`` + 1 conversions per channel. ``ldo_millivolts`` is
    the bridge supply from the chip's regulator, 0 for an external AVDD. The chip calibrates the offset of amplifier and
    converter at each start, for each channel. Raises ValueError for a setting that it does not have."""

    def __init__(
        self, i2c: "Any", channels: int = 1, gain: int = 128, rate: int = 320, ldo_millivolts: int = 3000,
        discard: int = 6, address: int = ADDRESS,
    ) -> None:  # fmt: skip
        choice("channels", channels, (1, 2))
        choice("rate", rate, (10, 20, 40, 80, 320))
        self._crs = RATES.index(rate)
        self._ctrl1 = choice("gain", gain, GAINS)
        self._power = PUD | PUA | CS
        if ldo_millivolts:
            self._ctrl1 |= choice("ldo_millivolts", ldo_millivolts, LDO_MILLIVOLTS) << 3
            self._power |= AVDDS
        self._i2c, self._address = i2c, address
        self.channels = channels
        self._discard = discard if channels > 1 else 0
        self._conversion_us = 1000000 // rate
        self.period_us = self._conversion_us * (channels * (self._discard + 1) if channels > 1 else 1)
        self._byte, self._three = bytearray(1), bytearray(3)

    def _run(self) -> "Steps":
        yield from self._start()
        counts, shown = [0] * self.channels, None
        channel, left = 0, max(6, self._discard)
        deadline_us = self._now_us + self._conversion_us * CONVERSIONS_LOST
        while True:
            yield shown
            shown = None
            power = self._read(PU_CTRL)
            if power & (PUA | PUR) != PUA | PUR:
                self.faults |= SUPPLY
                raise OSError("NAU7802: it lost its power and its settings")
            if not power & CR:
                if self._now_us > deadline_us:
                    raise OSError("NAU7802: no conversion")
                continue
            self._i2c.readfrom_mem_into(self._address, ADCO, self._three)  # clears CR
            self._next_us = self._now_us + self._conversion_us // 2
            deadline_us = self._now_us + self._conversion_us * CONVERSIONS_LOST
            if left:
                left -= 1
                continue
            counts[channel] = signed24(int.from_bytes(self._three, "big"))
            if self.channels > 1:
                channel, left = 1 - channel, self._discard
                self._select(channel)
            if not channel:
                shown = tuple(counts)

    def _start(self) -> "Steps":
        self._write(PU_CTRL, RR)
        self._write(PU_CTRL, PUD)
        self._next_us, deadline_us = self._now_us + 200, self._now_us + POWER_UP_US
        yield None
        while not self._read(PU_CTRL) & PUR:
            if self._now_us > deadline_us:
                self.faults |= SUPPLY
                raise OSError("NAU7802: it responds, but does not power up")
            yield None
        self._write(CTRL1, self._ctrl1)
        self._write(PU_CTRL, self._power)
        self._write(ADC_CTRL, 0x30)
        if self.channels == 1:
            self._write(PGA_POWER, 0x80)
        self._next_us = self._now_us + REGULATOR_US
        yield None
        for channel in range(self.channels):
            self._select(channel, CALS)
            ctrl2, deadline_us = CALS, self._now_us + CALIBRATION_US
            while ctrl2 & CALS:
                if self._now_us > deadline_us:
                    raise OSError("NAU7802: the calibration does not end")
                self._next_us = self._now_us + 1000
                yield None
                ctrl2 = self._read(CTRL2)
            if ctrl2 & CAL_ERR:
                raise OSError("NAU7802: the calibration failed")
        self._select(0)
        self._write(PU_CTRL, self._power)  # CS: starts the conversions

    def _select(self, channel: int, calibrate: int = 0) -> None:
        self._write(CTRL2, self._crs << 4 | channel << 7 | calibrate)

    def _read(self, register: int) -> int:
        self._i2c.readfrom_mem_into(self._address, register, self._byte)
        return self._byte[0]

    def _write(self, register: int, value: int) -> None:
        self._i2c.writeto_mem(self._address, register, bytes((value,)))
