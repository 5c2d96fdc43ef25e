"""A device of another kind than the fingertip, with traits that CiA 301 and 302 permit and that trouble a checker.

It starts by itself (1F80h), its PDOs map nothing and it refuses to enable such a PDO (06090030h), and its reset node
may take seconds.
"""

from canopen_device.core import codes
from canopen_device.core.node import Device
from canopen_device.testing import MemoryStore
from device.tiny import service_dictionary

Sent = list[tuple[int, bytes]]
NODE_ID = 5


class SelfStarting:
    """The device core with a dictionary of its own, behind these traits."""

    def __init__(self, reset_us: int = 0) -> None:
        od = service_dictionary(NODE_ID)
        for index, sub, kind, default in ((0x1F80, 0, "I", 0), (0x1A00, 0, "B", 0), (0x1600, 0, "B", 0)):
            od.add(index, sub, (kind, "rw", 0, default, None, None))
        for mapping in (0x1600, 0x1A00):
            for sub in range(1, 9):
                od.add(mapping, sub, ("I", "rw", 0, 0, None, None))
        od.add(0x1800, 6, ("B", "rw", 0, 0, 0, 240))
        store = MemoryStore()
        self._device = Device(od, store.save, store.load)
        self._reset_us = reset_us
        self._resetting: Sent = []
        self._boots_us = 0
        self.resets = 0

    def step(self, now_us: int, frames: Sent = ()) -> tuple[Sent, int]:  # type: ignore[assignment]
        """Frames in; frames out and the next due time."""
        if self._resetting:
            if now_us < self._boots_us:
                return [], self._boots_us
            frames, self._resetting = self._resetting, []
        elif any(frame in ((0, b"\x81\x05"), (0, b"\x81\x00")) for frame in frames):
            self.resets += 1
            if self._reset_us:
                self._resetting, self._boots_us = frames, now_us + self._reset_us
                return [], self._boots_us
        refused = [frame for frame in frames if self._refused(frame)]
        sent, due_us = self._device.step(now_us, [frame for frame in frames if frame not in refused])
        code = codes.INVALID_VALUE.to_bytes(4, "little")
        return [*sent, *((0x580 + NODE_ID, b"\x80" + data[1:4] + code) for _, data in refused)], due_us

    def _refused(self, frame: tuple[int, bytes]) -> bool:
        """Return whether the frame enables a PDO that maps nothing."""
        can_id, data = frame
        if can_id != 0x600 + NODE_ID or len(data) != 8 or data[0] >> 5 != 1 or not data[0] & 2 or data[3] != 1:
            return False
        index = data[1] | data[2] << 8
        is_pdo = 0x1400 <= index <= 0x15FF or 0x1800 <= index <= 0x19FF
        return is_pdo and not data[7] & 0x80 and not self._device.od.integer(index + 0x200, 0)
