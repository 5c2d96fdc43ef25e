"""Decoding with one and two workers, the serial part, and the limits of a dataset.

`python -m bench.scale [--frames 10000000]`: the runs of one and two workers take turns.
Processor seconds are of all processes of a run; other work on the machine disturbs them less than the clock."""

import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from bench.decode import hand_traffic, write_log
from bench.measure import TIPFORCE, arguments, command_s, cpu_s, in_turns, longest_worker_s, machine, table, write_page

from tipforce.host.dataset.manifest import Change, DataFile, Manifest, Part, Source, commit, read_manifest
from tipforce.host.dataset.reader import tables
from tipforce.host.dataset.store import FOLDER, Store
from tipforce.host.decoding.log_part import Piece, Reading, When
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.decoding.recording import DecodedPart, Passed, Recording
from tipforce.host.decoding.sample_table import Column
from tipforce.host.logs.lines import line_borders

FULL_FRAMES, ROUNDS, PARTS = 10_000_000, 3, 100_000
T = TypeVar("T")
_CHUNK = 1_000_000
_START_NS = 1_700_006_400 * 10**9
_COLUMN = Column("P_N", "P", "real", 3, "N", 0)


def long_log(path: Path, frames: int) -> None:
    """Five fingers at 500 Hz, a million frames at a time."""
    traffic = hand_traffic(_CHUNK, 5, 1)
    step_ns = int(traffic["t_ns"][-1] - traffic["t_ns"][0]) + 2_000_000
    with path.open("wb") as out:
        for _ in range(frames // _CHUNK):
            write_log(path.with_suffix(".part"), traffic)
            with path.with_suffix(".part").open("rb") as part:
                shutil.copyfileobj(part, out, 1 << 24)
            traffic["t_ns"] += step_ns
    path.with_suffix(".part").unlink()


def workers(log: Path, rounds: int) -> str:
    """One and two workers in turn."""
    rows = []
    for name in ("run.csv", "run.parquet", "data/"):

        def way(measure: Callable[[list[object]], T], jobs: int, output: str = f"{log.parent}/{name}") -> T:
            measured = measure([*TIPFORCE, "decode", "-q", log, "-o", output, "-j", jobs])
            shutil.rmtree(output) if output.endswith("/") else Path(output).unlink()
            return measured

        longer_s = way(longest_worker_s, 2)
        runs = in_turns({str(jobs): partial(way, command_s, jobs) for jobs in (1, 2)}, rounds)
        (cpu1, wall1), (cpu2, wall2) = (map(statistics.median, zip(*times, strict=True)) for times in runs.values())
        ratios = cpu2 / cpu1, longer_s / cpu1, wall2 / wall1
        rows.append([name, f"{cpu1:.2f}", f"{cpu2:.2f}", *(f"{ratio:.2f}" for ratio in ratios)])
    header = ["output", "1 worker, CPU s", "2 workers, CPU s", "2 / 1", "longer worker / 1", "2 / 1 by the clock"]
    return table(header, rows)


def serial_part(log: Path) -> str:
    """Processor time of the pass in order, beside that of the workers, per part of 64 MB."""
    reading = Reading(Layouts())
    borders = line_borders(log, -(-os.path.getsize(log) // 64_000_000))
    recording, frames = Recording(reading), 0
    seconds: dict[str, list[float]] = {"decode": [], "follow": []}

    def follow(part: DecodedPart) -> Passed:
        passed = part.follow(recording.state(), last=False)
        recording.resume(passed)
        return passed

    for start, end in pairwise(borders):
        began = time.process_time()
        part = DecodedPart(Piece(str(log), start, end), reading)
        seconds["decode"].append(time.process_time() - began)
        seconds["follow"].append(cpu_s(lambda part=part: follow(part)))  # type: ignore[misc]
        frames += part.notes.frames
    in_order_s = statistics.median(seconds["follow"][1:])
    decode_s, a_part = statistics.median(seconds["decode"]), frames / len(seconds["decode"])
    return (
        f"A part of {a_part:,.0f} frames: decoding {1e3 * decode_s:.0f} ms, the pass in order {1e3 * in_order_s:.1f} "
        f"ms: {100 * in_order_s / decode_s:.1f} % of the decoding alone. 100 million frames are {1e8 / a_part:.0f} "
        f"parts: {in_order_s * 1e8 / a_part:.1f} s in order."
    )


def _source() -> Source:
    state = Recording(Reading(Layouts())).state()
    return Source("a" * 12, "run.log", 0, "", 0, "", "gauges 3", "0.1", None, True, 0, None, state)


def many_parts(folder: Path, count: int) -> str:
    """A manifest of many parts: its size, the time to read and to commit it."""
    store = Store(str(folder))
    source = _source()
    parts = [
        Part(f"{number:012d}-part", source.id, number, number + 1, 1000, {}, [
            DataFile(f"rows/hand=left/date=2026-05-17/node={node}/{_file(number)}", node, 100_000, 3_000_000,
                     f"{number:064d}", number * 10**9, (number + 1) * 10**9) for node in range(1, 6)])
        for number in range(count)
    ]  # fmt: skip
    added = Change(sources={source.id: source}, parts=parts[1:], columns=[_COLUMN])
    all_s, read_s = cpu_s(lambda: commit(store, added)), cpu_s(lambda: read_manifest(store))
    change = Change(parts=parts[:1], known=read_manifest(store) or Manifest())
    change_s = cpu_s(lambda: commit(store, change))
    size = max(path.stat().st_size for path in (folder / FOLDER).iterdir())
    return (
        f"A manifest of {count:,} parts with five files each: {size / 1e6:.0f} MB, read in {read_s:.2f} s, written "
        f"in {all_s:.2f} s; a commit of one more takes {change_s:.3f} s; at 64 MB of log a part that is "
        f"{count * 64e6 / 1e12:.1f} TB of logs."
    )


def _file(number: int) -> str:
    return f"{'a' * 12}-{number:014d}-1-{'b' * 12}.parquet"


def month(folder: Path, days: int = 30, rows: int = 3600) -> None:
    """A dataset of five nodes in 24 parts a day, ``rows`` of each node a part."""
    store, parts, source = Store(str(folder)), [], _source()
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
    commit(store, Change(sources={source.id: source}, parts=parts, columns=[_COLUMN]))


def slice_of_month(folder: Path) -> str:
    """A slice of one minute of a month: 30 days of five nodes at 1 Hz."""
    month(folder)
    begin = When(_START_NS + (17 * 24 + 1) * 3_600 * 10**9, False)
    reading = Reading(Layouts(), start=begin, end=When(begin.ns + 60 * 10**9, False))

    def read() -> None:
        assert sum(len(part) for part in tables(str(folder), reading)) == 5 * 60

    return (
        f"One minute of a month (30 days, {30 * 24 * 5:,} files, {30 * 24 * 5 * 3600:,} rows) is read in "
        f"{statistics.median(cpu_s(read) for _ in range(5)):.3f} s."
    )


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--frames", type=int, default=FULL_FRAMES)
    args = parser.parse_args()
    parts = ["# Datasets and workers: measured", (__doc__ or "").split("\n\n", 1)[1].strip(), f"On {machine()}.",
             f"{args.frames:,} frames of five fingers with SYNC and a foreign frame."]  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        long_log(folder / "run.log", args.frames)
        (folder / "parts").mkdir()
        parts += [workers(folder / "run.log", ROUNDS), serial_part(folder / "run.log")]
        parts += [many_parts(folder / "parts", PARTS), slice_of_month(folder / "month")]
    write_page("scale-performance", "\n\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
