"""CAN controllers as their data sheets describe them, register by register, for CPython and MicroPython."""

from microcontroller.fakes import FakeSpi


class FakeBus:
    """What all fake controllers share: frames that wait outside, frames that went out, the error state."""

    def __init__(self) -> None:
        self.coming: "list[tuple[int, bytes]]" = []  # SocketCAN can_id
        self.sent: "list[tuple[int, bytes]]" = []
        self.error = 0  # 0 active, 1 warning, 2 passive, 3 off
        self.overrun = False
        self.room = 1 << 30  # frames that the bus takes before it is blocked
        self.restarts = 0
        self.bit_rates: "list[int]" = []

    def out(self, can_id: int, data: bytes) -> bool:
        if not self.room or self.error == 3:
            return False
        self.room -= 1
        self.sent.append((can_id, bytes(data)))
        return True

    def state(self) -> int:
        return self.error + 1

    def restart(self) -> None:
        self.restarts += 1
        self.error = 0


class FakeMachineCan(FakeBus):
    """``machine.CAN`` as its documentation describes it."""

    STATE_STOPPED, STATE_ACTIVE, STATE_WARNING, STATE_PASSIVE, STATE_BUS_OFF = 0, 1, 2, 3, 4
    FLAG_RTR, FLAG_EXT_ID = 1, 2
    RECV_ERR_FULL, RECV_ERR_OVERRUN = 1, 2

    def __init__(self) -> None:
        FakeBus.__init__(self)
        self._filters = False

    def deinit(self) -> None:
        self._filters = False

    def init(self, bitrate: int, sample_point: int = 75) -> None:
        assert 50 < sample_point < 90
        self.bit_rates.append(bitrate)

    def set_filters(self, filters) -> None:  # type: ignore[no-untyped-def]
        assert filters is None
        self._filters = True

    def recv(self) -> "list[object] | None":
        if not self.coming or not self._filters:
            return None
        can_id, data = self.coming.pop(0)
        flags = (self.FLAG_RTR if can_id & 0x40000000 else 0) | (self.FLAG_EXT_ID if can_id & 0x80000000 else 0)
        errors = self.RECV_ERR_OVERRUN if self.overrun else 0
        self.overrun = False
        return [can_id & 0x1FFFFFFF, memoryview(data), flags, errors]

    def send(self, can_id: int, data: bytes, _flags: int = 0) -> "int | None":
        if self.error == 3:
            raise OSError(5)
        return 0 if self.out(can_id, data) else None


class FakePybCan(FakeBus):
    """``pyb.CAN`` as its documentation describes it."""

    NORMAL, MASK16 = 0, 1
    ERROR_ACTIVE, ERROR_WARNING, ERROR_PASSIVE, BUS_OFF = 1, 2, 3, 4

    def __init__(self) -> None:
        FakeBus.__init__(self)
        self._takes: "list[bool]" = []
        self.pending = 0

    def init(self, mode: int, baudrate: int = 0, sample_point: int = 75, auto_restart: bool = True) -> None:
        assert mode == self.NORMAL
        assert not auto_restart
        assert 50 < sample_point < 90
        self.bit_rates.append(baudrate)
        self._takes = []

    def setfilter(self, bank: int, mode: int, fifo: int, params, rtr=(False, False)) -> None:  # type: ignore[no-untyped-def]
        assert (bank, mode, fifo, params) == (len(self._takes), self.MASK16, 0, (0, 0, 0, 0))
        self._takes.append(rtr[0])

    def any(self, fifo: int) -> bool:
        while self.coming and bool(self.coming[0][0] & 0x40000000) not in self._takes:
            self.coming.pop(0)
        return fifo == 0 and bool(self.coming)

    def recv(self, fifo: int, timeout: int = 5000):  # type: ignore[no-untyped-def]
        """(id, extended, rtr, filter, data)."""
        assert (fifo, timeout) == (0, 0)
        can_id, data = self.coming.pop(0)
        return can_id & 0x1FFFFFFF, bool(can_id & 0x80000000), bool(can_id & 0x40000000), 0, data

    def info(self, into: "list[int]") -> "list[int]":
        """TEC, REC, warnings, passives, offs, pending to send, pending in FIFO 0 and 1."""
        into[5] = self.pending
        return into

    def send(self, data: bytes, can_id: int, timeout: int = 0) -> None:
        assert timeout == 0
        if not self.out(can_id, data):
            raise OSError(116)


