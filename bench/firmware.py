"""What node and firmware take of a microcontroller: size of their files, heap, and times beside CPython's.

    python -m bench.firmware

MicroPython is the WebAssembly build that the tests use: its heap has pointers of 32 bits as a microcontroller's, its
speed is that of this machine, and its times hold no collection of garbage. Of the fakes of three NAU7802 and an MCP2515
the time counts, the heap does not."""

import statistics
import sys
from pathlib import Path

from bench.firmware_image import contents
from bench.measure import ROOT, arguments, table

REPEATS, WARM_UP = 7, 1  # this MicroPython has a clock of milliseconds
STEPS, ROUNDS, START_US = 2000, 500, 20_000_000
SYNC = 0x080, b""
NOT_COMPILED = ("main", "main_mcp2515")  # sources on the board
MODULES = "app", "can_port", "can_mcp2515", "nau7802", "source"  # of this board; the others have the rest
BUILD = """
drivers = [Nau7802(nau) for nau in naus]
port = Mcp2515(bus, bus.cs, 500000)
node = Firmware(5, Gauges(drivers, 1024.0), port, FlashStore(slots), 1, Clock(clock.ticks, clock.diff))
node.poll()
bus.coming.append((0, b'\\1\\0'))
node.poll()
"""
PREPARE = """
from microcontroller.fake_controllers import FakeMcp2515
from microcontroller.fakes import FakeClock, FakeNau7802, MemorySlots
clock = FakeClock()
naus = [FakeNau7802(clock, [1000 * k + 1]) for k in range(3)]
bus = FakeMcp2515()
slots = MemorySlots()
def around(count, step_us, sync):
    import time
    begun = time.ticks_us()
    for k in range(count):
        clock.now_us += step_us
        if sync:
            bus.coming.append((0x80, b''))
        node.poll()
        bus.sent.clear()
    return (time.ticks_us() - begun) / count
"""
IMPORT = """
from firmware.app import Clock, Firmware
from firmware.can_mcp2515 import Mcp2515
from tipforce_loader.flash import FlashStore
from firmware.nau7802 import Nau7802
from firmware.source import Gauges
import tipforce.fingertip.node
"""


def sync_us() -> tuple[float, float]:
    """Microseconds of a SYNC with two TPDOs, the median of the repeats, in MicroPython and in CPython."""
    from micropython import engine, footprint, on_node

    talk = footprint.ready_node()
    files = engine.compiled(3) | engine.program() | {"/ready": talk.recording.text().encode()}
    calls = ["import on_node", *footprint.bring_up(talk)]
    here: list[float] = []
    for repeat in range(WARM_UP + REPEATS):
        now_us = START_US + 1000 * STEPS * repeat
        here.append(on_node.microseconds(talk.recorded.device, SYNC, STEPS, now_us))
        calls.append(f"print('time', on_node.microseconds(replay.device, {SYNC!r}, {STEPS}, {now_us}))")
    there = [float(line.split()[1]) for line in engine.run(files, calls) if line.startswith("time")]
    return statistics.median(there[WARM_UP:]), statistics.median(here[WARM_UP:])


def around_the_loop() -> tuple[dict[str, int], dict[str, float]]:
    """(bytes of heap, microseconds once around the firmware's loop)."""
    from micropython import engine

    files = {f"{engine.LIBRARY}/{path}": code for path, code in _files().items()}
    for name in ("fakes.py", "fake_controllers.py"):
        fakes = Path(engine.__file__).parents[1] / "microcontroller" / name
        files[f"{engine.LIBRARY}/microcontroller/{name}"] = fakes.read_bytes()
    count = "import gc\nprint('heap', gc.mem_alloc())"
    calls = [PREPARE, "import gc", count, IMPORT, count, BUILD, count, "around(3000, 1000, False)", count]
    for name, step_us, sync in (("nothing to do", 500, False), ("new reading, SYNC, two TPDOs", 4000, True)):
        calls += [f"print('time', '{name}:', around({ROUNDS}, {step_us}, {sync}))"] * (REPEATS + 1)
    lines = engine.run(files, calls)
    heap = [int(line.split()[1]) for line in lines if line.startswith("heap")]
    times: dict[str, list[float]] = {}
    for line in lines:
        if line.startswith("time"):
            name, us = line.removeprefix("time ").split(": ")
            times.setdefault(name, []).append(float(us))
    held = {"all modules imported": heap[1] - heap[0], "node, gauges, port, flash": heap[2] - heap[1],
            "more after 3000 rounds": heap[3] - heap[2]}  # fmt: skip
    return held, {name: statistics.median(us[1:]) for name, us in times.items()}


def _files() -> dict[str, bytes]:
    """The node's files, the firmware's and the loader's, compiled, by their place on the board."""
    import tipforce_loader
    from micropython import engine

    compiled = {path: code for path, code in contents().items() if Path(path).stem not in NOT_COMPILED}
    for path in sorted(Path(str(tipforce_loader.__file__)).parent.glob("*.py")):
        if path.stem not in ("__init__", "build", *NOT_COMPILED):
            compiled[f"tipforce_loader/{path.stem}.mpy"] = engine.compile_file(path, 3)
    return compiled


def main() -> None:
    """Measure with the runners of the tests, and print the tables."""
    arguments(__doc__).parse_args()
    sys.path.insert(0, str(ROOT / "tests"))
    from micropython import engine, footprint

    sizes = {path: len(code) for path, code in _files().items()}
    totals = {
        "drivers of this board": sum(sizes[f"firmware/{name}.mpy"] for name in MODULES),
        "the node itself (tipforce/)": sum(size for name, size in sizes.items() if name.startswith("tipforce/")),
    }
    loop_heap, loop_us = around_the_loop()
    times_us = dict(zip(("SYNC, two TPDOs: MicroPython", "CPython"), sync_us(), strict=True)) | loop_us
    for header, figures in (
        ("bytes of .mpy at -O3", totals),
        ("the node from sources: bytes of heap", vars(footprint.heap(engine.sources()))),
        ("the firmware from files: bytes of heap", loop_heap),
        ("us on this PC; of the firmware once around its loop, fakes included", times_us),
    ):
        rows = [[name.replace("_", " "), f"{figure:.0f}"] for name, figure in figures.items()]
        print(table([header, ""], rows, markdown=False), end="\n\n")


if __name__ == "__main__":
    main()
