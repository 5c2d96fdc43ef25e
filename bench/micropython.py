"""The fingertip node on MicroPython: code size, heap in use, and time per SYNC and SDO request beside CPython's.

    python -m bench.micropython            a table
    python -m bench.micropython --json     the same as JSON

MicroPython is the WebAssembly build under Node.js that the tests use (`make test` installs it). Its heap has pointers
of 32 bits as a microcontroller's; its speed is that of this machine, and its times hold no collection of garbage.
"""

from __future__ import annotations

import platform
import statistics
from dataclasses import asdict
from typing import Any

from bench import printed

STEPS, REPEATS, WARM_UP = 2000, 7, 1  # this MicroPython has a clock of milliseconds
LEVELS = (0, 3)  # -O1 and -O2 leave out assert statements, and there are none
FAR_US = 1 << 41  # 25 days after power-on: integers beyond 2^30 live on MicroPython's heap
# What is timed: name, frame, the clock at the beginning.
TIMED: tuple[tuple[str, int, str, int], ...] = (
    ("SYNC, two TPDOs", 0x080, "", 20_000_000),
    ("SDO upload 1018h:1", 0x605, "4018100100000000", 60_000_000),
    ("SDO upload 6130h:7, live", 0x605, "4030610700000000", 100_000_000),
    ("SDO download 2101h:1", 0x605, "2301210100000000", 140_000_000),
    ("SYNC, two TPDOs, after 25 days", 0x080, "", FAR_US),
)


def code_sizes() -> dict[str, list[int]]:
    """Bytes of each compiled file, by mpy-cross at each of LEVELS."""
    from micropython import engine

    sizes: dict[str, list[int]] = {}
    for level in LEVELS:
        for path, content in engine.compiled(level).items():
            sizes.setdefault(path.removeprefix(f"{engine.LIBRARY}/"), []).append(len(content))
    return sizes


def heaps() -> dict[str, dict[str, int]]:
    """Heap in use, with the library as sources and as compiled files."""
    from micropython import engine, footprint

    libraries = {"sources": engine.sources(), ".mpy -O0": engine.compiled(0), ".mpy -O3": engine.compiled(3)}
    return {name: asdict(footprint.heap(files)) for name, files in libraries.items()}


def times() -> dict[str, dict[str, float]]:
    """Microseconds per step, the median of the repeats, in both interpreters and on the same node."""
    from micropython import engine, footprint, on_node

    talk = footprint.ready_node()
    told = engine.compiled(3) | engine.program() | {"/ready": talk.recording.text().encode()}
    calls = ["import sys", f"sys.path.append({engine.LIBRARY!r})", "import on_node", *footprint.bring_up(talk)]
    here: list[float] = []
    for _name, can_id, data, start_us in TIMED:
        frame = (can_id, bytes.fromhex(data))
        for repeat in range(WARM_UP + REPEATS):
            now_us = start_us + 1000 * STEPS * repeat
            here.append(on_node.microseconds(talk.recorded.device, frame, STEPS, now_us))
            call = f"on_node.microseconds(replay.device, {frame!r}, {STEPS}, {now_us})"
            calls.append(f"print('time', {call})")
    there = [float(line.split()[1]) for line in engine.run(told, calls) if line.startswith("time")]
    return {
        name: {"micropython_us": _median(there, k), "cpython_us": _median(here, k)}
        for k, (name, *_rest) in enumerate(TIMED)
    }


def _median(values: list[float], row: int) -> float:
    first = row * (WARM_UP + REPEATS)
    return round(statistics.median(values[first + WARM_UP : first + WARM_UP + REPEATS]), 2)


def measure() -> dict[str, Any]:
    """Everything, as --json gives it."""
    return {
        "cpython": platform.python_version(), "machine": platform.machine(),
        "code_bytes": code_sizes(), "heap_bytes": heaps(), "time": times(),
    }  # fmt: skip


def table(found: dict[str, Any]) -> str:
    """The same for people."""
    rows = [f"{'code size, bytes of .mpy':42}" + "".join(f"{f'-O{level}':>9}" for level in LEVELS)]
    sizes: dict[str, list[int]] = found["code_bytes"]
    rows += [f"{name:42}" + "".join(f"{size:9}" for size in sizes[name]) for name in sorted(sizes)]
    rows += [f"{'total':42}" + "".join(f"{sum(column):9}" for column in zip(*sizes.values(), strict=True)), ""]
    heap: dict[str, dict[str, int]] = found["heap_bytes"]
    rows += [f"{'heap in use, bytes':42}" + "".join(f"{name:>12}" for name in heap)]
    for field in next(iter(heap.values())):
        rows.append(f"{field.replace('_', ' '):42}" + "".join(f"{column[field]:12}" for column in heap.values()))
    rows += ["", f"{'time, us':42}{'MicroPython':>12}{'CPython':>12}{'ratio':>9}"]
    for name, pair in found["time"].items():
        there, here = pair["micropython_us"], pair["cpython_us"]
        rows.append(f"{name:42}{there:12.1f}{here:12.1f}{there / here:9.1f}")
    return "\n".join(rows)


if __name__ == "__main__":
    printed.main(__doc__, measure, table)