class FakeMcp2515(FakeSpi, FakeBus):
    """An MCP2515 with SPI and chip select; frames come into its two buffers one after the other."""

    MODIFIABLE = (0x0F, 0x2B, 0x2C, 0x2D, 0x30, 0x40, 0x50, 0x60, 0x70)
    EFLG = (0x00, 0x05, 0x15, 0x35)  # by state: warning, passive, off of the transmitter

    def __init__(self, oscillator_hz: int = 16000000) -> None:
        FakeBus.__init__(self)
        FakeSpi.__init__(self)
        self._oscillator_hz = oscillator_hz
        self._reset()

    def _reset(self) -> None:
        self.registers = bytearray(0x80)
        self.registers[0x0E] = self.registers[0x0F] = 0x80

    def _answer(self, count: int) -> "bytes | bytearray":
        self._arrive()
        command = self._command[0]
        if command == 0xA0:
            return bytes((self.registers[0x2C] & 3 | (4 if self.registers[0x30] & 8 else 0),))
        if command == 0x03 and self._command[1] == 0x2D:
            return bytes((self.registers[0x2D] & 0xC0 | self.EFLG[self.error] | (0x40 if self.overrun else 0),))
        first = {0x03: self._command[-1], 0x90: 0x61, 0x94: 0x71}[command]
        return self.registers[first : first + count]

    def _arrive(self) -> None:
        """The next frames into the buffers that are free; buffer 1 is used only while 0 is full."""
        if self.registers[0x0E] & 0xE0:
            return
        for flag, base in ((1, 0x61), (2, 0x71)):
            if self.coming and not self.registers[0x2C] & flag:
                if flag == 1 and self.registers[0x2C] & 2:
                    return  # both were full: 1 is read before another frame comes
                assert self.registers[base - 1] & 0x60 == 0x60, "a filter would drop frames"
                can_id, data = self.coming.pop(0)
                sidl = (can_id & 7) << 5 | (0x10 if can_id & 0x40000000 else 0) | (0x08 if can_id & 0x80000000 else 0)
                content = bytes(((can_id & 0x7FF) >> 3, sidl, 0, 0, len(data))) + data
                for k in range(13):
                    self.registers[base + k] = content[k] if k < len(content) else 0xAA
                self.registers[0x2C] |= flag

    def _execute(self) -> None:
        command = self._command[0]
        if command == 0xC0:
            self._reset()
        elif command == 0x02:
            for k in range(len(self._command) - 2):
                self._set(self._command[1] + k, 0xFF, self._command[2 + k])
        elif command == 0x05:
            assert self._command[1] in self.MODIFIABLE
            self._set(self._command[1], self._command[2], self._command[3])
        elif command == 0x40:
            for k in range(len(self._command) - 1):
                self.registers[0x31 + k] = self._command[1 + k]
        elif command == 0x81:
            self.registers[0x30] |= 8
        elif command in (0x90, 0x94):
            self.registers[0x2C] &= ~(1 if command == 0x90 else 2) & 0xFF
        self._transmit()

    def _transmit(self) -> None:
        if self.registers[0x30] & 8 and not self.registers[0x0E] & 0xE0:
            can_id = self.registers[0x31] << 3 | self.registers[0x32] >> 5
            assert not self.registers[0x32] & 0x08
            if self.out(can_id, bytes(self.registers[0x36 : 0x36 + self.registers[0x35]])):
                self.registers[0x30] &= ~8 & 0xFF

    def free(self, frames: int) -> None:
        """The bus takes so many more frames, the one in the buffer first."""
        self.room = frames
        self._transmit()

    def _set(self, address: int, mask: int, value: int) -> None:
        if address in (0x28, 0x29, 0x2A):
            assert self.registers[0x0E] & 0xE0 == 0x80, "bit timing outside configuration mode"
        if address == 0x2D:
            self.overrun = self.overrun and bool(value & mask & 0x40 or not mask & 0x40)
        self.registers[address] = self.registers[address] & ~mask & 0xFF | value & mask
        if address == 0x0F:
            before, self.registers[0x0E] = self.registers[0x0E], self.registers[0x0F] & 0xE0
            if before & 0xE0 == 0x80 and not self.registers[0x0E] & 0xE0:
                self.bit_rates.append(self.bit_rate())
                self.restarts += 1
                self.error = 0

    def bit_rate(self) -> int:
        """Bits a second of CNF1 to CNF3; AssertionError for a timing that the data sheet forbids."""
        cnf3, cnf2, cnf1 = self.registers[0x28], self.registers[0x29], self.registers[0x2A]
        assert cnf2 & 0x80, "PS2 is not programmed"
        propagation, ps1, ps2, sjw = (cnf2 & 7) + 1, (cnf2 >> 3 & 7) + 1, (cnf3 & 7) + 1, (cnf1 >> 6) + 1
        assert propagation + ps1 >= ps2 >= 2
        assert ps2 > sjw
        quanta = 1 + propagation + ps1 + ps2
        assert 70 <= 100 * (quanta - ps2) // quanta <= 90
        return self._oscillator_hz // (2 * ((cnf1 & 0x3F) + 1) * quanta)
