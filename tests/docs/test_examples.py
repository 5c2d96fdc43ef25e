"""Every documented example runs and prints what its page shows; every command line parses, or runs where it can.

Shell blocks without output: each line that needs no hardware and takes seconds is run as pasted."""

import contextlib
import gzip
import io
import os
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from docs.page_setups import SETUPS, beam_record, pdos
from docs.runner import Terminal, check_command, command_lines, examples, run_page, shell_lines
from tipforce.host.configuration.calibration import write_calibration
from tools.rig import in_namespace

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted(path for folder in (".", "docs", "dbc", "eds") for path in (ROOT / folder).glob("*.md"))
every_document = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))


@every_document
def test_documented_examples_run(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with SETUPS.get(path.name, lambda: contextlib.nullcontext({}))() as names:
        report = io.StringIO()
        with contextlib.redirect_stdout(report):
            result = run_page(path, names)
    assert result.failed == 0, report.getvalue()
    assert result.attempted > 0 or not re.search(r"^(>>> |```console)", path.read_text(), re.MULTILINE)


@every_document
def test_documented_commands_parse(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for line in command_lines(path):
        words = shlex.split(line.split(" > ")[0].split(")")[0])
        try:
            check_command(words[1:])
        except (AssertionError, SystemExit) as error:
            pytest.fail(f"{path.name}: {line}: {error!r}")


@every_document
def test_no_example_is_outside_a_block_or_expects_a_checksum_of_computed_numbers(path: Path) -> None:
    """It turns over with the last bit of one of them, and those differ between versions of numpy."""
    inside = sum(example.source.count("\n") > 0 for example in examples(path) if "shell(" not in example.source)
    text = path.read_text()
    outside = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    assert ">>> " not in outside
    assert inside or ">>> " not in text
    assert re.findall(r"CRC-32:? 0x[0-9A-Fa-f]{8}", text) == []


def test_a_wrong_output_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "page.md"
    page.write_text(
        '```text title="a.txt"\nalpha\n```\n<!-- test: k = 2 -->\n```pycon\n>>> k + 1\n3\n\n```\n'
        "```console\n$ cat a.txt\nalpha\n$ tipforce frobnicate\ntipforce: 'frobnicate' is not a command; ...\n"
        "$ echo $?\n2\n$ cat a.txt\nbeta\n```\n"
    )
    assert len(examples(page)) == 7
    report = io.StringIO()
    with contextlib.redirect_stdout(report):
        result = run_page(page, {})
    assert (result.failed, result.attempted) == (1, 7)
    assert "line 17" in report.getvalue()
    assert "beta" in report.getvalue()


PIPED = "candump -L can0 | tipforce "
"""candump is a script here that prints run.log."""
NEEDS = {
    "a bus": r"\bv?can0\b|^tipforce (vcan|firmware|ros2|nmt)\b|tipforce node\b",
    "a browser": r"^tipforce (view|demo --view)\b",
    "many seconds": r"^python -m bench|^tipforce report|^tipforce design table all -o|^make\b|--cost\b|--speed 1\b",
    "a package of others": r"^duckdb|^python -c .import polars|^ros2 |^pip install",
    "root, or the home of the user": r"^(install|mkdir|systemctl|journalctl) |/etc/|~/|fpath",
    "a key": r"program\.key",
}
"""Why a line is not run here. tests/vcan and tests/docs/test_python_page.py run some of them."""


def is_run(line: str) -> bool:
    return line.startswith(PIPED) or not any(re.search(pattern, line) for pattern in NEEDS.values())


PAGES = {
    page.name: lines
    for page in sorted((ROOT / "docs").glob("*.md"))
    if page.name != "ci.md" and (lines := list(filter(is_run, shell_lines(page.read_text(encoding="utf-8")))))
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the pages name: 13 s of nodes 1 and 5 with gauges and contact, calibrations, EDS files."""
    folder = tmp_path_factory.mktemp("recorded")
    lines = []
    for k in range(260):
        t = 1_700_000_000 + k / 20
        lines.append(f"({t:.6f}) can0 080#")
        for node in (1, 5):
            gauges = -1250 + k % 7, 7287 - k % 5, 3236 + k % 3
            lines += pdos(t + 0.0002, node, k, 3, gauges=gauges, contact=(4400 + k % 9, 9000, 4500))
    text = "\n".join(lines) + "\n"
    (folder / "logs").mkdir()
    for name in ("run.log", "thumb.log"):
        (folder / name).write_text(text)
    for number, part in enumerate((lines[:600], lines[600:])):
        (folder / "logs" / f"run-{number}.log.gz").write_bytes(gzip.compress("\n".join([*part, ""]).encode()))
    for name in ("finger.toml", "thumb.toml"):
        write_calibration(folder / name, beam_record(1e-6, serial=5))
    rows = np.round(np.random.default_rng(1).normal((-125.0, 728.7, 323.6), 0.5, (20, 3)), 2)
    (folder / "readings.csv").write_text("SG1,SG2,SG3\n" + "\n".join(",".join(map(str, row)) for row in rows.tolist()))
    for name in ("drive.eds", "io.eds"):
        shutil.copy(ROOT / "node" / "canopen_device" / "machine" / "cia402.eds", folder / name)
    (folder / "bin").mkdir()
    (folder / "bin" / "candump").write_text("#!/bin/sh\ncat run.log\n")
    (folder / "bin" / "candump").chmod(0o755)
    return folder


@pytest.mark.parametrize("name", PAGES)
def test_lines_without_a_bus(
    name: str, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(recorded, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    terminal = Terminal()
    for line in PAGES[name]:
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        terminal(line)
        out, _ = capsys.readouterr()
        assert terminal.code == 0, f"{line}\n{out}"
        written = {path for path in tmp_path.rglob("*") if before.get(path) != path.stat().st_mtime_ns}
        for named in re.findall(r" -o (\S+)", line):
            assert any(path.is_relative_to(tmp_path / named) for path in written), line
        assert out or written or line.startswith("source "), line


def test_documents_their_set_ups_and_each_kind_of_line_are_found() -> None:
    names = {path.name for path in DOCUMENTS}
    assert names >= {"README.md", "protocol.md", "objects.md"}
    assert names >= set(SETUPS)
    pages = {"calibration.md", "decode.md", "firmware.md", "mechanics.md", "ros2.md", "scenes.md", "simulate.md"}
    assert set(PAGES) >= pages
    assert len(PAGES["decode.md"]) == 6
    assert sum(map(len, PAGES.values())) >= 18


def test_the_bus_over_udp_is_pasted(tmp_path: Path) -> None:
    """With the route that the page names, in a network namespace with loopback only."""
    page = (ROOT / "docs" / "ci.md").read_text(encoding="utf-8")
    block = page[page.index("## A bus without kernel CAN") :].split("```sh\n")[1].split("```")[0]
    route = re.search(r"`sudo (ip link set lo up) && sudo (ip route add [^`]*)`", page)
    assert route is not None
    pasted = "\n".join([*route.groups(), block, "tipforce sdo read 5 simulation.P", "kill %1", "wait"])
    done = in_namespace(pasted, cwd=tmp_path)
    assert done.stdout.splitlines()[-1:] == ["4.4"], done.stderr
