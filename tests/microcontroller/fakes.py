"""Clock, pins, converters and flash: chips as their data sheets describe them, for CPython and MicroPython.

``signal`` of a converter holds what its inputs are, in counts of its output, one number a channel. Each is deaf where
the real one is: without power, before it is configured, while it converts."""


class FakeClock:
    """Microseconds that the test sets; ``ticks`` wraps at 2^30 as MicroPython's does on most boards."""

    PERIOD = 1 << 30

    def __init__(self, now_us: int = 0) -> None:
        self.now_us = now_us

    def ticks(self) -> int:
        return self.now_us % self.PERIOD

    def diff(self, end: int, start: int) -> int:
        half = self.PERIOD // 2
        return (end - start + half) % self.PERIOD - half


class FakePin:
    """A pin; ``on_set`` is told of each level."""

    def __init__(self, level: int = 1, on_set=None, on_get=None):  # type: ignore[no-untyped-def]
        self.level = level
        self._on_set, self._on_get = on_set, on_get

    def value(self, level: int = -1) -> int:
        if level < 0:
            return self._on_get() if self._on_get is not None else self.level
        if level != self.level:
            self.level = level
            if self._on_set is not None:
                self._on_set(level)
        return level


class FakeNau7802:
    """An I2C bus with one NAU7802 on it. ``dead``: no acknowledge; ``fail_calibrations``: so many end with CAL_ERR."""

    RATES = (10, 20, 40, 80, 10, 10, 10, 320)

    def __init__(self, clock: FakeClock, signal: "list[int]") -> None:
        self.clock, self.signal = clock, signal
        self.dead = self.stuck = self.unpowered = False
        self.fail_calibrations = 0
        self.calibrated = 0  # bit k: channel k + 1 since the last reset
        self.transfers = 0
        self.registers = bytearray(0x20)
        self.reset()

    def reset(self) -> None:
        self.registers = bytearray(0x20)
        self.calibrated = 0
        self._up_us = self._begun_us = self._calibration_us = -1
        self._latched = -1
        self._switched = 0

    def _period_us(self) -> int:
        return 1000000 // self.RATES[self.registers[2] >> 4 & 7]

    def _converting(self) -> bool:
        return self.registers[0] & 0x16 == 0x16 and self._calibration_us < 0

    def _conversion(self) -> int:
        """The number of the newest conversion since CS, from 0 (none)."""
        return (self.clock.now_us - self._begun_us) // self._period_us() if self._converting() else 0

    def _tick(self) -> None:
        now_us = self.clock.now_us
        if self.registers[0] & 2 and self._up_us < 0:
            self._up_us = now_us
        if self.registers[0] & 2 and now_us - self._up_us >= 200 and not self.unpowered:
            self.registers[0] |= 8
        if self._calibration_us >= 0 and now_us - self._calibration_us >= 8 * self._period_us():
            self._calibration_us = -1
            self._begun_us = now_us
            self.registers[2] &= ~0x0C & 0xFF
            if self.fail_calibrations:
                self.fail_calibrations -= 1
                self.registers[2] |= 8
            else:
                self.calibrated |= 1 << (self.registers[2] >> 7)
        ready = self._converting() and not self.stuck and self._conversion() > self._latched
        self.registers[0] = self.registers[0] & ~0x20 | (0x20 if ready else 0)

    def readfrom_mem_into(self, address: int, register: int, buffer: bytearray) -> None:
        self._acknowledge(address)
        self._tick()
        if register == 0x12:
            self._convert()
        for k in range(len(buffer)):
            buffer[k] = self.registers[register + k]

    def _convert(self) -> None:
        channel = self.registers[2] >> 7
        value = self.signal[channel] if channel < len(self.signal) else 0
        self._latched = self._conversion()
        # The filter has an impulse response of several conversions: the first after a switch are wrong.
        if self._latched - self._switched < 4:
            value //= 2
        if not self.calibrated >> channel & 1:
            value += 5000
        value = max(-0x800000, min(0x7FFFFF, value)) & 0xFFFFFF
        for k in range(3):
            self.registers[0x12 + k] = value >> 16 - 8 * k & 0xFF

    def writeto_mem(self, address: int, register: int, data: bytes) -> None:
        self._acknowledge(address)
        self._tick()
        assert len(data) == 1
        value, before = data[0], self.registers[register]
        if register == 0:
            if value & 1:
                self.reset()
                return
            if value & 0x10 and not before & 0x10:
                self._begun_us, self._latched, self._switched = self.clock.now_us, 0, 0
            self.registers[0] = value & ~0x28 | before & 0x08
            return
        self.registers[register] = value
        if register == 2:
            if (value ^ before) & 0x80:
                self._switched = self._conversion()
            if value & 4:
                self._calibration_us = self.clock.now_us
                self.registers[2] &= ~8 & 0xFF

    def _acknowledge(self, address: int) -> None:
        self.transfers += 1
        if self.dead or address != 0x2A:
            raise OSError(19)


