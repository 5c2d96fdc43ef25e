"""Run the cases in a tree, and compare what they wrote with what they wrote in another one."""

from __future__ import annotations

import difflib
import hashlib
import re
import shutil
import sys
import time
import tomllib
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatch
from itertools import groupby
from pathlib import Path
from typing import Any

from bench.nets.cases import CASES
from bench.nets.files import make_files
from bench.nets.trees import BUILD, ROOT, Tree, run_lines

HERE = Path(__file__).parent
ACCEPTED = HERE / "accepted.toml"
_SLOW = ("report", "rows", "bus-conf", "log-", "scene")
_IN_REAL_TIME = (
    (rb'("t_s": |"counter": |"age_s": |"seconds": )[\d.e-]+', rb"\1N"),
    (rb"(fingers up in |samples in |sent in |since |STALE |last )[\d.]+ (s|ms)\b", rb"\1T s"),
    (rb"\(\d{10}\.\d{6}\)|(?<=resolution_us).*\d us|(?<=resolution_us).*", rb"T"),
    (rb"\d+ rows; SYNC period .*", rb"ROWS"),
    (rb"(-  +)\d+ ms|(0x2121:00  counter +|\"name\": \"counter\", \"value\": )\d+", rb"\1\2N"),
    (rb"(missing|delayed|late|repeated) \d+", rb"\1 N"),
    (rb"(linear |drift )[-+\d.]+", rb"\1N"),
    (rb"(CRC-32 |crc32\D+)0x[\dA-F]{8}|\d{4}-\d\d-\d\d", rb"\1X"),
)
"""Of the cases bus-*."""
DRAWN = rb"(?<=-\d)-[0-9a-f]{12}(?=[.\"])"
_VOLATILE = (
    (DRAWN, rb"-ID"),
    (rb"(?<=[#\"])[hmp][0-9a-f]{10}(?=[\")])", rb"ID"),  # of a clip path, hatch or marker of matplotlib
    (rb"(PASS|FAIL) in [\d.]+ s", rb"\1 in T s"),
    (rb"(SYNCs and \d+ frames, in )[\d.]+ s", rb"\1T s"),
    (rb'("run_time_s": |"seconds": |"wall_s": )[\d.e-]+', rb"\1T"),
    (rb"(samples in |frames in |saved in )[\d.]+ s", rb"\1T s"),
    (re.escape(bytes(BUILD)) + rb"/(out|trees)/\w+/", rb"TREE/"),
    (re.escape(bytes(ROOT)) + rb"/(?!build)", rb"TREE/"),
    (rb"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d+)?(Z|\+00:00)?", rb"DATE"),
)


def inputs(ref: str) -> Path:
    """The folder of logs and files made by a commit, made where it is missing."""
    digest = _digest(HERE / "logs.py", HERE / "files.py", HERE / "made.txt", *sorted((HERE / "user").iterdir()))
    tree = Tree.of(ref)
    folder = BUILD / "in" / f"{tree.name}-{digest}"
    if not folder.exists():
        making = folder.with_suffix(".new")
        shutil.rmtree(making, ignore_errors=True)
        make_files(tree, making)
        shutil.copy(next(tree.folder.rglob("cia402.eds")), making / "drive.eds")
        making.rename(folder)
    return folder


def run_cases(tree: Tree, given: Path, jobs: int, pattern: str, again: bool) -> Path:
    """Run the cases whose names match; return the folder of outputs. Only those that changed, unless ``again``."""
    base = BUILD / "out" / tree.name

    def run(name: str) -> None:
        key = _key(name, given)
        done = base / f"{name}.key"
        if again or not done.exists() or done.read_text() != key:
            done.unlink(missing_ok=True)
            start_s = time.monotonic()
            run_lines(tree, CASES[name], base / name, given)
            print(f"{tree.name}: {name}: {time.monotonic() - start_s:.1f} s", file=sys.stderr)
            done.write_text(key)

    names = chosen(pattern)
    names.sort(key=lambda name: not name.startswith(_SLOW))
    base.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(run, names))
    return base


def chosen(patterns: str) -> list[str]:
    """The cases whose names match one of the patterns, which commas separate."""
    return sorted(name for name in CASES if any(fnmatch(name, pattern) for pattern in patterns.split(",")))


def _key(name: str, given: Path) -> str:
    """What the outputs of a case depend on, besides the product."""
    adapter = _digest(HERE / "adapter.py", HERE / "sequences.py") if "@" in CASES[name] else ""
    files = given.name if "in/" in CASES[name] or "@api" in CASES[name] else ""
    return hashlib.sha256(f"{CASES[name]}{files}{adapter}".encode()).hexdigest()


