"""The programs of docs/python.md, its recipes for other packages and the example tests run as a user runs them."""

import importlib.util
import itertools
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import tipforce
from api.test_public_names import LOG
from tipforce_tools.cli.main import main

DOCS = Path(__file__).parents[2] / "docs"
BLOCKS = re.findall(r"^```python\n(.*?)^```", (DOCS / "python.md").read_text(encoding="utf-8"), re.M | re.S)
DATA_FRAMES = {
    match[1]: block for block in BLOCKS if (match := re.match(r"import (pandas|polars)\n", block)) is not None
}
PROGRAMS = [block for block in BLOCKS if "import tipforce\n" in block]
LOAD = (4.4, 90.0, 45.0)


@pytest.fixture
def finger(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[tipforce.SimulatedBus]:
    """A finger on a bus called can0, and an empty folder to work in."""
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    monkeypatch.chdir(tmp_path)
    with tipforce.simulated_finger(5, load=LOAD, interface="virtual", channel="can0") as bus:
        yield bus


def run(number: int) -> dict[str, object]:
    names: dict[str, object] = {}
    exec(compile(PROGRAMS[number - 1], f"program {number}", "exec"), names)
    return names


def test_there_are_five_of_at_most_twelve_lines() -> None:
    assert len(PROGRAMS) == 5
    for program in PROGRAMS:
        assert len([line for line in program.splitlines() if line.strip()]) <= 12


@pytest.mark.usefixtures("finger")
def test_read_one_finger(capsys: pytest.CaptureFixture[str]) -> None:
    run(1)
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"4\.[34]\d N, standard uncertainty 0\.0\d\d N", lines[0])
    assert lines[2:] == ["all values are known", "serial number 1005"]


def test_calibrate_from_a_matrix(finger: tipforce.SimulatedBus, capsys: pytest.CaptureFixture[str]) -> None:
    run(2)
    written = tipforce.Calibration.read("finger.toml")
    active = finger.finger(5).calibration()
    assert active is not None
    assert active.record() == written.record()
    assert re.match(r"4\.[345]\d+ N, phi (89|90)\.\d+ deg, theta 4[45]\.", capsys.readouterr().out)


@pytest.mark.usefixtures("finger")
def test_decode_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    Path("run.log").write_text(LOG, encoding="utf-8")
    run(3)
    five, six = "finger 5: 2 samples, 1 lost, peak 4.40 N", "finger 6: 2 samples, 0 lost, peak 2.00 N"
    assert capsys.readouterr().out.splitlines() == [five, "in contact: 1.0", six, "in contact: 0.5"]


def test_a_test_of_ones_own() -> None:
    test = run(4)["test_the_thumb_is_pressed"]
    assert callable(test)
    test()


def test_asyncio(finger: tipforce.SimulatedBus) -> None:
    """The program runs until the finger falls silent."""
    shown: list[object] = []

    def show(contact: tipforce.Contact) -> None:
        shown.append(contact)
        if len(shown) == 5:
            finger.inject_fault(5, "silent")

    names: dict[str, object] = {"print": show}
    with pytest.raises(tipforce.NoNewSampleError, match="finger 5: no new sample"):
        exec(compile(PROGRAMS[4], "program 5", "exec"), names)
    contacts = [one for one in shown if isinstance(one, tipforce.Contact)]
    assert all(contact.ok for contact in contacts[:5])
    assert all(a.counter != b.counter for a, b in itertools.pairwise(contacts))


def test_a_recipe_for_each_package() -> None:
    assert list(DATA_FRAMES) == ["pandas", "polars"]
    for name, code in DATA_FRAMES.items():
        compile(code, f"python.md, {name}", "exec")


@pytest.mark.parametrize("name", DATA_FRAMES)
def test_decoded_with(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if importlib.util.find_spec(name) is None:
        pytest.skip(f"{name} is not installed: its three lines were compiled, not run")
    monkeypatch.chdir(tmp_path)
    Path("run.log").write_text(LOG)
    assert main(["decode", "run.log", "-q", "-o", "run.parquet"]) == 0
    space: dict[str, Any] = {}
    exec(DATA_FRAMES[name], space)
    assert space["result"] == [{"node": 5, "P_N": 4.4, "known": 2}, {"node": 6, "P_N": 2.0, "known": 1}]


@pytest.mark.parametrize("name", ["test_hand.py", "test_master.py"])
def test_an_example_test_runs_where_a_user_copies_it(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text((DOCS / "examples" / name).read_text())
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "CAN_"))}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", name],
        cwd=tmp_path, env=plain, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout
