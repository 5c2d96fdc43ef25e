"""What node and firmware take of a microcontroller: size of their files, heap, and times beside CPython's.

    python -m bench.firmware

MicroPython is the WebAssembly build under Node.js that the tests use (`make test` installs it). Its heap has pointers
of 32 bits as a microcontroller's; its speed is that of this machine, and its times hold no collection of garbage. The
firmware has three NAU7802 and an MCP2515 as fakes: what they take is not counted, but the time they need is.
"""

import statistics
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
from bench.firmware_image import contents
from bench.measure import ROOT, arguments, table

REPEATS, WARM_UP = 7, 1  # this MicroPython has a clock of milliseconds
STEPS, ROUNDS = 2000, 500
LEVELS = (0, 3)  # -O1 and -O2 leave out assert statements, and there are none
FAR_US = 1 << 41  # 25 days after power-on: integers beyond 2^30 live on MicroPython's heap
# What is timed of the node: name, frame, the clock at the beginning.
TIMED: tuple[tuple[str, int, str, int], ...] = (
    ("SYNC, two TPDOs", 0x080, "", 20_000_000),
    ("SDO upload 1018h:1", 0x605, "4018100100000000", 60_000_000),
    ("SDO upload 6130h:7, live", 0x605, "4030610700000000", 100_000_000),
    ("SDO download 2101h:1", 0x605, "2301210100000000", 140_000_000),
    ("SYNC, two TPDOs, after 25 days", 0x080, "", FAR_US),
)
NOT_COMPILED = ("main", "main_mcp2515")  # sources on the board
MODULES = "app", "can_port", "can_mcp2515", "nau7802", "source"  # of this board; the others have the rest
BUILD = """
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
DRIVERS = "drivers = [Nau7802(nau) for nau in naus]\nport = Mcp2515(bus, bus.cs, 500000)"


def node_us() -> dict[str, tuple[float, float]]:
    """Microseconds per step, the median of the repeats, in MicroPython and CPython and on the same node."""
    from micropython import engine, footprint, on_node

    talk = footprint.ready_node()
    files = engine.compiled(3) | engine.program() | {"/ready": talk.recording.text().encode()}
    calls = ["import on_node", *footprint.bring_up(talk)]
    here: list[float] = []
    for _name, can_id, data, start_us in TIMED:
        frame = (can_id, bytes.fromhex(data))
        for repeat in range(WARM_UP + REPEATS):
            now_us = start_us + 1000 * STEPS * repeat
            here.append(on_node.microseconds(talk.recorded.device, frame, STEPS, now_us))
            calls.append(f"print('time', on_node.microseconds(replay.device, {frame!r}, {STEPS}, {now_us}))")
    there = [float(line.split()[1]) for line in engine.run(files, calls) if line.startswith("time")]
    times = np.reshape([there, here], (2, len(TIMED), WARM_UP + REPEATS))
    medians = np.median(times[:, :, WARM_UP:], axis=2).T.tolist()
    return {name: (of_there, of_here) for (name, *_), (of_there, of_here) in zip(TIMED, medians, strict=True)}


def around_the_loop() -> tuple[dict[str, int], dict[str, float]]:
    """(bytes of heap, microseconds once around the firmware's loop)."""
    from micropython import engine

    files = {f"{engine.LIBRARY}/{path}": code for path, code in _files(3).items()}
    for name in ("fakes.py", "fake_controllers.py"):
        fakes = Path(engine.__file__).parents[1] / "microcontroller" / name
        files[f"{engine.LIBRARY}/microcontroller/{name}"] = fakes.read_bytes()
    count = "import gc\nprint('heap', gc.mem_alloc())"
    calls = [PREPARE, "import gc", count, IMPORT, count, DRIVERS,
             BUILD, count, "around(3000, 1000, False)", count]  # fmt: skip
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


def _files(level: int) -> dict[str, bytes]:
    """The node's files, the firmware's and the loader's, compiled, by their place on the board."""
    import tipforce_loader
    from micropython import engine

    compiled = {path: code for path, code in contents(level).items() if Path(path).stem not in NOT_COMPILED}
    for path in sorted(Path(str(tipforce_loader.__file__)).parent.glob("*.py")):
        if path.stem not in ("__init__", "build", *NOT_COMPILED):
            compiled[f"tipforce_loader/{path.stem}.mpy"] = engine.compile_file(path, level)
    return compiled


def main() -> None:
    """Measure with the runners of the tests, and print the tables."""
    arguments(__doc__).parse_args()
    sys.path.insert(0, str(ROOT / "tests"))
    from micropython import engine, footprint

    levels = [{path: len(code) for path, code in _files(level).items()} for level in LEVELS]
    sizes = {name: [level[name] for level in levels] for name in sorted(levels[-1])}
    totals = {
        "drivers of this board": [f"firmware/{name}.mpy" for name in MODULES],
        "the loader": [name for name in sizes if name.startswith("tipforce_loader/")],
        "the node itself (tipforce/)": [name for name in sizes if name.startswith("tipforce/")],
    }
    for what, names in totals.items():
        sizes[what] = [sum(column) for column in zip(*(sizes[name] for name in names), strict=True)]
    files = {"sources": engine.sources(), ".mpy -O0": engine.compiled(0), ".mpy -O3": engine.compiled(3)}
    heap = {name: asdict(footprint.heap(of_kind)) for name, of_kind in files.items()}
    loop_heap, loop_us = around_the_loop()
    for header, rows in (
        (["code size, bytes of .mpy", *(f"-O{level}" for level in LEVELS)],
         [[name, *map(str, size)] for name, size in sizes.items()]),
        (["the node: heap in use, bytes", *heap],
         [[field.replace("_", " "), *(str(of_kind[field]) for of_kind in heap.values())] for field in heap["sources"]]),
        (["the node: time, us", "MicroPython", "CPython", "ratio"],
         [[name, f"{there:.1f}", f"{here:.1f}", f"{there / here:.1f}"] for name, (there, here) in node_us().items()]),
        (["the firmware: heap in use, bytes", "loaded from files"],
         [[name, str(size)] for name, size in loop_heap.items()]),
        (["the firmware: us once around its loop, on this PC", "fakes included"],
         [[name, f"{us:.0f}"] for name, us in loop_us.items()]),
    ):  # fmt: skip
        print(table(header, rows, markdown=False), end="\n\n")


if __name__ == "__main__":
    main()
