"""Decoding with one and two workers, the serial part, and the limits of a dataset.

`python -m bench.scale [--frames 10000000] [-o docs/scale-performance.md]`: the runs of one and two workers take turns.
Processor seconds are of all processes of a run; other work on the machine disturbs them less than the clock.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from bench.decode_log import hand_traffic, write_log

from tipforce.host.dataset.manifest import FOLDER, Change, DataFile, Part, Source, commit, read_manifest
from tipforce.host.dataset.reader import tables
from tipforce.host.dataset.store import Store
from tipforce.host.decoding.decoded_part import DecodedPart
from tipforce.host.decoding.decoded_pdos import Layouts
from tipforce.host.decoding.log_part import Piece, Reading, When
from tipforce.host.decoding.recording import Recording
from tipforce.host.decoding.sample_table import Column
from tipforce.host.logs.lines import line_borders

COMMAND = [sys.executable, "-m", "tipforce_tools.cli.main", "decode", "-q"]
_CHUNK = 1_000_000
_START_NS = 1_700_006_400 * 10**9
_DAY_NS = 86_400 * 10**9


def long_log(path: Path, frames: int) -> None:
    """Five fingers at 500 Hz, a million frames at a time."""
    traffic = hand_traffic(_CHUNK, 5, True, 1)
    step_ns = int(traffic["t_ns"][-1] - traffic["t_ns"][0]) + 2_000_000
    with path.open("wb") as out:
        for _ in range(frames // _CHUNK):
            write_log(path.with_suffix(".part"), traffic)
            with path.with_suffix(".part").open("rb") as part:
                shutil.copyfileobj(part, out, 1 << 24)
            traffic["t_ns"] += step_ns
    path.with_suffix(".part").unlink()


def run(log: Path, output: str, jobs: int) -> tuple[float, float]:
    """One decode: (seconds by the clock, processor seconds of all its processes)."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.perf_counter()
    subprocess.run([*COMMAND, str(log), "-o", output, "-j", str(jobs)], check=True)
    wall = time.perf_counter() - began
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    shutil.rmtree(output) if output.endswith("/") else Path(output).unlink()
    return wall, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def workers(log: Path, rounds: int) -> list[str]:
    """One and two workers in turn."""
    lines = [
        "| output | 1 worker, CPU s | 2 workers, CPU s | CPU of 2 / CPU of 1 | by the clock: 1 / 2 |",
        "|---|---|---|---|---|",
    ]
    for name in ("run.csv", "run.parquet", "data/"):
        found: dict[int, list[tuple[float, float]]] = {1: [], 2: []}
        for _ in range(rounds):
            for jobs, times in found.items():
                times.append(run(log, f"{log.parent}/{name}", jobs))
        (wall1, cpu1), (wall2, cpu2) = (
            (statistics.median(w for w, _ in times), statistics.median(c for _, c in times)) for times in found.values()
        )
        lines.append(f"| {name} | {cpu1:.2f} | {cpu2:.2f} | {cpu2 / cpu1:.2f} | {wall1 / wall2:.2f} |")
    return lines


