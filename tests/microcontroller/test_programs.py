"""The firmware's main loop, and its programs: downloads, power cuts, signatures, fallback."""

import hashlib
import hmac
import io
import os
import random
import sys
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace

import pytest

from canopen_device.core import codes, program
from fingertip.finger import flipped
from microcontroller import program_board
from microcontroller.program_board import INSTALLED_VERSION, KEY, Board, Flash, PowerOffError, image
from microcontroller.test_flash import FOLDER, LOADER, firmware_files
from micropython import engine
from tipforce.dictionary import table
from tipforce_loader import boot, build
from tipforce_loader import image as loader_image
from tipforce_loader.flash import FileSlots, FlashStore
from tipforce_loader.programs import INSTALLED

POWER_CUTS, CORRUPTED = 2 * int(os.environ.get("TIPFORCE_KILLS", "30")), 15
OLD, NEW = image((0, 2, 0)), image((0, 3, 0))


def version_of(content: bytes) -> tuple[str, int]:
    header = loader_image.Header(content)
    return header.version_text(), header.crc


def update(board: Board, content: bytes) -> None:
    transfer = board.download(content)
    assert transfer.abort_code is None
    assert transfer.failure is None
    assert board.control(program.START) is None
    assert ("restart", 0, program.RESTART_DELAY_MS) in board.device.requests
    board.power_on()
    board.programs.confirm()


@pytest.fixture(scope="module")
def with_old() -> Flash:
    board = Board()
    update(board, OLD)
    board.flash.written = 0
    return board.flash


def running(board: Board) -> tuple[str, int]:
    return board.programs.version, board.programs.crc


def test_updates_take_turns_and_survive_a_power_cycle() -> None:
    board = Board()
    assert (board.slot, board.programs.version, board.programs.crc) == (INSTALLED, INSTALLED_VERSION, 0)
    for slot, content in ((0, OLD), (1, NEW), (0, OLD)):
        update(board, content)
        board.power_on()
        assert board.slot == slot
        assert running(board) == version_of(content)
        assert board.programs.reason == 0
        assert board.device.od.get(0x100A) == version_of(content)[0]


def test_power_cuts(with_old: Flash) -> None:
    whole = deepcopy(with_old)
    update(Board(whole), NEW)
    random_cut = random.Random(17)
    seen = set()
    for number in range(POWER_CUTS):
        flash = deepcopy(with_old)
        # The last cuts are in the records, where the program changes.
        flash.left = random_cut.randrange(whole.written) if number % 4 else whole.written - 1 - number // 4
        with pytest.raises(PowerOffError):
            update(Board(flash), NEW)
        flash.left = 1 << 60
        board = Board(flash)
        assert running(board) in (version_of(OLD), version_of(NEW)), number
        if board.programs.locked:
            board.power_on()  # not confirmed
            assert running(board) == version_of(OLD), number
            assert board.programs.reason == loader_image.UNHEALTHY
        seen.add(running(board))
        before = running(board)
        board.power_on()
        assert running(board) == before, number
        update(board, NEW)
        assert running(board) == version_of(NEW), number
    assert version_of(OLD) in seen


