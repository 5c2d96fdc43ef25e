"""Costs of the working tree as ratios to a baseline: interleaved pairs, processor time, median and spread."""

from __future__ import annotations

import resource
import statistics
import subprocess
import sys
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

from bench.measure import peak_mb
from bench.nets.logs import write_large
from bench.nets.trees import BUILD, ROOT, Tree

_FORMS = {"parquet": ["-o", "out.parquet"], "csv": ["-o", "out.csv"], "summary": ["--summary", "--json"]}
_STARTS = {"--version": ["--version"], "scan --help": ["scan", "--help"]}
_START_RUNS = 5
Figure = Callable[[Tree], float]


def costs(decode_ref: str, collector_ref: str, pattern: str, pairs: int, quick: bool) -> int:
    """Print each figure: both medians, the ratio of the pairs (median, smallest, largest), and the peak memory."""
    folder = BUILD / "costs"
    folder.mkdir(parents=True, exist_ok=True)
    after, old, newer = Tree("tree", ROOT), Tree.of(decode_ref), Tree.of(collector_ref)
    print(f"{'figure':32}{'before':>10}{'now':>10}{'ratio':>8}   smallest to largest of {pairs} pairs")
    for name, before, figure in _figures(folder, old, newer, quick):
        if fnmatch(name, pattern):
            _print(name, _pairs(figure, before, after, pairs))
    for size, form, log in _decodes(folder, quick):
        name = f"memory {size} {form}, MB"
        if fnmatch(name, pattern):
            words = ["decode", "-q", str(log), *_FORMS[form]]
            _print(name, [(_peak(old, words, folder), _peak(after, words, folder)) for _ in range(min(pairs, 3))])
    return 0


def _decodes(folder: Path, quick: bool) -> list[tuple[str, str, Path]]:
    """(frames, form, log)."""
    found = []
    for millions, modulus in ((1, 0), (1, 240)) if quick else ((1, 0), (1, 240), (10, 0)):
        log = folder / f"{millions}M-{modulus}.log"
        if not log.exists():
            write_large(log, millions * 1_000_000, 5, modulus)
        found += [(f"{millions} M{' numbered' * (modulus > 0)}", form, log) for form in _FORMS]
    return found


def _figures(folder: Path, old: Tree, newer: Tree, quick: bool) -> list[tuple[str, Tree, Figure]]:
    """(name, baseline, figure of a tree)."""
    found: list[tuple[str, Tree, Figure]] = []
    for name, words in _STARTS.items():
        found.append((f"start-up {name}, s", old, lambda tree, w=words: spent_s(tree, w, folder, _START_RUNS)))  # type: ignore[misc]
    found.append(("start-up read_log, s", newer, lambda tree: _imported_s(tree, folder)))
    for frames in (1, 6):
        found.append((f"collector 5x{frames}, us a row", newer, lambda tree, n=frames: _collector_us(tree, n, folder)))  # type: ignore[misc]
    for size, form, log in _decodes(folder, quick):
        words = ["decode", "-q", str(log), *_FORMS[form]]
        found.append((f"decode {size} {form}, s", old, lambda tree, w=words: spent_s(tree, w, folder)))  # type: ignore[misc]
    return found


def _pairs(figure: Figure, before: Tree, after: Tree, pairs: int) -> list[tuple[float, float]]:
    """Both trees in turns; which is first changes."""
    figure(before), figure(after)  # compiles, and fills the disk's cache
    found = []
    for turn in range(pairs):
        order = (before, after) if turn % 2 else (after, before)
        values = {tree.name: figure(tree) for tree in order}
        found.append((values[before.name], values[after.name]))
    return found


def _print(name: str, pairs: list[tuple[float, float]]) -> None:
    ratios = sorted(now / before for before, now in pairs)
    medians = [statistics.median(column) for column in zip(*pairs, strict=True)]
    text = f"{name:32}{medians[0]:10.3f}{medians[1]:10.3f}{statistics.median(ratios):8.3f}"
    print(f"{text}   {ratios[0]:.3f} to {ratios[-1]:.3f}", flush=True)


def spent_s(tree: Tree, words: list[str], folder: Path, runs: int = 1) -> float:
    """Processor time of a command line with all its processes, the mean of some runs."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    for _ in range(runs):
        if tree.tipforce(words, folder).returncode:
            raise SystemExit(f"{tree.name}: tipforce {' '.join(words)} failed")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / runs


def _imported_s(tree: Tree, folder: Path) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    for _ in range(_START_RUNS):
        subprocess.run(
            [sys.executable, "-c", "from tipforce import read_log"], check=True, cwd=folder, env=tree.environment()
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / _START_RUNS


def _collector_us(tree: Tree, frames: int, folder: Path) -> float:
    done = tree.adapter(["@collector", "5", str(frames)], folder)
    if done.returncode:
        raise SystemExit(done.stderr.decode())
    return float(done.stdout)


def _peak(tree: Tree, words: list[str], folder: Path) -> float:
    return peak_mb([sys.executable, "-c", tree.code, *words], cwd=folder, env=tree.environment())