def serial_part(log: Path) -> list[str]:
    """Processor time of the pass in order, beside that of the workers, per part of 64 MB."""
    reading = Reading(Layouts())
    borders = line_borders(log, -(-os.path.getsize(log) // 64_000_000))
    recording = Recording(reading)
    decode_s, follow_s, state_s, frames = [], [], [], 0
    for start, end in pairwise(borders):
        began = time.process_time()
        part = DecodedPart(Piece(str(log), start, end), reading)
        decode_s.append(time.process_time() - began)
        began = time.process_time()
        follows = recording.follow(part.ends)
        follow_s.append(time.process_time() - began)
        began = time.process_time()
        msgspec.json.encode(recording.state())
        state_s.append(time.process_time() - began)
        assert follows is not None
        frames += part.ends.notes.frames
    share = statistics.median(follow_s[1:]) + statistics.median(state_s[1:])
    parts = frames / len(decode_s)
    return [
        f"A part of {parts:,.0f} frames: decoding {1e3 * statistics.median(decode_s):.0f} ms, the pass in order "
        f"{1e3 * share:.1f} ms: {100 * share / statistics.median(decode_s):.1f} % of the decoding alone. "
        f"100 million frames are {1e8 / parts:.0f} parts: {share * 1e8 / parts:.1f} s in order."
    ]


def many_parts(folder: Path, count: int) -> list[str]:
    """A manifest of many parts: its size, the time to read and to commit it."""
    store = Store(str(folder))
    column = Column("P_N", "P", "real", 3, "N", 0)
    state = Recording(Reading(Layouts())).state()
    source = Source("a" * 12, "run.log", 0, "", 0, "", "gauges 3", "0.1", None, True, 0, None, state)
    parts = [
        Part(f"{number:012d}-part", source.id, number, number + 1, 1000, {}, [
            DataFile(f"rows/hand=left/date=2026-05-17/node={node}/{_file(number)}", node, 100_000, 3_000_000,
                     f"{number:064d}", number * 10**9, (number + 1) * 10**9) for node in range(1, 6)])
        for number in range(count)
    ]  # fmt: skip
    commit(store, Change(sources={source.id: source}, parts=parts, columns=[column]))
    began = time.process_time()
    manifest = read_manifest(store)
    read_s = time.process_time() - began
    assert manifest is not None
    began = time.process_time()
    commit(store, Change())
    commit_s = time.process_time() - began
    size = max(path.stat().st_size for path in (folder / FOLDER).iterdir())
    return [
        f"A manifest of {count:,} parts with five files each: {size / 1e6:.0f} MB, read in {read_s:.2f} s, a commit "
        f"takes {commit_s:.2f} s; at 64 MB of log a part that is {count * 64e6 / 1e12:.1f} TB of logs."
    ]


def _file(number: int) -> str:
    return f"{'a' * 12}-{number:014d}-1-{'b' * 12}.parquet"


def month(folder: Path, days: int = 30, rows: int = 3600) -> None:
    """A dataset of five nodes in 24 parts a day, ``rows`` of each node a part."""
    store, parts = Store(str(folder)), []
    column = Column("P_N", "P", "real", 3, "N", 0)
    for hour in range(days * 24):
        files = []
        t_ns = _START_NS + hour * 3600 * 10**9 + np.arange(rows) * (3600 * 10**9 // rows)
        day = str(np.datetime64(int(t_ns[0]), "ns"))[:10]
        for node in range(1, 6):
            table = pa.table({
                "t_s": pa.array(t_ns // 1000, pa.timestamp("us", tz="UTC")), "channel": pa.array(["can0"] * rows),
                "counter": pa.array(np.arange(rows) + hour * rows), "P_N": pa.array(np.sin(t_ns * 1e-9)),
            })  # fmt: skip
            path = f"rows/hand=can0/date={day}/node={node}/{_file(hour)}"
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(table, folder / path)
            files.append(DataFile(path, node, rows, 0, "", int(t_ns[0]), int(t_ns[-1])))
        parts.append(Part(str(hour), "a" * 12, hour, hour + 1, 0, {}, files))
    state = Recording(Reading(Layouts())).state()
    source = Source("a" * 12, "run.log", 0, "", 0, "", "", "", None, True, 0, None, state)
    commit(store, Change(sources={source.id: source}, parts=parts, columns=[column]))


def slice_of_month(folder: Path) -> list[str]:
    """A slice of one minute of a month: 30 days of five nodes at 1 Hz."""
    month(folder)
    begin = When(_START_NS + 17 * _DAY_NS + 3_600 * 10**9, False)
    reading = Reading(Layouts(), start=begin, end=When(begin.ns + 60 * 10**9, False))
    seconds = []
    for _ in range(5):
        began = time.process_time()
        found = sum(len(table) for table in tables(str(folder), reading))
        seconds.append(time.process_time() - began)
    assert found == 5 * 60
    return [
        f"One minute of a month (30 days, {30 * 24 * 5:,} files, {30 * 24 * 5 * 3600:,} rows) is read in "
        f"{statistics.median(seconds):.3f} s."
    ]


def main() -> None:
    """Measure and print; write the page if asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--parts", type=int, default=100_000)
    parser.add_argument("-o", "--output", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "run.log"
        long_log(log, args.frames)
        lines = ["# Datasets and workers: measured", "", (__doc__ or "").split("\n\n", 1)[1].strip(), ""]
        lines += [f"{args.frames:,} frames of five fingers with SYNC and a foreign frame; {os.cpu_count()} cores, load "
                  f"{os.getloadavg()[0]:.1f} of other work at the start.", ""]  # fmt: skip
        lines += [*workers(log, args.rounds), "", *serial_part(log), ""]
        (folder / "parts").mkdir()
        lines += [*many_parts(folder / "parts", args.parts), "", *slice_of_month(folder / "month")]
    print("\n".join(lines))
    if args.output is not None:
        args.output.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
