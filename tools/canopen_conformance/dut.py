"""The device under test: an NMT master and SDO client on raw frames."""

import re
import struct
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from typing import TypeAlias

from canopen_conformance import wire
from canopen_conformance.case import CheckError, LostDeviceError, NotApplicableError, Product, check, need
from canopen_conformance.wire import Abort, Frame, Link

LAST_DATA_TYPE = 0x1B
_RPDO_MAPPINGS, _TPDO_MAPPINGS = range(0x1600, 0x1800), range(0x1A00, 0x1C00)
# A device may lack support for a value: access, mapping, PDO length, compatibility, value, its limits, general, state.
_MAY_REFUSE = (
    Abort.UNSUPPORTED_ACCESS, Abort.NOT_MAPPABLE, Abort.PDO_LENGTH, Abort.INCOMPATIBLE, Abort.INVALID_VALUE,
    Abort.TOO_HIGH, Abort.TOO_LOW, Abort.GENERAL_ERROR, Abort.NOT_STORED, Abort.DEVICE_STATE,
)  # fmt: skip
BOOT_MS = 5000  # real devices may take long
_BEAT_MS = 20
_SLOW_RESET_MS = 250
_MOST_SEGMENTS = 20_000  # of an upload: 140 kB
_KEPT = 5000  # bounds the memory on a bus with traffic of other nodes

Wanted: TypeAlias = str | Callable[[bytes], bool] | None


def _fits(data: bytes, wanted: Wanted) -> bool:
    if isinstance(wanted, str):
        # "4F 01 10 00 .. 00 00 00": two dots match any byte, and "*" at the end any rest.
        pattern = wanted.replace(" ", "").lower().replace("*", ".*")
        return re.fullmatch(pattern, data.hex()) is not None
    return wanted is None or wanted(data)