def test_corrupted_transfers(with_old: Flash) -> None:
    """One bit of one frame is wrong: the node refuses, or its client does; the next transfer succeeds."""
    chance = random.Random(50)
    refused = 0
    for _ in range(CORRUPTED):
        board = Board(deepcopy(with_old))
        frames_left, bit = iter(range(chance.randrange(len(NEW) // 7 + 3), -1, -1)), chance.randrange(64)

        def fault(data: bytes, frames_left: Iterator[int] = frames_left, bit: int = bit) -> bytes:
            return data if next(frames_left, -1) != 0 else flipped(data, bit)

        transfer = board.download(NEW, fault)
        accepted = transfer.abort_code is None and transfer.failure is None
        if accepted:  # a segment with a wrong number was repeated
            assert board.programs.ready
        else:
            refused += 1
            assert not board.programs.ready
            assert board.control(program.START) is None  # nothing to start: the running program goes on
            assert board.device.requests == [("reset-node", 0, 0)] or not board.device.requests
        board.power_on()
        assert running(board) == version_of(OLD)
        update(board, NEW)
        assert running(board) == version_of(NEW)
    assert refused > CORRUPTED // 2


@pytest.mark.parametrize(
    ("content", "abort", "reason", "error"),
    [
        (image(key=b"another key"), codes.NOT_TRANSFERRED, loader_image.WRONG_SIGNATURE, 63),
        (image(product=0x12340003), codes.INVALID_VALUE, loader_image.OTHER_PRODUCT, 2),
        (b"\x7fELF" + NEW[4:], codes.INVALID_VALUE, loader_image.NOT_AN_IMAGE, 2),
        (NEW[:-1], codes.INVALID_VALUE, loader_image.DAMAGED, 3),
        (NEW + b"\0", codes.INVALID_VALUE, loader_image.DAMAGED, 3),
        (NEW[:-1] + b"?", codes.INVALID_VALUE, loader_image.DAMAGED, 3),
        (NEW[:40], codes.INVALID_VALUE, loader_image.NOT_AN_IMAGE, 2),
        (bytes(Flash.size + 1), codes.OUT_OF_MEMORY, loader_image.TOO_LARGE, 6),
    ],
)
def test_a_refused_image_says_why(content: bytes, abort: int, reason: int, error: int) -> None:
    board = Board()
    assert board.download(content).abort_code == abort
    assert board.device.od.get(0x1F57, 1) == reason << 16 | error << 1
    board.power_on()
    assert board.slot == INSTALLED


def test_an_unhealthy_program_runs_once(with_old: Flash) -> None:
    board = Board(deepcopy(with_old))
    board.download(NEW)
    board.control(program.START)
    board.power_on()
    assert running(board) == version_of(NEW)
    assert int(board.device.od.get(0x1F57, 1)) & program.IN_PROGRESS
    # The slot of the old program is needed until the new one is confirmed.
    assert board.download(OLD).abort_code == codes.DEVICE_STATE
    assert board.control(program.CLEAR) == codes.DEVICE_STATE
    board.power_on()
    assert running(board) == version_of(OLD)
    assert board.device.od.get(0x1F57, 1) == loader_image.UNHEALTHY << 16 | 63 << 1


def test_a_damaged_program_leaves_the_installed_one(with_old: Flash) -> None:
    flash = deepcopy(with_old)
    flash.programs[0][2000] ^= 1
    board = Board(flash)
    assert (board.slot, board.programs.reason) == (INSTALLED, loader_image.DAMAGED)
    update(board, NEW)
    assert running(board) == version_of(NEW)


def test_control() -> None:
    board = Board()
    assert board.device.od.get(0x1F51, 1) == program.RUNNING
    assert board.control(program.STOP) is None
    assert board.device.od.get(0x1F51, 1) == program.STOPPED
    assert board.control(program.CLEAR) is None
    assert board.control(program.START) is None
    assert board.device.od.get(0x1F51, 1) == program.RUNNING
    assert board.control(4) == codes.TOO_HIGH
    board.download(NEW)
    assert board.control(program.CLEAR) is None
    board.device.requests.clear()
    assert board.control(program.START) is None
    assert not board.device.requests
    board.control(program.RESET)
    assert board.device.requests == [("restart", 0, program.RESTART_DELAY_MS)]
    board.device.step(board.now_us, [(0, b"\1\5")])
    assert board.download(NEW).abort_code == codes.DEVICE_STATE
    assert board.control(program.STOP) == codes.DEVICE_STATE


def test_the_signature_is_the_hmac_of_the_standard_library() -> None:
    content = build.image((1, 2, 3), table.PRODUCT, {"a.mpy": b"a", "b/c.mpy": b""}, KEY)
    assert content[20:52] == hmac.new(KEY, content[:20] + content[52:], hashlib.sha256).digest()
    found = {path: content[at : at + size] for path, at, size in loader_image.files(io.BytesIO(content))}
    assert found == {"a.mpy": b"a", "b/c.mpy": b""}
    for key in (b"", bytes(65)):
        with pytest.raises(ValueError, match="allowed 1 to 64"):
            loader_image.Hmac(key)
    with pytest.raises(ValueError, match="allowed are 0 to 255"):
        build.image((1, 256, 0), table.PRODUCT, {}, KEY)


MACHINE = """
from microcontroller import fake_controllers, fakes

clock = fakes.FakeClock()
machine_can, pyb_can = fake_controllers.FakeMachineCan(), fake_controllers.FakePybCan()
mcp2515 = fake_controllers.FakeMcp2515()
buses = []
fed = 0

PWRON_RESET, WDT_RESET = 1, 3

def reset_cause():
    return PWRON_RESET

class Off(Exception):
    pass

class Reset(Exception):
    pass

def reset():
    raise Reset

class Pin:
    OUT = 1
    def __init__(self, number, mode=0, value=0):
        self.value = mcp2515.cs.value if number == 5 else None

def I2C(number, scl, sda, freq):
    assert freq <= 400000
    return fakes.FakeNau7802(clock, [1, 2] if number == 0 else [3])

def SPI(number, baudrate, polarity, phase):
    assert (polarity, phase) == (0, 0) and baudrate <= 10000000
    buses.append(mcp2515)
    return mcp2515

def CAN(number, bitrate):
    buses.append(machine_can)
    return machine_can

def unique_id():
    return b'\\1\\2\\3'

class WDT:
    def __init__(self, timeout):
        assert timeout == 2000
    def feed(self):
        global fed
        fed += 1
        clock.now_us += 500
        if fed == 3:
            buses[0].coming.append((0x605, bytes((0x40, 0x18, 0x10, 4, 0, 0, 0, 0))))
            buses[0].coming.append((0x605, bytes((0x23, 0x10, 0x10, 1)) + b'save'))
        if fed == 20:
            raise Off
"""
PYB = """
import machine
from microcontroller import fake_controllers

def CAN(number):
    machine.buses.append(machine.pyb_can)
    return machine.pyb_can
"""
RUN = """
import machine
try:
    exec(open('/main.py').read(), {})
except machine.Off:
    pass
import os, tipforce.fingertip.node
for can_id, data in machine.buses[0].sent:
    print('%03X#%s' % (can_id, data.hex()))
print(machine.buses[0].bit_rates[-1], len(machine.buses), sorted(os.listdir('/tip')))
"""


@pytest.mark.parametrize("path", sorted([*FOLDER.glob("*.py"), *LOADER.glob("*.py")]), ids=lambda path: path.name)
def test_mpy_cross_compiles(path: Path) -> None:
    assert engine.compile_file(path, 3)[:1] == b"M"


def run_main(program: str, inside: str, machine: str) -> list[str]:
    """What a main program prints that finds its CAN controller ``inside`` a module."""
    machine = machine if inside == "machine" else machine.replace("def CAN(", "def no_can(")
    files = engine.sources() | firmware_files()
    files |= {f"{engine.LIBRARY}/machine.py": machine.encode(), "/main.py": (FOLDER / program).read_bytes()}
    if inside == "pyb":
        files[f"{engine.LIBRARY}/pyb.py"] = PYB.encode()
    return engine.run(files, [RUN])


@pytest.mark.parametrize(("program", "inside"), [("main.py", "machine"), ("main.py", "pyb"), ("main_mcp2515.py", "")])
def test_a_main_program(program: str, inside: str) -> None:
    lines = run_main(program, inside, MACHINE)
    # Boot-up, the serial number made of the microcontroller's own (CRC-32 of 01 02 03), stored: two slots.
    assert lines[:-1] == ["705#00", "585#431810041d80bc55", "585#6010100100000000"]
    assert lines[-1] == "1000000 1 ['slot0.bin', 'slot1.bin']"


def test_after_a_restart_without_power_off_the_budget_of_wear_is_empty() -> None:
    lines = run_main("main.py", "machine", MACHINE.replace("return PWRON_RESET", "return WDT_RESET"))
    assert lines[:-1] == ["705#00", "585#431810041d80bc55", "585#8010100122000008", "085#10ff000000000000"]
    assert lines[-1] == "1000000 1 []"


START = """
import sys, machine
try:
    exec(open('/main.py').read(), {})
except (machine.Off, machine.Reset):
    pass
from tipforce_loader import boot
import firmware.app
print('program', boot.programs.version, '/running' in sys.path, boot.programs.on_trial, boot.programs.reason)
print('imported', firmware.app.__file__)
for can_id, data in machine.buses[0].sent:
    print('%03X#%s' % (can_id, data.hex()))
"""
POWER_CYCLE = """
import vfs
vfs.umount('/running')
sys.path.remove('/running')
for name in list(sys.modules):
    if name == 'machine' or [top for top in ('firmware', 'tipforce', 'canopen_device') if name.startswith(top)]:
        del sys.modules[name]
"""


def test_a_program_on_trial_that_cannot_be_mounted_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = {"PROGRAM_KEY": KEY, "PRODUCT": table.PRODUCT, "VERSION": INSTALLED_VERSION, "MAIN": "none"}
    board = SimpleNamespace(**facts, PROGRAM_FOLDER=str(tmp_path), restart=sys.exit)
    (tmp_path / "program0.bin").write_bytes(build.image((0, 7, 0), table.PRODUCT, {}, KEY))
    FlashStore(FileSlots(f"{tmp_path}-record")).save("program", bytes((INSTALLED, 0, 0, 0)))
    monkeypatch.setattr(boot, "board", board)
    monkeypatch.setattr(sys, "print_exception", print, raising=False)
    monkeypatch.setitem(sys.modules, "vfs", None)  # its import fails, as a mount without memory does
    with pytest.raises(SystemExit):
        boot.run()


def test_the_loader_starts_a_program_from_its_image_once_unless_it_is_confirmed(tmp_path: Path) -> None:
    """The modules are imported out of the image; the next power-on returns to the files of the board."""
    own = [path for path in FOLDER.glob("*.py") if path.stem != "main_mcp2515"]
    contents = {path.removeprefix(f"{engine.LIBRARY}/"): content for path, content in engine.compiled(3).items()}
    contents |= {f"firmware/{path.stem}.mpy": engine.compile_file(path, 3) for path in own}
    image = build.image((0, 7, 0), table.PRODUCT, contents, program_board.KEY)
    assert FlashStore(FileSlots(str(tmp_path))).save("program", bytes((INSTALLED, 0, 0, 0)))
    record = {f"/program-record/{path.name}": path.read_bytes() for path in tmp_path.iterdir()}
    board = (LOADER / "board.py").read_text().replace('PROGRAM_KEY = b""', f"PROGRAM_KEY = {program_board.KEY!r}")
    files = engine.sources() | firmware_files() | record
    files |= {
        "/program/program0.bin": image,
        "/main.py": (LOADER / "main.py").read_bytes(),
        f"{engine.LIBRARY}/machine.py": MACHINE.replace("0x18, 0x10, 4", "0x56, 0x1F, 1").encode(),
        f"{engine.LIBRARY}/tipforce_loader/board.py": board.encode(),
    }
    lines = engine.run(files, [START, POWER_CYCLE, START])
    crc = image[16:20].hex()
    # Power goes within the trial: the same as a program that hangs until the watchdog restarts the board.
    assert [line for line in lines if line[:7] in ("program", "importe", "585#435")] == [
        "program 0.7.0 True True 0",
        "imported /running/firmware/app.mpy",
        f"585#43561f01{crc}",
        "program 0.1.0 False False 7",
        "imported /lib/firmware/app.py",
        "585#43561f0100000000",
    ]
