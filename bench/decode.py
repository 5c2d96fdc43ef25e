"""Decoding logs: ours beside cantools, python-can, asammdf and a floor in C, on the same logs in one run.

`python -m bench.decode` writes build/bench/decode-performance.md. asammdf has an environment of its own, for python-can
imports it where it is: `--asammdf` makes build/bench-venv (once). `--check`: every value of a million frames against
cantools."""

import json
import math
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from bench.decode_methods import DBC
from bench.measure import ROOT, TIPFORCE, arguments, command_s, in_turns, machine, peak_mb, table, write_page

from tipforce.host.decoding.decoder import Decoder
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.recorder import CandumpWriter

ASAMMDF_PYTHON = ROOT / "build" / "bench-venv" / "bin" / "python"
FLOOR = Path(__file__).with_name("decode_floor.c")
NODES = 15
FAST = ("floor", "memory")
SLOW = ("LogReader", "cantools loop", "cantools decode")
COMMANDS = {"tipforce decode to CSV": "csv", "tipforce decode to Parquet": "parquet", "tipforce decode to MCAP": "mcap",
            "tipforce decode --summary": None}  # fmt: skip
AIMS = {"tipforce decode to CSV": 15, "tipforce decode to Parquet": 60, "tipforce decode --summary": 60}  # x cantools
SAME_SUMS = {"floor", "memory", "asammdf"}
TOLERANCE = 1e-9
FRAMES, SLOW_FRAMES, ROUNDS = 1_000_000, 200_000, 5
CHANNEL = "can0"
START_US = 1_700_000_000_000_000
CYCLE_US = 2000
_CHUNK = 200_000
_SPECIAL = np.array([-32768, 32767, -32767, 0], dtype=np.int16)
_SPECIAL_WORDS = np.array([0x8000, 0x8001, 0x7FFF, 0, 0xFFFF], dtype=np.uint16)
_HEAD = """\
# Decoding logs: speed and memory

Written by `python -m bench.decode`. The log has a million frames: TPDO1 and TPDO2 of 15 nodes at each SYNC, the SYNC,
and a foreign frame of 0 to 8 bytes. The methods take turns, each run is a process of its own, and the time is the
processor's, of the work alone, without start-up; slow methods get the first 200 000 frames. Floor:
`bench/decode_floor.c`, the same work in one pass of C. Memory: candump text to columns in memory. asammdf decodes an
MF4, without text to parse. LogReader: python-can's reader alone. cantools loop: cantools on each line. cantools decode:
the command, less its start-up. tipforce decode: the command with all its processes."""
Runs = dict[str, list[dict[str, float]]]  # by method: what each of its runs measured


