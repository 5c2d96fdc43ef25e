"""The main programs as they lie in the folder run on MicroPython, with modules ``machine`` and ``pyb`` of fakes."""

from pathlib import Path

import pytest

from microcontroller import program_board
from microcontroller.test_replay import FOLDER, LOADER, firmware_files
from micropython import engine
from tipforce.dictionary import table
from tipforce_loader import build
from tipforce_loader.flash import FileSlots, FlashStore
from tipforce_loader.programs import INSTALLED

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
    return engine.run(files, ["import sys", f"sys.path.append({engine.LIBRARY!r})", RUN])


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
    path = f"import sys\nsys.path.append({engine.LIBRARY!r})"
    lines = engine.run(files, [path, START, POWER_CYCLE, START])
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
