"""CAN driver for a Microchip MCP2515 on SPI (mode 0, up to 10 MHz), for microcontrollers without a CAN controller.

Facts of the data sheet (DS20001801, sections 5, 10 to 12): instructions RESET C0h, READ 03h, WRITE 02h, BIT MODIFY 05h,
READ RX BUFFER 90h and 94h (clears the buffer's flag), LOAD TX BUFFER 40h, RTS 81h, READ STATUS A0h (bit 0 RX0IF, 1
RX1IF, 2 TXREQ of buffer 0). A quantum is 2 (BRP + 1) / f_osc; a bit has 1 for synchronisation, then PropSeg, PS1 and
PS2; PS2 is 2 at least and more than SJW. Configuration mode clears the error counters. Registers: CANSTAT 0Eh, CANCTRL
0Fh, CNF3 28h, CNF2 29h, CNF1 2Ah, CANINTF 2Ch, EFLG 2Dh, TXB0CTRL 30h, RXB0CTRL 60h, RXB1CTRL 70h."""

import time

from canopen_device.core import codes

from .can_port import EXTENDED, STATE_ACTIVE, STATE_OFF, STATE_PASSIVE, STATE_WARNING, CanPort

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

RESET, READ, WRITE, MODIFY, READ_RX, LOAD_TX, RTS, STATUS = 0xC0, 0x03, 0x02, 0x05, (0x90, 0x94), 0x40, 0x81, 0xA0
CANSTAT, CANCTRL, CNF3, CANINTF, EFLG, TXB0CTRL, RXB0CTRL, RXB1CTRL = 0x0E, 0x0F, 0x28, 0x2C, 0x2D, 0x30, 0x60, 0x70
CONFIGURATION, NORMAL, MODES = 0x80, 0x00, 0xE0
OVERRUNS, OFF, PASSIVE, WARN = 0xC0, 0x20, 0x18, 0x07  # EFLG
TXREQ = 0x08
SAMPLE_POINT = 80  # percent
MODE_TRIES, RESET_WAIT_US = 20, 10  # 128 clocks of the oscillator after a reset


class Mcp2515(CanPort):
    """``spi`` is a ``machine.SPI``, ``cs`` a ``machine.Pin``; ``oscillator_hz`` is printed on the crystal. Raises
    ValueError for a bit rate that it does not allow, OSError if the chip does not respond."""

    def __init__(self, spi: "Any", cs: "Any", bit_rate: int, oscillator_hz: int = 16000000) -> None:
        self._spi, self._cs = spi, cs
        self._cs.value(1)
        self._oscillator_hz = oscillator_hz
        self._one, self._frame = bytearray(1), bytearray(13)
        super().__init__(bit_rate)

    def _start(self, bit_rate: int) -> None:
        timing = bit_timing(self._oscillator_hz, bit_rate)
        self._write(bytes((RESET,)))
        time.sleep(1e-6 * RESET_WAIT_US)
        self._enter(CONFIGURATION)
        self._write(bytes((WRITE, CNF3)) + timing)
        self._write(bytes((WRITE, RXB0CTRL, 0x64)))  # all frames; into buffer 1 when buffer 0 is full
        self._write(bytes((WRITE, RXB1CTRL, 0x60)))
        self._enter(NORMAL)

    def _enter(self, mode: int) -> None:
        """Switch the mode, with a few checks because it changes only when the bus allows it; OSError without a chip."""
        for _ in range(MODE_TRIES):
            self._write(bytes((MODIFY, CANCTRL, MODES, mode)))
            if self._read(self._one, READ, CANSTAT)[0] & MODES == mode:
                return
        raise OSError("MCP2515: no response, or it does not change its mode")

    def _next(self) -> "tuple[int, bytes] | None":
        status = self._read(self._one, STATUS)[0]
        if not status & 3:
            return None
        # Both full: buffer 0 is the older one, because buffer 1 fills only while it is full.
        frame = self._read(self._frame, READ_RX[0] if status & 1 else READ_RX[1])
        sidl = frame[1]
        if sidl & 0x08:
            return EXTENDED
        can_id = frame[0] << 3 | sidl >> 5
        if sidl & 0x10:  # SRR: a remote frame with a standard identifier
            return can_id | codes.REMOTE_FLAG, b""
        return can_id, bytes(frame[5 : 5 + min(frame[4] & 0x0F, 8)])

    def _put(self, can_id: int, data: bytes) -> bool:
        # Only one of the three buffers is used: at equal priority the chip sends the higher number first.
        if self._read(self._one, STATUS)[0] & 0x04:
            return False
        self._write(bytes((LOAD_TX, can_id >> 3, (can_id & 7) << 5, 0, 0, len(data))) + data)
        self._write(bytes((RTS,)))
        return True

    def _state(self) -> int:
        flags = self._read(self._one, READ, EFLG)[0]
        if flags & OVERRUNS:
            self._write(bytes((MODIFY, EFLG, OVERRUNS, 0)))
            self.overrun()
        if flags & OFF:
            return STATE_OFF
        return STATE_PASSIVE if flags & PASSIVE else STATE_WARNING if flags & WARN else STATE_ACTIVE

    def restart(self) -> None:
        """As of every controller."""
        self._queue = []
        self._write(bytes((MODIFY, TXB0CTRL, TXREQ, 0)))
        self._enter(CONFIGURATION)
        self._enter(NORMAL)

    def _write(self, data: bytes) -> None:
        self._cs.value(0)
        self._spi.write(data)
        self._cs.value(1)

    def _read(self, answer: bytearray, *instruction: int) -> bytearray:
        self._cs.value(0)
        self._spi.write(bytes(instruction))
        self._spi.readinto(answer)
        self._cs.value(1)
        return answer


def bit_timing(oscillator_hz: int, bit_rate: int) -> bytes:
    """Return CNF3, CNF2, CNF1 for this bit rate, sample point nearest to 80 %. Raises ValueError for others."""
    best: "tuple[int, int, int, int] | None" = None
    for prescaler in range(1, 65):
        quanta, rest = divmod(oscillator_hz, 2 * prescaler * bit_rate)
        if rest or not 8 <= quanta <= 25:
            continue
        ps2 = max(2, min(8, quanta - (quanta * SAMPLE_POINT + 50) // 100))
        before = quanta - 1 - ps2  # PropSeg and PS1, up to 8 each
        if not 2 <= before <= 16 or before < ps2:
            continue
        off = abs(100 * (quanta - ps2) - SAMPLE_POINT * quanta) // quanta
        if best is None or (off, -quanta) < (best[0], -best[1]):
            best = off, quanta, ps2, prescaler
    if best is None:
        raise ValueError("bit rate %d: not possible with an oscillator of %d Hz" % (bit_rate, oscillator_hz))
    _off, quanta, ps2, prescaler = best
    before = quanta - 1 - ps2
    ps1 = before // 2
    return bytes((ps2 - 1, 0x80 | ps1 - 1 << 3 | before - ps1 - 1, prescaler - 1))
