"""What the firmware takes of a microcontroller: size of its files, heap, and time once around its loop.

    python -m bench.firmware            a table
    python -m bench.firmware --json     the same as JSON

In MicroPython's WebAssembly build under Node.js, as bench.micropython, with three NAU7802 and an MCP2515 as fakes: what
the fakes take is not counted, but the time they need is. Pointers have 32 bits as a microcontroller's, so bytes of heap
carry over; times do not.
"""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from bench import printed

ROUNDS, REPEATS = 500, 7
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


def files(optimisation: int = 3) -> dict[str, bytes]:
    """The node's files and the firmware's, compiled, by their place on the board."""
    import firmware
    import tipforce_loader
    from micropython import engine

    found = dict(engine.compiled(optimisation))
    for folder in (Path(str(package.__file__)).parent for package in (firmware, tipforce_loader)):
        for path in sorted(folder.glob("*.py")):
            if path.stem not in ("main", "main_mcp2515", "__init__", "build"):  # sources, or not on the board
                found[f"{engine.LIBRARY}/{folder.name}/{path.stem}.mpy"] = engine.compile_file(path, optimisation)
    return found


def measure() -> dict[str, Any]:
    """Sizes, heap and times."""
    from micropython import engine

    compiled = files()
    sizes = {path.removeprefix(f"{engine.LIBRARY}/"): len(content) for path, content in compiled.items()}
    told = dict(compiled)
    for name in ("fakes.py", "fake_controllers.py"):
        fakes = Path(engine.__file__).parents[1] / "microcontroller" / name
        told[f"{engine.LIBRARY}/microcontroller/{name}"] = fakes.read_bytes()
    count = "import gc\nprint('heap', gc.mem_alloc())"
    calls = ["import sys", f"sys.path.append({engine.LIBRARY!r})", PREPARE, "import gc", count, IMPORT, count, DRIVERS,
             BUILD, count, "around(3000, 1000, False)", count]  # fmt: skip
    for name, step_us, sync in (("idle", 500, False), ("sync", 4000, True)):
        calls += [f"print('{name}', around({ROUNDS}, {step_us}, {sync}))" for _ in range(REPEATS + 1)]
    lines = [line.split() for line in engine.run(told, calls)]
    heap = [int(words[1]) for words in lines if words[0] == "heap"]
    times = {
        name: statistics.median([float(words[1]) for words in lines if words[0] == name][1:])
        for name in ("idle", "sync")
    }
    return {
        "sizes": sizes,
        "heap": {"code": heap[1] - heap[0], "node": heap[2] - heap[1], "after_3000_rounds": heap[3] - heap[2]},
        "microseconds": times,
    }


def table(found: dict[str, Any]) -> str:
    """For people."""
    sizes, heap, times = found["sizes"], found["heap"], found["microseconds"]
    of_firmware = {name: size for name, size in sizes.items() if name.startswith("firmware/")}
    of_loader = {name: size for name, size in sizes.items() if name.startswith("tipforce_loader/")}
    core = sum(sizes.values()) - sum(of_firmware.values()) - sum(of_loader.values())
    used = sum(of_firmware[f"firmware/{name}.mpy"] for name in MODULES)
    return "\n".join([
        "bytes of .mpy, -O3",
        *(f"  {name:28}{size:8}" for name, size in (of_firmware | of_loader).items()),
        f"  {'drivers of this board':28}{used:8}",
        f"  {'the loader':28}{sum(of_loader.values()):8}",
        f"  {'the node itself (tipforce/)':28}{core:8}",
        "bytes of heap, loaded from files",
        f"  {'all modules imported':28}{heap['code']:8}",
        f"  {'node, gauges, port, flash':28}{heap['node']:8}",
        f"  {'more after 3000 rounds':28}{heap['after_3000_rounds']:8}",
        "microseconds once around the loop, on this PC, fakes included",
        f"  {'nothing to do':28}{times['idle']:8.0f}",
        f"  {'new reading, SYNC, two TPDOs':28}{times['sync']:8.0f}",
    ])  # fmt: skip


if __name__ == "__main__":
    printed.main(__doc__, measure, table)
