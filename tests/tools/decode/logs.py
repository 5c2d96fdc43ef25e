"""Logs of fingers for the tests of `tipforce decode`: seeded, with losses, unknown values, rare messages; datasets."""

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from tipforce.host.dataset.reader import opened
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump_format import CandumpFormat
from tipforce_tools.cli.main import main

START_US = 1_700_000_000_000_000


def log_lines(
    samples: int = 300, nodes: tuple[int, ...] = (1, 5), *, seed: int = 1, loss: float = 0.02, health: int = 0,
    bus: str = "vcan0",
) -> list[str]:  # fmt: skip
    """Lines of candump -L: gauges and contact of each node at 1 kHz, some frames lost, some values unknown."""
    random = np.random.default_rng(seed)
    lines = []
    for sample in range(samples):
        t_us = START_US + 1000 * sample
        lines.append(f"({t_us // 1_000_000}.{t_us % 1_000_000:06d}) {bus} 080#")
        frames = [(base + node, node) for base in (0x180, 0x280) for node in nodes]
        if health and sample % health == health - 1:
            frames += [(0x480 + node, node) for node in nodes]
        for position, (identifier, node) in enumerate(frames):
            words = random.integers(-3000, 3000, 3).astype("<i2")
            words[random.random(3) < 0.05] = -32768
            data = words.tobytes() + bytes([0x03 | (0x08 if random.random() < 0.02 else 0), (sample + node) & 0xFF])
            if identifier > 0x480:
                data = words.tobytes() + bytes([(sample + node) & 0xFF, 0])
            if random.random() >= loss:
                u_us = t_us + 50 * (position + 1)
                text = data.hex().upper()
                lines.append(f"({u_us // 1_000_000}.{u_us % 1_000_000:06d}) {bus} {identifier:03X}#{text}")
    return lines


def write_log(path: Path, lines: list[str]) -> Path:
    path.write_text("".join(line + "\n" for line in lines))
    return path


def write_frames(path: Path, frames: FrameArray) -> Path:
    return write_log(path, CandumpFormat(log=True).lines(CandumpBlock(frames, ("can0",))))


def decode(*words: object) -> int:
    return main(["decode", "-q", *map(str, words)])


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(path.read_text())))


def number(text: str) -> float | None:
    """A cell; None where it is empty."""
    return float(text) if text else None


def rows_of_dataset(directory: Path) -> list[tuple[Any, ...]]:
    """All rows by the manifest, without missing values, in the order of node and time."""
    store, manifest = opened(str(directory))
    tables = [(file.node, pq.ParquetFile(store.path(file.path)).read()) for file in manifest.files()]
    return sorted(_cells(row | {"node": node}) for node, table in tables for row in table.to_pylist())


def _cells(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(sorted((k, str(v)) for k, v in row.items() if v is not None))


def rows_of_logs(*names: Path) -> list[tuple[Any, ...]]:
    path = names[0].with_suffix(".one.parquet")
    assert decode(*names, "-j", 1, "-o", path) == 0
    return sorted(_cells({"channel": "vcan0"} | row) for row in pq.read_table(path).to_pylist())


def globbed(directory: Path) -> set[str]:
    """The Parquet files that a query engine finds."""
    return {str(path.relative_to(directory)) for path in directory.glob("rows/**/*") if path.is_file()}
