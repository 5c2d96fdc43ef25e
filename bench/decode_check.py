"""Every value of the bulk decoder against cantools reading the committed .dbc: `python -m bench.decode_check`."""

from __future__ import annotations

import math
from typing import Any

import cantools
import numpy as np
import numpy.typing as npt
from bench.decode_methods import DBC

from tipforce.host.decoding.columns import Column
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.frames.frame_array import FRAME, FrameArray

_SPECIAL = np.array([0x8000, 0x8001, 0x7FFF, 0, 0xFFFF], dtype=np.uint16)
_BLOCK = 100_000


def random_frames(count: int, seed: int) -> FrameArray:
    """Random data on all four messages of nodes 1-15; one value in five is unknown or at a limit."""
    random = np.random.default_rng(seed)
    frames: FrameArray = np.zeros(count, dtype=FRAME)
    frames["t_ns"] = np.arange(count)
    frames["can_id"] = random.choice([0x180, 0x280, 0x380, 0x480], count) + random.integers(1, 16, count)
    frames["length"] = 8
    words = random.integers(0, 65536, (count, 4), dtype=np.uint16)
    special = random.choice(_SPECIAL, (count, 4))
    frames["data"] = np.where(random.random((count, 4)) < 0.2, special, words).astype("<u2").view(np.uint8)
    return frames


def different_values(count: int, seed: int = 20240917) -> tuple[int, int]:
    """(values compared, values that differ) for ``count`` frames. Equal: after rounding to the signal's resolution."""
    database: Any = cantools.database.load_file(DBC)
    compared = different = 0
    for start in range(0, count, _BLOCK):
        frames = random_frames(min(_BLOCK, count - start), seed + start)
        for (node_id, name), samples in Decoder().decode(frames).items():
            message = database.get_message_by_name(f"TIP{node_id:02d}_{name}")
            decoded = [message.decode(data.tobytes()) for data in frames["data"][samples.row]]
            if set(decoded[0]) != set(samples.columns):
                raise SystemExit(f"{name}: signals {sorted(samples.columns)}, cantools has {sorted(decoded[0])}")
            for signal in samples.message.signals:
                theirs = _column([values[signal.name] for values in decoded], signal.scale)
                compared += len(theirs)
                different += _differ(samples.columns[signal.name], theirs)
    return compared, different


def _column(values: list[Any], scale: float) -> npt.NDArray[np.float64]:
    digits = max(-math.floor(math.log10(scale)), 0)
    return np.array(
        [
            math.nan if isinstance(value, str) or str(value) == "unknown" else round(float(value), digits)
            for value in values
        ]
    )


def _differ(ours: Column, theirs: npt.NDArray[np.float64]) -> int:
    equal = (ours == theirs) | (np.isnan(ours.astype(np.float64)) & np.isnan(theirs))
    return int(np.count_nonzero(~equal))


if __name__ == "__main__":
    found = different_values(1_000_000)
    print(f"{found[0]} values compared, {found[1]} differ")
    raise SystemExit(int(found[1] > 0))
