"""What the benchmarks share: the machine, ways that take turns, costs of commands, tables and pages."""

import argparse
import os
import platform
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

from tipforce_lab.report import study

ROOT = Path(__file__).parents[1]
TIPFORCE = (sys.executable, "-m", "tipforce_tools.cli.main")
Result = TypeVar("Result")


def machine(*packages: str) -> str:
    """Processor, cores, versions, load at the start: what the figures depend on."""
    name = study.machine()["processor"].rpartition(",")[0]
    versions = [f"Python {platform.python_version()}", *(f"{package} {version(package)}" for package in packages)]
    load = f"load {os.getloadavg()[0]:.1f} at the start"
    return f"{name}, {os.cpu_count()} cores, {load}; {platform.system()}; {', '.join(versions)}"


def in_turns(ways: Mapping[str, Callable[[], Result]], rounds: int) -> dict[str, list[Result]]:
    """Results of each way, one a round. The ways take turns, so that a busy spell of the machine meets all alike."""
    figures: dict[str, list[Result]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, way in ways.items():
            figures[name].append(way())
    return figures


def cpu_us(work: Callable[[], int]) -> float:
    """Microseconds of the processor's time per unit; ``work`` returns its units. Other work does not count."""
    started_ns = time.process_time_ns()
    units = work()
    return (time.process_time_ns() - started_ns) / 1000 / units


def cpu_s(work: Callable[[], object]) -> float:
    """Seconds of the processor's time of one call."""
    started_s = time.process_time()
    work()
    return time.process_time() - started_s


@contextmanager
def background(work: Callable[[threading.Event], object]) -> Iterator[None]:
    """A thread runs ``work(stop)`` while the block runs; at its end ``stop`` is set, and the thread awaited."""
    stop = threading.Event()
    thread = threading.Thread(target=work, args=(stop,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


class Meter:
    """The processor's time of a process, this one or a running child, and the clock's, since the meter was made."""

    def __init__(self, pid: int | None = None) -> None:
        self._pid = pid
        self._start_s = self._cpu_s(), time.monotonic()

    def _cpu_s(self) -> float:
        if self._pid is None:
            return time.process_time()
        fields = Path(f"/proc/{self._pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # proc(5): utime and stime

    @property
    def cpu_s(self) -> float:
        """Seconds of the processor."""
        return self._cpu_s() - self._start_s[0]

    @property
    def elapsed_s(self) -> float:
        """Seconds by the clock."""
        return time.monotonic() - self._start_s[1]

    @property
    def share(self) -> float:
        """Of a core."""
        return self.cpu_s / self.elapsed_s


def command_s(words: Sequence[object], **options: Any) -> tuple[float, float]:
    """(processor time of a command with all its processes, time by the clock); ``options`` of subprocess.run."""
    before, started_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([str(word) for word in words], check=True, **options)
    wall_s, after = time.perf_counter() - started_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall_s


def peak_mb(words: Sequence[object], **options: Any) -> float:
    """The most memory that a command and its processes had at one time, sampled; ``options`` of subprocess.Popen."""
    return max(sum(map(_own_kb, pids)) for pids in _running(words, **options)) * 1024 / 1e6


def longest_worker_s(words: Sequence[object]) -> float:
    """The processor time of that process started by a command that takes most, sampled."""
    return max(max(map(_own_s, pids[1:]), default=0.0) for pids in _running(words))


def _running(words: Sequence[object], **options: Any) -> Iterator[list[int]]:
    """Run a command; yield its processes fifty times a second, itself first."""
    with subprocess.Popen([str(word) for word in words], stdout=subprocess.DEVNULL, **options) as process:
        while process.poll() is None:
            yield _descendants(process.pid)
            time.sleep(0.02)
    if process.returncode:
        raise SystemExit(f"{' '.join(map(str, words))} ended with {process.returncode}")


def _descendants(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(descendant for child in children for descendant in _descendants(int(child)))]


def _own_s(pid: int) -> float:
    try:
        user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    except OSError:
        return 0.0
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def _own_kb(pid: int) -> int:
    """Proportional set size (proc(5)): what processes share counts once."""
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in text.splitlines() if line.startswith("Pss:"))


def resident_bytes() -> int:
    """Resident memory of this process; 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return 0


def table(header: Sequence[str], rows: Iterable[Sequence[str]], markdown: bool = True) -> str:
    """A table as Markdown or as aligned text."""
    rows = [list(row) for row in rows]
    if markdown:
        lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
        return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])
    widths = [max(len(row[k]) for row in [list(header), *rows]) for k in range(len(header))]
    return "\n".join(
        "  ".join(f"{text:>{width}}" for text, width in zip(row, widths, strict=True)) for row in [header, *rows]
    )


def arguments(description: str | None, *flags: str) -> argparse.ArgumentParser:
    """A parser with these flags that are on or off."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    for flag in flags:
        parser.add_argument(flag, action="store_true")
    return parser


def in_processes(task: Callable[[int], Result], seeds: Iterable[int], jobs: int) -> list[Result]:
    """Return what a task gives for each seed, by so many processes."""
    if jobs <= 1:
        return [task(seed) for seed in seeds]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(task, seeds, chunksize=8))


def write_page(name: str, text: str) -> None:
    """Write build/bench/NAME.md and print it. docs/performance.md has the figures that a reader needs."""
    (ROOT / "build" / "bench").mkdir(parents=True, exist_ok=True)
    (ROOT / "build" / "bench" / f"{name}.md").write_text(text, encoding="utf-8")
    print(text, end="")
