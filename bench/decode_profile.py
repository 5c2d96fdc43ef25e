"""Where the processor's time of decoding in memory goes: `python -m bench.decode_profile LOG`."""

from __future__ import annotations

import cProfile
import pstats
import sys
import time
from pathlib import Path

from bench.decode_methods import memory

_SHOWN = 12


def profile(log: Path) -> list[str]:
    """The functions with the largest times of their own, numpy's loops within them included, as rows of Markdown."""
    memory(log)
    profiler = cProfile.Profile(time.process_time)
    profiler.enable()
    memory(log)
    profiler.disable()
    stats = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
    own = sorted(((row[2], place) for place, row in stats.items()), reverse=True)
    total = sum(seconds for seconds, _ in own)
    lines = ["| function | share of the time |", "|---|---|"]
    for seconds, (file, _, name) in own[:_SHOWN]:
        shown = name if file == "~" else f"{Path(file).name}: {name}"
        lines.append(f"| {shown} | {100 * seconds / total:.0f} % |")
    return lines


if __name__ == "__main__":
    print("\n".join(profile(Path(sys.argv[1]))))
