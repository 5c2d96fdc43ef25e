"""Decoding logs: ours beside cantools, python-can, asammdf and a floor in C, on the same logs in one run.

`python -m bench.decode [--quick] [-o docs/decode-performance.md]`: methods take turns, each in a process of its own.
Times are the processor's: other work on the machine disturbs them less. Slow methods get the first part of a log.
asammdf has an environment of its own, for python-can imports it where it is: `--asammdf` makes build/bench-venv (once).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np
from bench.decode_check import different_values
from bench.decode_log import hand_traffic, write_log
from bench.decode_methods import DBC
from bench.decode_profile import profile

from tipforce.host.frames.frame_array import FrameArray

ROOT = Path(__file__).parents[1]
ASAMMDF_PYTHON = ROOT / "build" / "bench-venv" / "bin" / "python"
FLOOR = Path(__file__).with_name("decode_floor.c")
LOGS = {
    f"{nodes} nodes, {kind} dlc": (nodes, kind == "variable") for nodes in (5, 15) for kind in ("fixed", "variable")
}
FAST = ("floor", "parse", "memory")
SLOW = ("LogReader", "LogReader + cantools", "cantools loop", "cantools decode")
COMMANDS = {"tipforce decode to CSV": "csv", "tipforce decode to Parquet": "parquet", "tipforce decode --summary": None}
PACKAGES = ("numpy", "cantools", "python-can", "pyarrow")
WHOLE_PROCESS = {"cantools decode", *COMMANDS}
TOLERANCE = 1e-9
_SAMPLE_S = 0.02
_ASAMMDF_HINT = "`python -m bench.decode --asammdf -o docs/decode-performance.md` makes build/bench-venv for it."
_EXPLAINED = """\
Written by `python -m bench.decode -o docs/decode-performance.md`. Each log has a million frames: TPDO1 and TPDO2 of
5 or 15 nodes at each SYNC; with variable dlc also the SYNC and a foreign frame of 0 to 8 bytes. The methods take turns,
each run is a process of its own, and the time is the processor's, of the work alone, without start-up; slow methods
get the first 200 000 frames.