class Dut:
    """One device on a link. ``product``: of the caller's own cases; ``pdo_id``: of the PDO set up; ``upload_index``,
    ``upload_size``, ``data``: of the transfer begun. Received frames stay pending until a check consumes them."""

    def __init__(self, link: Link, node_id: int, product: Product | None = None) -> None:
        self.link = link
        self.node_id = node_id
        self.product = product
        self.log: list[str] = []
        self.pdo_id = self.upload_index = self.upload_size = 0
        self.data = b""
        self._pending: deque[Frame] = deque(maxlen=_KEPT)
        self._survey: dict[tuple[int, int], bool] = {}
        self._own_sync: list[tuple[int, bytes]] | None = None
        self._fresh = False  # as after a reset: since then only objects were read
        self._reset_command = wire.RESET_NODE

    @property
    def now_us(self) -> int:
        """The link's clock."""
        return self.link.now_us()

    def send(self, can_id: int, data: bytes | str = b"") -> None:
        """Send a frame; ``data`` may be hex text."""
        self._fresh = False
        can_id, content = self._can_id(can_id), wire.as_bytes(data)
        self._note(">", can_id, content, self.now_us)
        self.link.send(can_id, content)

    def expect(self, can_id: int, wanted: Wanted = None, within_ms: float = wire.ANSWER_MS) -> Frame:
        """Return the next frame with ``can_id``, which must arrive in time and match. Other frames stay pending."""
        frame = self.heard(can_id, within_ms)
        can_id, what = self._can_id(can_id), wanted if isinstance(wanted, str) else "with other content"
        if frame is None:
            raise CheckError(f"a frame {can_id:03X}h {what if wanted else ''} within {within_ms:g} ms", "none")
        check(_fits(frame.data, wanted), f"{can_id:03X}#{what}", wire.text(can_id, frame.data))
        return frame

    def heard(self, can_id: int, within_ms: float = wire.ANSWER_MS) -> Frame | None:
        """Return the next frame with ``can_id``, None if none arrives in time. One of EMCY, SDO and LSS has 8 bytes."""
        full = can_id in (wire.EMCY, wire.SDO, 0x7E4)
        can_id, limit_us = self._can_id(can_id), self.now_us + round(1000 * (within_ms + self.link.tolerance_ms))
        while True:
            for frame in self._pending:
                if frame.can_id == can_id:
                    self._pending.remove(frame)
                    check(len(frame.data) == 8 or not full, "8 bytes", wire.text(can_id, frame.data))
                    return frame
            if not self._pump(limit_us):
                return None

    def silence(self, *can_ids: int, ms: float = wire.QUIET_MS) -> None:
        """Check that no frame of these identifiers (default: the device's, except heartbeat) arrives or is pending."""
        self.sleep(ms)
        forbidden = [self._can_id(can_id) for can_id in can_ids]
        for frame in self._pending:
            can_id = frame.can_id
            own = can_id & 0x7F == self.node_id and 0x80 <= can_id < 0x600 and can_id & 0x780 != 0x500
            if can_id in forbidden if can_ids else own or can_id == 0x7E4:
                raise CheckError("silence", wire.text(can_id, frame.data))

    def sleep(self, ms: float) -> None:
        """Wait; received frames stay pending."""
        limit_us = self.now_us + round(1000 * ms)
        while self._pump(limit_us):
            pass

    def forget(self, *can_ids: int) -> None:
        """Discard pending frames (default: of any identifier)."""
        self.sleep(0)
        kept = [f for f in self._pending if can_ids and f.can_id not in [self._can_id(can_id) for can_id in can_ids]]
        self._pending.clear()
        self._pending.extend(kept)

    def check_ms(self, what: str, actual_us: float, expected_ms: float) -> None:
        """Check that a measured time is the expected one, within the link's tolerance."""
        tolerance_ms, actual_ms = self.link.tolerance_ms, actual_us / 1000
        right = abs(actual_ms - expected_ms) <= tolerance_ms
        check(right, f"{what} {expected_ms:g} ms (+-{tolerance_ms} ms)", f"{actual_ms:.1f} ms")

    def _can_id(self, can_id: int) -> int:
        if can_id & wire.PDO:
            return self.pdo_id | can_id & ~wire.PDO
        return (can_id & ~wire.OF_DEVICE) + self.node_id if can_id & wire.OF_DEVICE else can_id

    def _pump(self, limit_us: int) -> bool:
        frame = self.link.receive(limit_us)
        if frame is None:
            return False
        self._note("<", *frame)
        self._pending.append(frame)
        return True

    def _note(self, direction: str, can_id: int, data: bytes, at_us: int) -> None:
        self.log.append(f"{at_us / 1000:10.1f} ms  {direction} {wire.text(can_id, data)}")

    def nmt(self, command: int, node_id: int | None = None) -> None:
        """Send an NMT command to this device, or to ``node_id`` (0: all)."""
        self.send(0x000, bytes((command, self.node_id if node_id is None else node_id)))

    def reset(self, command: int = wire.RESET_NODE) -> None:
        """Reset the device and wait for its boot-up, then PRE-OPERATIONAL; earlier frames are discarded."""
        self.boot(command)
        if self.starts_by_itself:
            self.nmt(wire.ENTER_PRE_OPERATIONAL)
            self.sleep(wire.QUIET_MS)  # for the PDOs of its short time in OPERATIONAL
            self._pending.clear()
        # 1006h and 1019h are set to 0: cases send their own SYNC, without a number.
        with suppress(CheckError):
            if self._own_sync is None:
                values = [(index, self.try_read(index)) for index in (0x1006, 0x1019)]
                self._own_sync = [(index, bytes(len(v))) for index, v in values if isinstance(v, bytes) and any(v)]
            for index, zero in self._own_sync:
                self.try_write(index, 0, zero)
        self._fresh = True

    def boot(self, command: int) -> None:
        """Reset the device and wait for its boot-up message."""
        self.forget()
        self.nmt(command)
        self.boot_up()
        self._pending.clear()  # frames before the boot-up message precede the reset

    def refresh(self) -> None:
        """Reset the device, unless it was only asked for objects since the last reset."""
        if not self._fresh:
            self.reset(self._reset_command)

    def measure_resets(self) -> None:
        """Reset the device; if reset communication is faster, ``refresh`` uses it: that restores the communication
        parameters, which the cases change. Raises LostDeviceError if the device does not boot."""
        times_us = {}
        for command in (wire.RESET_NODE, wire.RESET_COMMUNICATION):
            start_us = self.now_us
            try:
                self.reset(command)
            except CheckError as failure:
                problem = "no boot-up message after NMT reset node; is it on this bus, is the bit rate right?"
                raise LostDeviceError(f"node {self.node_id} (0x{self.node_id:02X}): {problem}") from failure
            times_us[command] = self.now_us - start_us
            if times_us[command] < 1000 * _SLOW_RESET_MS:
                break
        self._reset_command = min(times_us, key=lambda command: times_us[command])
        self.refresh()
        with suppress(CheckError):
            self.is_of_product()

    @cached_property
    def starts_by_itself(self) -> bool:
        """Whether the device enters OPERATIONAL after its boot-up (CiA 302-2, 1F80h), by 1F80h or heartbeat."""
        with suppress(CheckError):  # a device without SDO fails the cases of SDO
            startup = self.try_read(0x1F80)
            return not startup[0] & 4 if isinstance(startup, bytes) else self._beats_operational()
        return False

    def _beats_operational(self) -> bool:
        period = self.try_read(0x1017)
        if not isinstance(period, bytes) or self.try_write(0x1017, 0, struct.pack("<H", _BEAT_MS)):
            return False
        beat = self.heard(wire.HEARTBEAT, 3 * _BEAT_MS)
        self.try_write(0x1017, 0, period)
        self.forget(wire.HEARTBEAT)
        return beat is not None and beat.data == bytes((wire.OPERATIONAL,))

    def waits_for_start(self) -> None:
        """End a case about the state after the boot-up for a device that starts by itself."""
        need(not self.starts_by_itself, "the device enters OPERATIONAL by itself after its boot-up")

    def boot_up(self) -> Frame:
        """Wait for the boot-up message; a heartbeat sent during the reset may precede it."""
        limit_us = self.now_us + 1000 * BOOT_MS
        while True:
            frame = self.expect(wire.HEARTBEAT, within_ms=max(0, limit_us - self.now_us) / 1000)
            if frame.data == b"\0":
                return frame
            check(self.now_us < limit_us, f"the boot-up message within {BOOT_MS} ms", "other heartbeats alone")

    def beat(self) -> None:
        """Set a short heartbeat period, which shows the NMT state."""
        self.put("H", 0x1017, 0, _BEAT_MS)

    def state(self, expected: int) -> None:
        """Check that the heartbeats carry ``expected``; the first may have been sent before."""
        self.forget(wire.HEARTBEAT)
        self.expect(wire.HEARTBEAT, within_ms=2 * _BEAT_MS)
        self.expect(wire.HEARTBEAT, f"{expected:02X}", 2 * _BEAT_MS)

    def enter(self, state: int) -> None:
        """Change from PRE-OPERATIONAL, the state after a reset, to ``state``."""
        if state != wire.PRE_OPERATIONAL:
            self.nmt(wire.START if state == wire.OPERATIONAL else wire.STOP)

    def request(self, data: bytes | str) -> None:
        """Send an SDO frame, padded to 8 bytes."""
        content = wire.as_bytes(data)
        self.send(wire.REQUEST, content + bytes(8 - len(content)))

    def answer(self, wanted: Wanted = None, within_ms: float = 1000) -> bytes:
        """Return the next SDO frame of the device; hex text is padded to 8 bytes with 00."""
        if isinstance(wanted, str) and not wanted.endswith("*"):
            wanted += " 00" * (8 - len(wanted.replace(" ", "")) // 2)
        return self.expect(wire.SDO, wanted, within_ms).data

    def ask(self, data: bytes | str, wanted: Wanted = None) -> bytes:
        """Send a request and return the response."""
        self.request(data)
        return self.answer(wanted)

    def aborted(self, index: int, sub: int, *codes: int, within_ms: float = 1000) -> None:
        """Check that the next SDO frame is an abort of this object with one of ``codes``."""
        data = self.answer(within_ms=within_ms)
        shown = " or ".join(f"{code:08X}h" for code in codes)
        right = data[:4] == struct.pack("<BHB", 0x80, index, sub) and int.from_bytes(data[4:], "little") in codes
        check(right, f"abort {shown} of {index:04X}h:{sub:02X}", data.hex(" ").upper())

    def abort(self, index: int, sub: int = 0) -> None:
        """Abort the transfer of an object."""
        self.request(struct.pack("<BHBI", 0x80, index, sub, Abort.GENERAL_ERROR))

    def try_read(self, index: int, sub: int = 0) -> bytes | int:
        """Upload, expedited or segmented: return the data, or the abort code."""
        fresh = self._fresh
        first = self.ask(struct.pack("<BHB", 0x40, index, sub), lambda d: d[0] & 0xE0 in (0x40, 0x80))
        data: bytes | int
        if first[0] == 0x80:
            data = int.from_bytes(first[4:], "little")
        elif first[0] & 2:
            data = first[4 : 8 - (first[0] >> 2 & 3)] if first[0] & 1 else first[4:]
        else:
            data = self.read_segments()
        self._fresh = fresh
        return data

    def read_segments(self) -> bytes:
        """Read the segments of an initiated upload."""
        data, toggle = b"", 0
        for _ in range(_MOST_SEGMENTS):
            part = self.ask(bytes((0x60 | toggle,)), lambda d, t=toggle: d[0] & 0xF0 == t)  # type: ignore[misc]
            data += part[1 : 8 - (part[0] >> 1 & 7)]
            if part[0] & 1:
                return data
            toggle ^= 0x10
        raise CheckError(f"at most {_MOST_SEGMENTS} segments", "no last one")

    def try_write(self, index: int, sub: int, data: bytes) -> int:
        """Download, expedited or segmented: return 0, or the abort code."""
        if 0 < len(data) <= 4:
            answer = self.ask(struct.pack("<BHB", 0x23 | 4 - len(data) << 2, index, sub) + data)
        else:
            answer = self.ask(struct.pack("<BHBI", 0x21, index, sub, len(data)))
            for offset in range(0, max(len(data), 1), 7):
                if answer[0] == 0x80:
                    break
                part = data[offset : offset + 7]
                command = (offset // 7 & 1) << 4 | 7 - len(part) << 1 | (offset + 7 >= len(data))
                answer = self.ask(bytes((command,)) + part)
        return wire.abort_code(answer)

    def read(self, index: int, sub: int = 0) -> bytes:
        """Upload; it must succeed."""
        data = self.try_read(index, sub)
        if isinstance(data, int):
            raise CheckError(f"{index:04X}h:{sub:02X} to be read", f"abort {data:08X}h")
        return data

    def reads(self, index: int, sub: int, data: bytes) -> None:
        """Check the bytes of an entry."""
        data_read = self.read(index, sub)
        check(data_read == data, f"{index:04X}h:{sub:02X} = {data.hex(' ')}", data_read.hex(" "))

    def number(self, kind: str, index: int, sub: int = 0) -> float:
        """Upload a number; ``kind`` is struct's letter, and the size must match it."""
        data, size = self.read(index, sub), struct.calcsize(kind)
        check(len(data) == size, f"{size} bytes in {index:04X}h:{sub:02X}", data.hex(" "))
        value: float = struct.unpack("<" + kind, data)[0]
        return value

    def integer(self, kind: str, index: int, sub: int = 0) -> int:
        """Upload an integer."""
        return int(self.number(kind, index, sub))

    def put(self, kind: str, index: int, sub: int, value: float, required: bool = False) -> None:
        """Download a precondition of the case: unless ``required``, not applicable if the device refuses it."""
        code = self.try_write(index, sub, struct.pack("<" + kind, value))
        shown = f"{value:g}" if kind == "f" else f"{int(value):X}h"
        need(code != Abort.READ_ONLY, f"{index:04X}h:{sub:02X} cannot be written")
        if code == Abort.NO_OBJECT and index in _RPDO_MAPPINGS and int(value) >> 16 <= LAST_DATA_TYPE:
            raise NotApplicableError(f"no data type {int(value) >> 16:04X}h as a dummy entry (CiA 301, 7.4.7.1)")
        if code == Abort.NO_SUB and (index in _RPDO_MAPPINGS or index in _TPDO_MAPPINGS):
            raise NotApplicableError(f"{index:04X}h has no sub-index {sub}")
        refused = code in _MAY_REFUSE and not required
        need(not refused, f"{index:04X}h:{sub:02X} does not take {shown} (abort {code:08X}h)")
        check(not code, f"{index:04X}h:{sub:02X} to accept {shown}", f"abort {code:08X}h")

    def holds(self, kind: str, index: int, sub: int, value: float) -> None:
        """Check that the object reads as ``value``."""
        value_read = self.number(kind, index, sub)
        check(value_read == value, f"{index:04X}h:{sub:02X} = {value}", str(value_read))

    def refuses(self, kind: str, index: int, sub: int, value: float, *codes: int) -> None:
        """Check that writing a number is aborted with one of ``codes``."""
        self.refuses_bytes(index, sub, struct.pack("<" + kind, value), *codes)

    def refuses_bytes(self, index: int, sub: int, data: bytes, *codes: int) -> None:
        """Check that a write is aborted with one of ``codes`` (or of its limits); not applicable if read-only."""
        code = self.try_write(index, sub, data)
        need(code != Abort.READ_ONLY or code in codes, f"{index:04X}h:{sub:02X} cannot be written")
        if code in (Abort.TOO_HIGH, Abort.TOO_LOW) and Abort.INVALID_VALUE in codes and not self.is_of_product():
            return
        shown = " or ".join(f"{wanted:08X}h" for wanted in codes)
        got = f"abort {code:08X}h" if code else "it was written"
        check(code in codes, f"abort {shown} of {index:04X}h:{sub:02X}", got)

    def lacks(self, entries: Sequence[tuple[int, int]]) -> tuple[int, int] | None:
        """Return the first of the entries that does not exist; reset the device before it asks."""
        if any(entry not in self._survey for entry in entries):
            self.refresh()
        return next((entry for entry in entries if not self.exists(*entry)), None)

    def exists(self, index: int, sub: int) -> bool:
        """Return whether the entry exists, by SDO upload; a write-only entry exists, too."""
        key = (index, sub)
        if key not in self._survey:
            fresh = self._fresh
            first = self.ask(struct.pack("<BHB", 0x40, index, sub), lambda d: d[0] & 0xE0 in (0x40, 0x80))
            self._survey[key] = wire.abort_code(first) not in (Abort.NO_OBJECT, Abort.NO_SUB)
            if first[0] != 0x80 and not first[0] & 2:
                # Segments would follow, ten thousand of them for the EDS in 1021h: the initiate response is enough.
                self.abort(index, sub)
            self._fresh = fresh
        return self._survey[key]

    def constant(self, entries: Sequence[tuple[int, int]], log: Sequence[str]) -> str:
        """Return which entry refused a write in ``log`` as read-only, and refuses its own value, too; "" for none."""
        for index, sub in entries:
            refusal = struct.pack("<BHBI", 0x80, index, sub, Abort.READ_ONLY).hex().upper()
            if any(line.endswith(refusal) for line in log):
                with suppress(CheckError):
                    self.reset()
                    if self.try_write(index, sub, self.read(index, sub)) == Abort.READ_ONLY:
                        return f"{index:04X}h:{sub:02X} cannot be written"
        return ""

    def is_of_product(self) -> bool:
        """Return whether 1018h:2 is a product code of ``product``."""
        return self.product is not None and self.product_code & self.product.mask == self.product.code

    @cached_property
    def identity(self) -> list[int]:
        """1018h:1-4, which is read once: also for when the device has no SDO."""
        return [self.integer("I", 0x1018, sub) for sub in (1, 2, 3, 4)]

    @cached_property
    def product_code(self) -> int:
        """1018h:2, which is read once; 0 where it cannot be read."""
        data = self.try_read(0x1018, 2)
        return int.from_bytes(data, "little") if isinstance(data, bytes) else 0
