"""Parameters in flash that loses power anywhere; conversations held with the firmware on both interpreters."""

import contextlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import firmware
import tipforce_loader
from conformance.fingertip import all_cases
from fingertip.finger import flipped
from microcontroller import talk
from microcontroller.fakes import MemorySlots
from microcontroller.program_board import PowerOffError
from micropython import engine, recording, scripts
from micropython.recording import Recording
from tipforce_loader.flash import BlockSlots, FileSlots, FlashStore

BLOCK = 64
GROUPS = {"application": bytes(range(40)), "calibration": b"\xff" * 50, "lss": b"\5"}
FOLDER, LOADER = Path(str(firmware.__file__)).parent, Path(str(tipforce_loader.__file__)).parent
HERE = Path(__file__).parent
# Every converter and every controller: every sixtieth conformance case each, and conversations.
PAIRS = {
    ("nau7802", "mcp2515"): (scripts.calibration, scripts.measurement, scripts.bus_faults),
    ("ads1220", "machine"): (scripts.many_gauges, scripts.filters, scripts.bus_faults),
    ("hx711", "pyb"): (scripts.measurement, scripts.lss),
}


class Device:
    """A block device that erases a block before it writes it; power goes after ``left`` bytes, erased ones included."""

    def __init__(self, content: bytes, left: int) -> None:
        self.content, self.left = bytearray(content), left

    def ioctl(self, operation: int, _argument: int) -> int:
        return {4: len(self.content) // BLOCK, 5: BLOCK}.get(operation, 0)

    def readblocks(self, block: int, buffer: bytearray) -> None:
        buffer[:] = self.content[block * BLOCK : block * BLOCK + len(buffer)]

    def writeblocks(self, block: int, buffer: bytearray) -> None:
        assert len(buffer) % BLOCK == 0
        for at in range(0, len(buffer), BLOCK):
            for part in (b"\xff" * BLOCK, bytes(buffer[at : at + BLOCK])):
                for k in range(BLOCK):
                    if not self.left:
                        raise PowerOffError
                    self.left -= 1
                    self.content[block * BLOCK + at + k] = part[k]


class CutFiles(FileSlots):
    """Files of which only the first ``left`` bytes arrive."""

    left = 1 << 30

    def write(self, slot: int, data: bytes) -> None:
        super().write(slot, data[: self.left])
        if self.left < len(data):
            raise PowerOffError


def states(store: FlashStore) -> dict[str, bytes | None]:
    return {name: store.load(name) for name in GROUPS}


def test_a_cut_at_every_byte_of_a_block_device() -> None:
    device = Device(b"\xff" * BLOCK * 12, 1 << 30)
    store = FlashStore(BlockSlots(device))
    for name, content in GROUPS.items():
        assert store.save(name, content)
    before, old = bytes(device.content), states(store)
    new = {**old, "calibration": b"new" * 20}
    seen = set()
    for left in range(4 * 3 * BLOCK):
        cut = Device(before, left)
        with contextlib.suppress(PowerOffError):
            FlashStore(BlockSlots(cut)).save("calibration", b"new" * 20)
        after = states(FlashStore(BlockSlots(Device(bytes(cut.content), 0))))
        assert after in (old, new), left
        seen.add(after == new)
        cut.left = 1 << 30
        again = FlashStore(BlockSlots(cut))  # and the next save works
        assert again.save("lss", b"\6")
        assert FlashStore(BlockSlots(cut)).load("lss") == b"\6"
    assert seen == {True, False}


def test_a_cut_at_every_byte_of_a_file(tmp_path: Path) -> None:
    slots = CutFiles(str(tmp_path / "tip"))
    store = FlashStore(slots)
    for name, content in GROUPS.items():
        assert store.save(name, content)
    old = states(store)
    kept = {path: path.read_bytes() for path in (tmp_path / "tip").iterdir()}
    assert len(kept) == 2
    size = max(len(content) for content in kept.values())
    for left in range(size):
        for path, content in kept.items():
            path.write_bytes(content)
        slots.left = left
        with pytest.raises(PowerOffError):
            FlashStore(slots).save("calibration", b"n" * 50)
        assert states(FlashStore(slots)) == old, left
    slots.left = 1 << 30
    assert FlashStore(slots).save("calibration", b"n" * 50)
    assert FlashStore(slots).load("calibration") == b"n" * 50


@given(st.dictionaries(st.text("abcxyz", min_size=1, max_size=9), st.binary(max_size=300), max_size=6))
def test_round_trip(groups: dict[str, bytes]) -> None:
    slots = MemorySlots()
    store = FlashStore(slots)
    for name, content in groups.items():
        assert store.save(name, content)
    found = FlashStore(slots)
    assert {name: found.load(name) for name in groups} == groups
    assert found.load("absent") is None


def test_every_flipped_bit_is_noticed() -> None:
    slots = MemorySlots()
    store = FlashStore(slots)
    store.save("lss", b"old")
    store.save("lss", b"new")
    (newest,) = [slot for slot in (0, 1) if b"new" in slots.slots[slot]]
    for bit in range(8 * len(slots.slots[newest])):
        other = MemorySlots()
        other.slots = list(slots.slots)
        other.slots[newest] = flipped(slots.slots[newest], bit)
        assert FlashStore(other).load("lss") == b"old"


def test_what_is_there_already_is_not_written_again_slots_take_turns_and_numbers_wrap() -> None:
    slots = MemorySlots()
    store = FlashStore(slots)
    store._sequence = 0xFFFFFFFD
    for k in range(10):
        assert store.save("lss", bytes((k,)))
        assert FlashStore(slots).load("lss") == bytes((k,))
        before = list(slots.slots)
        assert store.save("lss", bytes((k,)))
        assert slots.slots == before
    assert slots.writes == 10


def test_flash_that_fails_refuses_and_keeps(tmp_path: Path) -> None:
    class Worn(MemorySlots):
        def write(self, slot: int, data: bytes) -> None:
            super().write(slot, data[:-1] + b"?")

    store = FlashStore(Worn())
    assert not store.save("lss", b"x")
    assert store.error == "slot 0: does not read back"
    assert store.load("lss") is None
    (tmp_path / "file").write_text("")
    broken = FlashStore(FileSlots(str(tmp_path / "file")))
    assert not broken.save("lss", b"x")
    assert "NotADirectory" in broken.error
    assert not FlashStore(BlockSlots(Device(b"\xff" * BLOCK * 4, 1 << 30))).save("lss", bytes(500))
    with pytest.raises(ValueError, match="1 blocks, 2 are needed"):
        BlockSlots(Device(b"\xff" * BLOCK, 0))


def firmware_files() -> dict[str, bytes]:
    own = [path for folder in (FOLDER, LOADER) for path in sorted(folder.glob("*.py")) if path.name != "build.py"]
    found = {f"{engine.LIBRARY}/{path.parent.name}/{path.name}": path.read_bytes() for path in own}
    names = "fakes.py", "fake_controllers.py", "rig.py"
    found |= {f"{engine.LIBRARY}/microcontroller/{name}": (HERE / name).read_bytes() for name in names}
    return found


@pytest.fixture(scope="module")
def spoken() -> list[Recording]:
    recordings = []
    for number, ((adc, can), wanted) in enumerate(PAIRS.items()):
        cases = [case for case in all_cases() if not case.error_frames]  # those of a controller are a conversation
        recordings += talk.examined(adc, can, cases[number :: 20 * len(PAIRS)])
        recordings += talk.spoken(adc, can, wanted)
    return recordings


def test_conversations(spoken: list[Recording]) -> None:
    assert sum(sum(one.frames()) for one in spoken) > 5000
    recording.assert_same(spoken, engine.sources() | firmware_files(), "from microcontroller.rig import Replay")


def test_the_conversations_reach_what_the_firmware_adds(spoken: list[Recording]) -> None:
    """Gauges were read and showed a contact, controllers failed, converters fell silent, flash was written."""
    for one in spoken:
        words = [word for answer in one.answers for word in answer.split()]
        emcy = {word[3:7] for word in words if word.startswith("85#")}
        if "measurement" in one.name:
            contacts = [word.split("#")[1] for word in words if word.startswith("285#")]
            assert any(int(data[12:14], 16) & 3 == 3 for data in contacts), one.name
            assert emcy >= {"3050", "1050"}, one.name  # front end, gauge saturated
        if "bus faults" in one.name:
            assert emcy >= {"1081", "2081", "4081"}, one.name  # overrun, passive, back from bus-off
    assert {one.stored != "- -" for one in spoken} == {True, False}