def hand_traffic(count: int, nodes: int, seed: int) -> FrameArray:
    """``count`` frames: the SYNC, TPDO1 and TPDO2 of ``nodes``, and a foreign frame of 0 to 8 bytes, in each cycle.

    One value in twenty is unknown or at a limit."""
    random = np.random.default_rng(seed)
    ids = [base + node for node in range(1, nodes + 1) for base in (0x180, 0x280)]
    cycle = np.array([0x080, *ids, 0x5C0], dtype=np.uint32)
    frames: FrameArray = np.zeros(count, dtype=FRAME)
    number = np.arange(count)
    frames["can_id"] = cycle[number % len(cycle)]
    step_us = CYCLE_US // (len(cycle) + 1)
    frames["t_ns"] = (START_US + number // len(cycle) * CYCLE_US + number % len(cycle) * step_us) * 1000
    values = random.integers(-32767, 32768, (count, 3), dtype=np.int16)
    special = random.random((count, 3)) < 0.05
    values[special] = random.choice(_SPECIAL, int(special.sum()))
    data = frames["data"]
    data[:, :6] = values.view(np.uint8)
    data[:, 6] = random.choice(np.array([3, 2, 0, 11, 0x83], dtype=np.uint8), count)
    data[:, 7] = number // len(cycle) % 256
    frames["length"] = np.where(frames["can_id"] == 0x080, 0, 8)
    foreign = frames["can_id"] == 0x5C0
    frames["length"][foreign] = random.integers(0, 9, int(foreign.sum()))
    data *= np.arange(8) < frames["length"][:, None]
    return frames


def write_log(path: Path, frames: FrameArray) -> None:
    """The frames as candump -L writes them."""
    writer = CandumpWriter(path)
    for start in range(0, len(frames), _CHUNK):
        writer.write(CandumpBlock(frames[start : start + _CHUNK], (CHANNEL,)))
    writer.close()


def random_frames(count: int, seed: int) -> FrameArray:
    """Random data on all four messages of nodes 1-15; one value in five is unknown or at a limit."""
    random = np.random.default_rng(seed)
    frames: FrameArray = np.zeros(count, dtype=FRAME)
    frames["t_ns"] = np.arange(count)
    frames["can_id"] = random.choice([0x180, 0x280, 0x380, 0x480], count) + random.integers(1, 16, count)
    frames["length"] = 8
    words = random.integers(0, 65536, (count, 4), dtype=np.uint16)
    special = random.choice(_SPECIAL_WORDS, (count, 4))
    frames["data"] = np.where(random.random((count, 4)) < 0.2, special, words).astype("<u2").view(np.uint8)
    return frames


def different_values(count: int) -> tuple[int, int]:
    """(values compared with cantools, values that differ). Equal: after rounding to the signal's resolution."""
    database: Any = cantools.database.load_file(DBC)
    compared = different = 0
    for start in range(0, count, _CHUNK):
        frames = random_frames(min(_CHUNK, count - start), 20240917 + start)
        for (node_id, name), samples in Decoder().decode(frames).items():
            message = database.get_message_by_name(f"TIP{node_id:02d}_{name}")
            decoded = [message.decode(data.tobytes()) for data in frames["data"][samples.row]]
            if set(decoded[0]) != set(samples.columns):
                raise SystemExit(f"{name}: signals {sorted(samples.columns)}, cantools has {sorted(decoded[0])}")
            for signal in samples.message.signals:
                digits = max(-math.floor(math.log10(signal.scale)), 0)
                values = [value[signal.name] for value in decoded]
                theirs = [math.nan if str(value) == "unknown" else round(float(value), digits) for value in values]
                ours = samples.columns[signal.name].astype(np.float64)
                compared += len(theirs)
                different += int(np.count_nonzero(~np.isclose(ours, theirs, rtol=0.0, atol=0.0, equal_nan=True)))
    return compared, different


class Logs:
    """The log of a run: whole, its first part for the slow, and as MF4; and the runs on it."""

    def __init__(self, folder: Path, mf4: bool) -> None:
        self.folder, self.mf4 = folder, mf4
        subprocess.run(["gcc", "-O3", "-march=native", "-o", str(folder / "floor"), str(FLOOR)], check=True)
        self._write("warm_up", hand_traffic(50, 5, 0))
        traffic = hand_traffic(FRAMES, NODES, 1000 + NODES)
        self._write("all", traffic)
        write_log(self.folder / "part.log", traffic[:SLOW_FRAMES])

    def _write(self, name: str, traffic: FrameArray) -> None:
        write_log(self.folder / f"{name}.log", traffic)
        if self.mf4:
            array = self.folder / f"{name}.npy"
            np.save(array, traffic)
            words = ["-W", "ignore", "-m", "bench.decode_methods", "mf4", array, array.with_suffix(".mf4")]
            command_s([ASAMMDF_PYTHON, *words], cwd=ROOT)

    def run(self, method: str) -> dict[str, float]:
        """Run a method on its log: what it found, with ``us`` of the processor per frame."""
        frames = SLOW_FRAMES if method in SLOW else FRAMES
        log = self.folder / ("part.log" if method in SLOW else "all.log")
        if method == "floor":
            output = subprocess.run([self.folder / "floor", log], check=True, capture_output=True, text=True).stdout
            _, decoded, _, total, cpu_s = map(float, output.split())
            result = {"decoded": decoded, "sum": total, "cpu_s": cpu_s}
        elif method == "cantools decode":
            start, whole = (self._cantools_s(path) for path in (self.folder / "warm_up.log", log))
            result = {"cpu_s": whole[0] - start[0], "wall_s": whole[1] - start[1]}
        elif method in COMMANDS:
            out = self.folder / f"out.{COMMANDS[method]}"
            line = decode_words(COMMANDS[method], log, out)
            result = dict(zip(("cpu_s", "wall_s"), command_s(line, stdout=subprocess.DEVNULL), strict=True))
            if out.exists():
                result["bytes"] = out.stat().st_size / frames
                out.unlink()
        else:
            suffix, python = (".mf4", ASAMMDF_PYTHON) if method == "asammdf" else (".log", sys.executable)
            paths = [log.with_suffix(suffix), self.folder / f"warm_up{suffix}"]
            words = [python, "-W", "ignore", "-m", "bench.decode_methods", method, *paths]
            result = json.loads(subprocess.run(words, check=True, capture_output=True, cwd=ROOT).stdout)
        return {**result, "us": 1e6 * result["cpu_s"] / frames, "wall_us": 1e6 * result.get("wall_s", 0.0) / frames}

    def _cantools_s(self, log: Path) -> tuple[float, float]:
        with log.open() as stdin:
            words = [sys.executable, "-m", "cantools", "decode", DBC]
            return command_s(words, stdin=stdin, stdout=subprocess.DEVNULL)

    def peaks(self, frames: int) -> list[str]:
        """Peak memory of decoding ``frames`` frames by each command."""
        log = self.folder / "long.log"
        write_log(self.folder / "part.log", hand_traffic(1_000_000, NODES, 3))
        with log.open("wb") as file:
            for _ in range(frames // 1_000_000):
                file.write((self.folder / "part.log").read_bytes())
        peaks = {name: peak_mb(decode_words(form, log, log.with_suffix(f".{form}"))) for name, form in COMMANDS.items()}
        return [f"- {name}: {peak:.0f} MB" for name, peak in peaks.items()]


def decode_words(form: str | None, log: Path, out: Path) -> list[str | Path]:
    """The command that decodes a log, to ``out`` or to a summary."""
    words: list[str | Path] = ["--json", "--summary"] if form is None else ["-o", out]
    return [*TIPFORCE, "decode", "-q", log, *words]


def make_asammdf_environment() -> None:
    """An environment for asammdf alone, made once."""
    if not ASAMMDF_PYTHON.exists():
        subprocess.run([sys.executable, "-m", "venv", str(ASAMMDF_PYTHON.parents[1])], check=True)
    installed = subprocess.run([ASAMMDF_PYTHON, "-c", "import asammdf"], capture_output=True, check=False)
    if installed.returncode:
        subprocess.run([ASAMMDF_PYTHON, "-m", "pip", "install", "-q", "asammdf"], check=True)


def measure(logs: Logs, methods: Sequence[str]) -> Runs:
    """All methods on one log, in turns."""
    runs = in_turns({method: partial(logs.run, method) for method in methods}, ROUNDS)
    _check_sums({method: results[0] for method, results in runs.items()})
    return runs


def _check_sums(results: dict[str, dict[str, float]]) -> None:
    """Methods that decoded the same frames must have the same values."""
    first, *others = [(method, result) for method, result in results.items() if method in SAME_SUMS]
    for method, result in others:
        same = math.isclose(result["sum"], first[1]["sum"], rel_tol=TOLERANCE, abs_tol=1e-6)
        if result["decoded"] != first[1]["decoded"] or not same:
            raise SystemExit(f"{method}: {result}, {first[0]}: {first[1]}")


def _median(runs: Runs, method: str) -> float:
    return statistics.median(result["us"] for result in runs[method])


def page_table(runs: Runs) -> str:
    """The table of all methods, and aims beside what was measured."""
    rows = []
    for method, results in runs.items():
        us = _median(runs, method)
        spread = max(abs(result["us"] - us) for result in results) / us
        whole = " (whole process)" if method in (*COMMANDS, "cantools decode") else ""
        rows.append([method + whole, f"{us:.3f} +- {100 * spread:.0f} %", f"{us / _median(runs, 'memory'):.2f}"])
    lines = [f"- {name}: {of[0]['bytes']:.0f} bytes a frame" for name, of in runs.items() if "bytes" in of[0]]
    for name, aim in AIMS.items():
        times = _median(runs, "cantools decode") / _median(runs, name)
        missed = "" if times >= aim else " (missed)"
        lines.append(f"- {name}, whole process, times cantools decode: aim {aim:g}, measured {times:.2f}{missed}")
    header = ["method", "CPU us a frame", "ours is faster by"]
    return table(header, rows) + "\n\n" + "\n".join(lines)


def main() -> int:
    args = arguments(__doc__, "--asammdf", "--check").parse_args()
    if args.check:
        compared, different = different_values(FRAMES)
        print(f"{compared} values compared, {different} differ")
        return int(different > 0)
    if args.asammdf:
        make_asammdf_environment()
    mf4 = ASAMMDF_PYTHON.exists()
    methods = (*FAST, *(["asammdf"] if mf4 else []), *COMMANDS, *SLOW)
    with tempfile.TemporaryDirectory() as name:
        logs = Logs(Path(name), mf4)
        measured, peaks = page_table(measure(logs, methods)), "\n".join(logs.peaks(10_000_000))
    on = f"{machine('numpy', 'cantools', 'python-can', 'pyarrow')}. +- is the largest deviation from the median."
    parts = (_HEAD, on, measured, "## Memory, 10 million frames", peaks)
    write_page("decode-performance", "\n\n".join(parts) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
