"""The device under test: an NMT master and SDO client on raw frames."""

from __future__ import annotations

import struct

from tipforce_tools.conformance.case import CheckError, NotApplicableError
from tipforce_tools.conformance.raw_frames import Frame, Frames, Link, Wanted, as_bytes

START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
STOPPED, OPERATIONAL, PRE_OPERATIONAL = 4, 5, 127
READ_ONLY = 0x06010002
BOOT_MS = 5000  # real devices may take long
_BEAT_MS = 20
_TIPFORCE = 0x545


class Dut(Frames):
    """One device on a link, with its present node-id."""

    def __init__(self, link: Link, node_id: int) -> None:
        super().__init__(link, node_id)
        self._survey: dict[tuple[int, int], bool] = {}
        self._is_tipforce: bool | None = None

    # --- NMT ------------------------------------------------------------------------------------------------

    def nmt(self, command: int, node_id: int | None = None) -> None:
        """Send an NMT command to this device, or to ``node_id`` (0: all)."""
        self.send(0x000, bytes((command, self.node_id if node_id is None else node_id)))

    def reset(self, command: int = RESET_NODE) -> None:
        """Reset the device and wait for its boot-up; earlier frames are discarded."""
        self.forget()
        self.nmt(command)
        self.boot_up()
        self._pending.clear()  # frames before the boot-up message precede the reset

    def boot_up(self) -> Frame:
        """Wait for the boot-up message; a heartbeat sent during the reset may precede it."""
        limit_us = self.now_us + 1000 * BOOT_MS
        while True:
            frame = self.expect(0x700 + self.node_id, within_ms=max(0, limit_us - self.now_us) / 1000)
            if frame.data == b"\0":
                return frame

    def beat(self) -> None:
        """Set a short heartbeat period, which shows the NMT state."""
        self.put("H", 0x1017, 0, _BEAT_MS)

    def state(self, expected: int) -> None:
        """Check that the heartbeats carry ``expected``; the first may have been sent before."""
        can_id = 0x700 + self.node_id
        self.forget(can_id)
        self.expect(can_id, within_ms=2 * _BEAT_MS)
        self.expect(can_id, f"{expected:02X}", 2 * _BEAT_MS)

    def enter(self, state: int) -> None:
        """Change from PRE-OPERATIONAL, the state after a reset, to ``state``."""
        if state != PRE_OPERATIONAL:
            self.nmt(START if state == OPERATIONAL else STOP)

    # --- SDO, frame by frame --------------------------------------------------------------------------------

    def request(self, data: bytes | str) -> None:
        """Send an SDO frame, padded to 8 bytes."""
        content = as_bytes(data)
        self.send(0x600 + self.node_id, content + bytes(8 - len(content)))

    def answer(self, wanted: Wanted = None, within_ms: float = 1000) -> bytes:
        """Return the next SDO frame of the device; hex text is padded to 8 bytes with 00."""
        if isinstance(wanted, str) and not wanted.endswith("*"):
            wanted += " 00" * (8 - len(wanted.replace(" ", "")) // 2)
        data = self.expect(0x580 + self.node_id, wanted, within_ms).data
        if len(data) != 8:
            raise CheckError("an SDO response of 8 bytes", f"{len(data)} bytes")
        return data

    def ask(self, data: bytes | str, wanted: Wanted = None) -> bytes:
        """Send a request and return the response."""
        self.request(data)
        return self.answer(wanted)

    def aborted(self, index: int, sub: int, *codes: int, within_ms: float = 1000) -> None:
        """Check that the next SDO frame is an abort of this object with one of ``codes``."""
        data = self.answer(within_ms=within_ms)
        shown = " or ".join(f"{code:08X}h" for code in codes)
        if data[:4] != struct.pack("<BHB", 0x80, index, sub) or int.from_bytes(data[4:], "little") not in codes:
            raise CheckError(f"abort {shown} of {index:04X}h:{sub:02X}", data.hex(" ").upper())

    def no_sdo(self, ms: float = 30) -> None:
        """Check that the device sends no SDO frame."""
        self.silence(0x580 + self.node_id, ms=ms)

    # --- SDO, whole transfers -------------------------------------------------------------------------------

    def try_read(self, index: int, sub: int = 0) -> bytes | int:
        """Upload, expedited or segmented: return the data, or the abort code."""
        first = self.ask(struct.pack("<BHB", 0x40, index, sub), lambda d: d[0] & 0xE0 in (0x40, 0x80))
        if first[0] == 0x80:
            return int.from_bytes(first[4:], "little")
        if first[0] & 2:
            return first[4 : 8 - (first[0] >> 2 & 3)] if first[0] & 1 else first[4:]
        return self.read_segments()

    def read_segments(self) -> bytes:
        """Read the segments of an initiated upload."""
        data, toggle = b"", 0
        while True:
            part = self.ask(bytes((0x60 | toggle,)), lambda d, t=toggle: d[0] & 0xF0 == t)  # type: ignore[misc]
            data += part[1 : 8 - (part[0] >> 1 & 7)]
            if part[0] & 1:
                return data
            toggle ^= 0x10

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
        return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0

    def read(self, index: int, sub: int = 0) -> bytes:
        """Upload; it must succeed."""
        data = self.try_read(index, sub)
        if isinstance(data, int):
            raise CheckError(f"{index:04X}h:{sub:02X} to be read", f"abort {data:08X}h")
        return data

    def number(self, kind: str, index: int, sub: int = 0) -> float:
        """Upload a number; ``kind`` is struct's letter, and the size must match it."""
        data = self.read(index, sub)
        if len(data) != struct.calcsize(kind):
            raise CheckError(f"{struct.calcsize(kind)} bytes in {index:04X}h:{sub:02X}", data.hex(" "))
        value: float = struct.unpack("<" + kind, data)[0]
        return value

    def integer(self, kind: str, index: int, sub: int = 0) -> int:
        """Upload an integer."""
        return int(self.number(kind, index, sub))

    def put(self, kind: str, index: int, sub: int, value: float) -> None:
        """Download a number, which must succeed; not applicable if the object is read-only."""
        code = self.try_write(index, sub, struct.pack("<" + kind, value))
        if code == READ_ONLY:
            raise NotApplicableError(f"{index:04X}h:{sub:02X} cannot be written")
        if code:
            shown = f"{value:g}" if kind == "f" else f"{int(value):X}h"
            raise CheckError(f"{index:04X}h:{sub:02X} to accept {shown}", f"abort {code:08X}h")

    def holds(self, kind: str, index: int, sub: int, value: float) -> None:
        """Check that the object reads as ``value``."""
        found = self.number(kind, index, sub)
        if found != value:
            raise CheckError(f"{index:04X}h:{sub:02X} = {value}", str(found))

    def refuses(self, kind: str, index: int, sub: int, value: float, *codes: int) -> None:
        """Check that writing a number is aborted with one of ``codes``."""
        self.refuses_bytes(index, sub, struct.pack("<" + kind, value), *codes)

    def refuses_bytes(self, index: int, sub: int, data: bytes, *codes: int) -> None:
        """Check that writing bytes is aborted with one of ``codes``."""
        code = self.try_write(index, sub, data)
        if code not in codes:
            shown = " or ".join(f"{wanted:08X}h" for wanted in codes)
            raise CheckError(
                f"abort {shown} of {index:04X}h:{sub:02X}", f"abort {code:08X}h" if code else "it was written"
            )

    # --- identity -------------------------------------------------------------------------------------------

    def exists(self, index: int, sub: int) -> bool:
        """Return whether the entry exists, by SDO upload; a write-only entry exists, too."""
        key = (index, sub)
        if key not in self._survey:
            first = self.ask(struct.pack("<BHB", 0x40, index, sub), lambda d: d[0] & 0xE0 in (0x40, 0x80))
            lacks = first[0] == 0x80 and int.from_bytes(first[4:], "little") in (0x06020000, 0x06090011)
            self._survey[key] = not lacks
            if first[0] != 0x80 and not first[0] & 2:
                # Segments would follow, ten thousand of them for the EDS in 1021h: the initiate response is enough.
                self.request(struct.pack("<BHBI", 0x80, index, sub, 0x08000000))
        return self._survey[key]

    def is_tipforce(self) -> bool:
        """Return whether 1018h:2 is a product code of tipforce."""
        if self._is_tipforce is None:
            product = self.try_read(0x1018, 2)
            self._is_tipforce = isinstance(product, bytes) and int.from_bytes(product, "little") >> 20 == _TIPFORCE
        return self._is_tipforce
