"""A conversation that is recorded, with the steps that several of them take."""

from collections.abc import Sequence
from typing import Any

from canopen_device.testing import Conversation, Frame
from micropython.recording import RecordedDevice, Recording
from tipforce.dictionary import table
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import calibration_matrix

SYNC: Frame = (0x80, b"")
_LSS_MASTER, _LSS_SLAVE = 0x7E5, 0x7E4


class Talk(Conversation):
    """A conversation with a recorded node, EMCY shown. What the node says is noted, and compared on MicroPython."""

    def __init__(
        self,
        name: str,
        node_id: int = 5,
        layout: str | Sequence[str] = "I",
        store: dict[str, str] | None = None,
        eds: str = "",
        now_us: int = 0,
        front_end: dict[str, Any] | None = None,
    ) -> None:
        self.recorded = RecordedDevice(name, node_id, layout, store, eds, front_end=front_end)
        super().__init__(self.recorded, now_us, emcy=True)

    @property
    def recording(self) -> Recording:
        """What was said so far."""
        return self.recorded.recording

    def start(self) -> None:
        """NMT start of all nodes."""
        self.send("000#0100")

    def load(self, P_newtons: float, phi_deg: float, theta_deg: float) -> None:
        """2201h: what presses on the tip."""
        for sub, value in enumerate((P_newtons, phi_deg, theta_deg), 1):
            assert self.put("f", 0x2201, sub, value) == 0

    def sync(self, count: int = 1, period_us: int = 1000) -> list[Frame]:
        """SYNCs a period apart; what the last one brought."""
        sent: list[Frame] = []
        for _ in range(count):
            self.advance(period_us)
            sent = self.step([SYNC])
        return sent

    def calibrate(self, layout: str | Sequence[str] = "I") -> None:
        """Stage the calibration of an ideal sensor by SDO, entry by entry, and commit it."""
        C = calibration_matrix(FABRICATED, layout)
        n = C.shape[1]
        for sub, value in enumerate(C.flat, 1):
            assert self.put("f", 0x2100, sub, float(value)) == 0
        for k in range(n):  # the diagonal of the upper triangle, by rows
            assert self.put("f", 0x2106, 1 + k * n - k * (k - 1) // 2, 1e-12) == 0
        for kind, sub, fact in (("I", 1, 77), ("I", 2, 20250131), ("f", 3, 23.0), ("B", 4, 1)):
            assert self.put(kind, 0x2102, sub, fact) == 0
        for sub, setting in enumerate((0.01, -80.0, 80.0, 0.05, 0.03), 1):
            assert self.put("f", 0x2110, sub, setting) == 0
        assert self.put("I", 0x2103, 1, self.get("I", 0x2103, 2)) == 0
        assert self.put("I", 0x2104, 0, table.SIGNATURE_COMMIT) == 0

    def remap(
        self,
        number: int,
        cob_id: int,
        mapping: tuple[tuple[int, int, int], ...],
        transmission: int = 1,
        inhibit: int = 0,
        event_ms: int = 0,
    ) -> None:
        """Give TPDO ``number``, from 0, another mapping, by the procedure of CiA 301, 7.5.2.36."""
        communication, mapped = 0x1800 + number, 0x1A00 + number
        writes = [("I", communication, 1, 0xC0000000 | cob_id), ("B", mapped, 0, 0)]
        writes += [("I", mapped, k, index << 16 | sub << 8 | bits) for k, (index, sub, bits) in enumerate(mapping, 1)]
        writes += [("B", mapped, 0, len(mapping)), ("B", communication, 2, transmission)]
        writes += [("H", communication, 3, inhibit), ("H", communication, 5, event_ms), ("I", communication, 1, cob_id)]
        for kind, index, sub, value in writes:
            assert self.put(kind, index, sub, value) == 0, f"{index:04X}h:{sub}"

    def fastscan(self, identity: tuple[int, ...]) -> None:
        """LSS fastscan (CiA 305, 6.6.4) with a master that knows nothing: bit by bit to ``identity``."""
        assert self._scanned(0, 0x80, 0, 0)
        found = []
        for part in range(4):
            number = 0
            for bit in range(31, -1, -1):
                if not self._scanned(number, bit, part, part):
                    number |= 1 << bit
            assert self._scanned(number, 0, part, (part + 1) % 4)
            found.append(number)
        assert tuple(found) == identity

    def _scanned(self, number: int, bit: int, part: int, following: int) -> bool:
        request = b"\x51" + number.to_bytes(4, "little") + bytes((bit, part, following))
        return any(can_id == _LSS_SLAVE for can_id, _ in self.step([(_LSS_MASTER, request)]))