class FakeSpi:
    """A chip on SPI: what is written while it is selected is executed when chip select rises."""

    dead = False

    def __init__(self) -> None:
        self.cs = FakePin(1, self._selected)
        self._command = bytearray()

    def _selected(self, level: int) -> None:
        if level == 1 and self._command and not self.dead:
            self._execute()  # type: ignore[attr-defined]
        self._command = bytearray()

    def write(self, data: bytes) -> None:
        assert self.cs.level == 0, "SPI without chip select"
        self._command += data

    def readinto(self, buffer: bytearray, _write: int = 0) -> None:
        assert self.cs.level == 0, "SPI without chip select"
        answer = b"\xff" * len(buffer) if self.dead else self._answer(len(buffer))  # type: ignore[attr-defined]
        for k in range(len(buffer)):
            buffer[k] = answer[k]


class FakeAds1220(FakeSpi):
    """An ADS1220 with SPI, chip select and data-ready pin. ``offset`` is its own, shown with shorted inputs too."""

    RATES = (20, 45, 90, 175, 330, 600, 1000, 1000)

    def __init__(self, clock: FakeClock, signal: "list[int]", offset: int = 0, temperature: int = 0) -> None:
        FakeSpi.__init__(self)
        self.clock, self.signal, self.offset, self.temperature = clock, signal, offset, temperature
        self.stuck = False
        self.registers = bytearray(4)
        self.drdy = FakePin(1, on_get=lambda: 0 if self._ready() else 1)
        self._begun_us, self._read = -1, 0

    def _period_us(self) -> int:
        rate = self.RATES[self.registers[1] >> 5]
        turbo = 2 if self.registers[1] & 0x18 == 0x10 else 1
        return 1000000 // (rate * turbo)

    def _conversion(self) -> int:
        return (self.clock.now_us - self._begun_us) // self._period_us() if self._begun_us >= 0 else 0

    def _ready(self) -> bool:
        return not self.dead and not self.stuck and self._conversion() > self._read

    def _answer(self, count: int) -> "bytes | bytearray":
        if self._command and self._command[0] & 0xF0 == 0x20:
            first = self._command[0] >> 2 & 3
            return self.registers[first : first + count]
        assert count == 3
        assert not self._command
        self._read = self._conversion()
        return (self._value() & 0xFFFFFF).to_bytes(3, "big")

    def _value(self) -> int:
        if self.registers[1] & 2:
            return self.temperature << 10
        inputs = {0: 0, 5: 1}.get(self.registers[0] >> 4)
        value = self.offset if inputs is None else self.signal[inputs] + self.offset
        return max(-0x800000, min(0x7FFFFF, value))

    def _execute(self) -> None:
        command = self._command[0]
        if command == 0x06:
            self.registers = bytearray(4)
            self._begun_us = -1
        elif command == 0x08:
            self._begin()
        elif command & 0xF0 == 0x40:
            first, count = command >> 2 & 3, (command & 3) + 1
            assert len(self._command) == count + 1
            for k in range(count):
                self.registers[first + k] = self._command[1 + k]
            if self._begun_us >= 0:
                self._begin()

    def _begin(self) -> None:
        assert self.registers[1] & 4, "single-shot mode"
        self._begun_us, self._read = self.clock.now_us, 0


class FakeHx711:
    """An HX711 by its two pins. PD_SCK high for 60 us switches it off; ``glitch`` swallows so many clock pulses."""

    def __init__(self, clock: FakeClock, signal: "list[int]", rate: int = 80) -> None:
        self.clock, self.signal, self._period_us = clock, signal, 1000000 // rate
        self.stuck = False
        self.glitch = 0
        self.resets = 0
        self.pulses_seen: "dict[int, int]" = {}
        self.sck = FakePin(0, self._edge)
        self.dout = FakePin(1, on_get=self._bit)
        self._high_us = clock.now_us
        self._begin(4)

    def _begin(self, conversions: int) -> None:
        self._ready_us = self.clock.now_us + conversions * self._period_us
        self._pulses = 0

    def _settle(self) -> None:
        """The pulses of a reading end when the next conversion does."""
        if self._pulses >= 25 and self.clock.now_us >= self._ready_us:
            self.pulses_seen[self._pulses] = self.pulses_seen.get(self._pulses, 0) + 1
            self._pulses = 0

    def _edge(self, level: int) -> None:
        if level:
            self._high_us = self.clock.now_us
            if self.glitch:
                self.glitch -= 1
                return
            self._settle()
            if self.clock.now_us >= self._ready_us or self._pulses:
                self._pulses += 1
                if self._pulses == 25:
                    self._ready_us = self.clock.now_us + self._period_us
        elif self.clock.now_us - self._high_us >= 60:
            self.resets += 1
            self._begin(4)

    def _bit(self) -> int:
        if self.stuck or (self.sck.level and self.clock.now_us - self._high_us >= 60):
            return 1
        self._settle()
        if self._pulses == 0:
            return 0 if self.clock.now_us >= self._ready_us else 1
        if self._pulses <= 24:
            return (self.signal[0] & 0xFFFFFF) >> 24 - self._pulses & 1
        return 1


class MemorySlots:
    def __init__(self) -> None:
        self.slots = [b"", b""]
        self.writes = 0

    def read(self, slot: int) -> bytes:
        return self.slots[slot]

    def write(self, slot: int, data: bytes) -> None:
        self.writes += 1
        self.slots[slot] = bytes(data)