- floor: `bench/decode_floor.c`, the same work in one pass of C
- parse, memory: candump text to frames, and to columns in memory (`open_log`, `Decoder.decode`)
- asammdf: decodes the same frames from an MF4 with the DBC; there is no text to parse
- LogReader: python-can's reader, alone and with cantools decoding each message
- cantools loop: a loop over the lines with cantools decoding each
- cantools decode: the command, reading the log on stdin; its start-up is subtracted
- tipforce decode: the command with its start-up, on all cores; the table has the processor time of all its processes"""


@dataclass(slots=True)
class Runs:
    """Microseconds per frame of one method on one log, run by run, and what it found there."""

    us: list[float] = field(default_factory=list)
    results: list[dict[str, float]] = field(default_factory=list)
    wall_us: list[float] = field(default_factory=list)  # of commands

    @property
    def median(self) -> float:
        """Microseconds per frame."""
        return statistics.median(self.us)

    @property
    def spread(self) -> float:
        """The largest deviation from the median, as a share of it."""
        return max(abs(value - self.median) for value in self.us) / self.median


class Files:
    """The logs of a run: each whole, its first part for the slow, and as MF4."""

    def __init__(self, folder: Path, frames: int, slow_frames: int, mf4: bool) -> None:
        self.folder = folder
        self.frames, self.slow_frames = frames, slow_frames
        self.floor = folder / "floor"
        subprocess.run(["gcc", "-O3", "-march=native", "-o", str(self.floor), str(FLOOR)], check=True)
        self.warm_up = folder / "warm_up.log"
        write_log(self.warm_up, hand_traffic(50, 5, True, 0))
        self.warm_up_mf4 = folder / "warm_up.mf4"
        self.mf4 = mf4
        if self.mf4:
            self._write_mf4(self.warm_up_mf4, hand_traffic(50, 5, True, 0))

    def write(self, nodes: int, variable: bool) -> None:
        """Write one traffic in all its forms."""
        traffic = hand_traffic(self.frames, nodes, variable, 1000 + nodes)
        write_log(self.folder / "all.log", traffic)
        write_log(self.folder / "part.log", traffic[: self.slow_frames])
        if self.mf4:
            self._write_mf4(self.folder / "all.mf4", traffic)

    def _write_mf4(self, path: Path, traffic: FrameArray) -> None:
        array = path.with_suffix(".npy")
        np.save(array, traffic)
        subprocess.run([ASAMMDF_PYTHON, "-W", "ignore", "-m", "bench.decode_methods", "mf4", array, path],
                       check=True, cwd=ROOT)  # fmt: skip


def make_asammdf_environment() -> None:
    """An environment for asammdf alone, made once."""
    if not ASAMMDF_PYTHON.exists():
        folder = ASAMMDF_PYTHON.parents[1]
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    installed = subprocess.run([ASAMMDF_PYTHON, "-c", "import asammdf"], capture_output=True, check=False)
    if installed.returncode:
        subprocess.run([ASAMMDF_PYTHON, "-m", "pip", "install", "-q", "asammdf"], check=True)


def run(method: str, files: Files) -> tuple[int, dict[str, float]]:
    """(frames, what the method found, with ``cpu_s``)."""
    log = files.folder / ("part.log" if method in SLOW else "all.log")
    frames = files.slow_frames if method in SLOW else files.frames
    if method == "floor":
        output = subprocess.run([files.floor, log], check=True, capture_output=True, text=True).stdout.split()
        return frames, {
            "frames": int(output[0]),
            "decoded": int(output[1]),
            "sum": float(output[3]),
            "cpu_s": float(output[4]),
        }
    if method == "cantools decode":
        start = _command_s(f"{sys.executable} -m cantools decode {DBC} < {files.warm_up} > /dev/null")
        whole = _command_s(f"{sys.executable} -m cantools decode {DBC} < {log} > /dev/null")
        return frames, {"cpu_s": whole[0] - start[0], "wall_s": whole[1] - start[1]}
    if method in COMMANDS:
        out = files.folder / f"out.{COMMANDS[method] or 'json'}"
        asked = "--json --summary >" if COMMANDS[method] is None else "-o"
        cpu_s, wall_s = _command_s(f"{sys.executable} -m tipforce_tools.cli.main decode -q {log} {asked} {out}")
        found = {"cpu_s": cpu_s, "wall_s": wall_s, "megabytes": _size(out) / 1e6}
        subprocess.run(["rm", "-rf", str(out)], check=True)
        return frames, found
    warm_up = files.warm_up
    if method == "asammdf":
        log, warm_up = files.folder / "all.mf4", files.warm_up_mf4
    python = str(ASAMMDF_PYTHON) if method == "asammdf" else sys.executable
    command_line = [python, "-W", "ignore", "-m", "bench.decode_methods", method, str(log), str(warm_up)]
    output_text = subprocess.run(command_line, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    found = json.loads(output_text)
    return frames, found


def _command_s(command: str) -> tuple[float, float]:
    """(processor time of a command with all its processes, time by the clock)."""
    before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, shell=True, check=True)
    wall_s = time.perf_counter() - start_s
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall_s


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*")) if path.is_dir() else path.stat().st_size


def measure(files: Files, methods: tuple[str, ...], rounds: dict[str, int]) -> dict[str, Runs]:
    """All methods on one log, in turns."""
    found = {method: Runs() for method in methods}
    for turn in range(max(rounds[method] for method in methods)):
        for method, runs in found.items():
            if turn < rounds[method]:
                frames, result = run(method, files)
                runs.us.append(1e6 * result["cpu_s"] / frames)
                runs.results.append(result)
                if "wall_s" in result:
                    runs.wall_us.append(1e6 * result["wall_s"] / frames)
    _check_sums(found)
    return found


def _check_sums(found: dict[str, Runs]) -> None:
    """Whoever decoded the same frames must have found the same values."""
    for whole in ({"floor", "memory", "asammdf"}, {"LogReader + cantools", "cantools loop"}):
        results = {method: runs.results[0] for method, runs in found.items() if method in whole}
        reference = next(iter(results.values()))
        for method, result in results.items():
            same = abs(result["sum"] - reference["sum"]) < TOLERANCE * abs(reference["sum"]) + 1e-6
            if result["decoded"] != reference["decoded"] or not same:
                raise SystemExit(f"{method} found {result}, another method {reference}")


def peak_memory(files: Files, frames: int) -> dict[str, float]:
    """What decoding ``frames`` frames in memory found, with ``peak_mb``."""
    log = files.folder / "long.log"
    part = hand_traffic(1_000_000, 15, True, 3)
    write_log(files.folder / "part.log", part)
    text = (files.folder / "part.log").read_bytes()
    with log.open("wb") as file:
        for _ in range(frames // len(part)):
            file.write(text)
    command = [sys.executable, "-m", "bench.decode_methods", "memory", str(log), str(files.warm_up)]
    found: dict[str, float] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    for name, form in COMMANDS.items():
        out = files.folder / f"long.{form}"
        asked = ["--json", "--summary"] if form is None else ["-o", str(out)]
        found[name] = tree_peak_mb([sys.executable, "-m", "tipforce_tools.cli.main", "decode", "-q", str(log), *asked])
        out.unlink(missing_ok=True)
    log.unlink()
    return found


def tree_peak_mb(command: list[str]) -> float:
    """The most memory that a command and its processes had at one time, sampled; what they share counts once."""
    peak = 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peak = max(peak, sum(map(_own_kb, _tree(process.pid))))
            time.sleep(_SAMPLE_S)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    return peak * 1024 / 1e6


def _tree(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(one for child in children for one in _tree(int(child)))]


def _own_kb(pid: int) -> int:
    """Proportional set size (Linux, proc(5))."""
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:"))


def table(title: str, found: dict[str, Runs]) -> list[str]:
    """One log's rows of the document."""
    floor, ours = found["floor"].median, found["memory"].median
    lines = [f"## {title}", "", "| method | CPU us a frame | frames/s | of the floor | ours is faster by |"]
    lines.append("|---|---|---|---|---|")
    for method, runs in found.items():
        name = f"{method} (whole process)" if method in WHOLE_PROCESS else method
        lines.append(
            f"| {name} | {runs.median:.3f} +- {100 * runs.spread:.0f} % | {1e6 / runs.median:,.0f} | "
            f"{100 * floor / runs.median:.1f} % | {runs.median / ours:.2f} |"
        )
    lines += ["", *_aims(found)]
    return [*lines, ""]