def differences(before: Path, after: Path, pattern: str) -> dict[str, list[str]]:
    """By file: the lines that differ, in a case whose name matches."""
    found = {}
    for name in chosen(pattern):
        files = [_files(base, name) for base in (before, after)]
        for file in sorted({*files[0], *files[1]}):
            lines = [_lines(of_tree.get(file)) for of_tree in files]
            if lines[0] != lines[1]:
                found[file] = _differing(*lines)
    return found


def _files(base: Path, name: str) -> dict[str, Path]:
    """The files of a case by name; the identifiers that a dataset draws are left out of the names."""
    paths = (path for path in (base / name).rglob("*") if path.is_file() and path.suffix != ".pyc")
    return {re.sub(DRAWN.decode(), "-ID", path.relative_to(base).as_posix()): path for path in paths}


def _differing(before: list[str], after: list[str]) -> list[str]:
    """The lines of a difference; of long files those that differ in place, which is cheap."""
    if max(len(before), len(after)) < 5000:
        diff = difflib.unified_diff(before, after, "", "", "", "", 0, "")
        return [line for line in diff if not line.startswith(("---", "+++", "@@"))]
    pairs = [(a, b) for a, b in zip(before, after, strict=False) if a != b]
    tail = [f"{len(before)} lines, then {len(after)}"] if len(before) != len(after) else []
    return [line for a, b in pairs[:1000] for line in (f"-{a}", f"+{b}")] + tail


def _lines(path: Path | None) -> list[str]:
    """What a file says, without what no two runs have in common."""
    if path is None:
        return ["no such file"]
    if path.suffix == ".parquet":
        return _parquet(path)
    if path.suffix == ".mcap":
        return _mcap(path)
    data = path.read_bytes()
    if path.suffix in (".png", ".npy"):
        return [hashlib.sha256(data).hexdigest()]
    timed = "bus-" in str(path)
    for volatile, instead in (*_VOLATILE, *(_IN_REAL_TIME if timed else ())):
        data = re.sub(volatile, instead, data)
    lines = data.decode("utf-8", "backslashreplace").split("\n")
    return [line for line, _ in groupby(lines)] if timed else lines


def _parquet(path: Path) -> list[str]:
    """Schema, row groups, and every value; the bytes as a line of its own."""
    import pyarrow.parquet

    file: Any = pyarrow.parquet.ParquetFile(path)
    table = file.read()
    groups = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
    head = [f"bytes {_digest(path)}", f"row groups {groups}"]
    columns = [
        f"{name} {hashlib.sha256(repr(table[name].to_pylist()).encode()).hexdigest()}" for name in table.column_names
    ]
    rows = [repr(row) for row in table.slice(0, 3000).to_pylist()]
    return [*head, *table.schema.to_string().split("\n"), *columns, *rows]


def _mcap(path: Path) -> list[str]:
    """Every message: topic, type, times, digest; the bytes as a line of its own."""
    from mcap.reader import make_reader

    found = [f"bytes {_digest(path)}"]
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            digest = hashlib.sha256(message.data).hexdigest()[:16]
            times = message.log_time, message.publish_time
            found.append(f"{channel.topic} {schema.name if schema else ''} {times} {digest}")
    return found


def check(before: Path, after: Path, pattern: str, retry: Callable[[str], object]) -> int:
    """Print the differences that are not accepted; return the number of files. Cases in real time are run again."""
    entries = tomllib.loads(ACCEPTED.read_text()).get("accepted", [])
    found = differences(before, after, pattern)
    timed = {
        file.split("/")[0] for file in found if not _accepted(file, found[file], entries) and file.startswith("bus-")
    }
    for name in sorted(timed):
        retry(name)
        found = {file: lines for file, lines in found.items() if not file.startswith(f"{name}/")}
        found |= differences(before, after, name)
    wrong = {file: lines for file, lines in sorted(found.items()) if not _accepted(file, lines, entries)}
    for file, lines in wrong.items():
        print(f"\n=== {file}: {len(lines)} lines differ", *(line[:300] for line in lines[:12]), sep="\n")
    for entry in entries if pattern == "*" else ():
        if not entry.get("used"):
            print(f"accepted, but there is no such difference: {entry}")
    print(f"{len(wrong)} files differ, {len(found) - len(wrong)} differ as accepted")
    return len(wrong)


def _accepted(file: str, lines: Iterable[str], entries: list[dict[str, Any]]) -> bool:
    """Whether each line that differs is accepted by an entry for this file."""
    for line in lines:
        matching = [
            entry for entry in entries if fnmatch(file, entry["file"]) and re.search(entry.get("line", ""), line)
        ]
        if not matching:
            return False
        for entry in matching:
            entry["used"] = True
    return True


def _digest(*paths: Path) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()[:12]
