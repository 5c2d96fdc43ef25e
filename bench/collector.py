"""What a row of a hand costs its collector, by the number of frames in a call, and beside another checkout.

    python -m bench.collector                      this version
    python -m bench.collector --beside ../before   beside the version in another checkout, in turns

CPU time of the process, the smallest of the rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

from bench.device import machine

from tipforce.host.frames.frame_array import FrameArray, frame_array
from tipforce.host.hand.collector import Collector

CASES = ((5, 1), (5, 2), (5, 6), (5, 60), (15, 8), (15, 16))
"""Fingers, frames in a call."""

ROWS = 2000


def blocks(fingers: int, frames: int) -> list[FrameArray]:
    """Numbered SYNCs with the Contact PDO of each finger, ``frames`` in each block."""
    found: list[tuple[int, int, bytes]] = []
    for row in range(ROWS):
        number = row % 240 + 1
        found.append((row * 1_000_000, 0x80, bytes((number,))))
        for k in range(fingers):
            data = struct.pack("<hhhBB", 1000 + row % 100, 4500, 3000, 3, number)
            found.append((row * 1_000_000 + 1000 * k, 0x281 + k, data))
    return [frame_array(found[at : at + frames]) for at in range(0, len(found), frames)]


def row_us(fingers: int, given: list[FrameArray]) -> float:
    """Microseconds of CPU time per row, once."""
    collector = Collector(range(1, fingers + 1), own_sync=True)
    start_ns = time.process_time_ns()
    rows = sum(len(collector.add(frames, number * 1e-3)) for number, frames in enumerate(given))
    spent_ns = time.process_time_ns() - start_ns
    if rows != ROWS:
        raise RuntimeError(f"{rows} rows of {ROWS}")
    return spent_ns / 1000 / rows


def measure() -> list[float]:
    """One round: each case, the smaller of two runs."""
    given = [blocks(*case) for case in CASES]
    return [min(row_us(case[0], one) for _ in range(2)) for case, one in zip(CASES, given, strict=True)]


def beside(checkout: Path) -> list[float]:
    """One round of another checkout in a process of its own."""
    path = os.pathsep.join(str(checkout / part) for part in ("node", "tools"))
    here = str(Path(__file__).parents[1])
    code = f"import sys; sys.path.append({here!r}); from bench import collector; print(collector.measure())"
    run = [sys.executable, "-c", code]
    out = subprocess.run(run, check=True, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path}).stdout
    found: list[float] = json.loads(out)
    return found


def main() -> int:
    """Run as a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--beside", type=Path, metavar="CHECKOUT")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    here = Path(__file__).parents[1]
    ours, theirs = [], []
    for _ in range(args.rounds):
        ours.append(beside(here))
        if args.beside:
            theirs.append(beside(args.beside))
    print(machine())
    for number, (fingers, frames) in enumerate(CASES):
        own = min(one[number] for one in ours)
        text = f"{fingers:2} fingers, {frames:2} frames a call: {own:6.1f} us a row"
        if theirs:
            other = min(one[number] for one in theirs)
            text += f", before {other:6.1f}, ratio {own / other:.2f}"
        print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