def _aims(found: dict[str, Runs]) -> list[str]:
    """What was aimed at, what was measured."""
    floor, ours, cantools = (found[name].median for name in ("floor", "memory", "cantools decode"))
    goals = [("in memory, million frames/s a core", 5, 1 / ours), ("in memory, share of the floor", 0.5, floor / ours)]
    for name, form in COMMANDS.items():
        aim = 15 if form == "csv" else 60
        if name in found:
            goals.append((f"{name}, whole process, times cantools decode (CPU)", aim, cantools / found[name].median))
            wall = statistics.median(found["cantools decode"].wall_us) / statistics.median(found[name].wall_us)
            goals.append((f"{name}, whole process, times cantools decode (by the clock)", aim, wall))
    return [
        f"- {what}: aim {aim}, measured {value:.2f}{'' if value >= aim else ' (missed)'}" for what, aim, value in goals
    ]


def main() -> None:
    """Measure, print, and write the document if asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--slow-frames", type=int, default=200_000)
    parser.add_argument("--quick", action="store_true", help="one log, fewer turns, no million of values, no long log")
    parser.add_argument("--asammdf", action="store_true", help="also asammdf, from build/bench-venv")
    parser.add_argument("--without-command", action="store_true", help="leave out `tipforce decode`")
    parser.add_argument("-o", "--output", type=Path, help="write the tables as Markdown")
    args = parser.parse_args()
    commands = () if args.without_command else tuple(COMMANDS)
    lines = ["# Decoding logs: speed and memory", "", _EXPLAINED, "", _machine(), ""]
    with tempfile.TemporaryDirectory() as folder:
        if args.asammdf:
            make_asammdf_environment()
        else:
            lines += [f"asammdf was left out: it wants an environment of its own. {_ASAMMDF_HINT}", ""]
        files = Files(Path(folder), args.frames, args.slow_frames, args.asammdf)
        methods = (*FAST, *(("asammdf",) if files.mf4 else ()), *commands, *SLOW)
        rounds = {
            method: (3 if args.quick else 9) if method in FAST else (1 if args.quick else 3) for method in methods
        }
        for title, (nodes, variable) in list(LOGS.items())[: 1 if args.quick else None]:
            files.write(nodes, variable)
            lines += table(title, measure(files, methods, rounds))
            print("\n".join(lines[lines.index(f"## {title}") :]), flush=True)
        lines += ["## Where the time of decoding in memory goes (last log)", "", *profile(files.folder / "all.log"), ""]
        if not args.quick:
            long = peak_memory(files, 10_000_000)
            compared, different = different_values(1_000_000)
            lines += ["## Memory and equality", ""]
            lines.append(f"Peak memory of decoding {long['frames']:,.0f} frames: {long['peak_mb']:.0f} MB. "
                         f"{compared:,} values compared with cantools', {different} differ.")  # fmt: skip
            for name in COMMANDS:
                lines.append(f"Peak of {name}, all its processes, 10,000,000 frames: {long[name]:.0f} MB (aim 300).")
            print("\n".join(lines[-len(COMMANDS) - 1 :]))
    if args.output is not None:
        args.output.write_text("\n".join(lines) + "\n")


def _machine() -> str:
    model = next((line.split(":")[1].strip() for line in _cpu_info() if line.startswith("model name")), "processor")
    packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES if _installed(name))
    compiler = subprocess.run(["gcc", "-dumpfullversion"], check=True, capture_output=True, text=True).stdout.strip()
    return (
        f"{model}, {os.cpu_count()} cores, {platform.system()}, CPython {platform.python_version()}, {packages}, "
        f"gcc {compiler} -O3 -march=native. Medians of processor time; +- is the largest deviation."
    )


def _cpu_info() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text().splitlines() if path.exists() else []


def _installed(name: str) -> bool:
    return importlib.util.find_spec({"python-can": "can"}.get(name, name)) is not None


if __name__ == "__main__":
    main()
