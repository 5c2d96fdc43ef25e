"""The five programs of docs/python.md run as they stand: short, and with public names only."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import tipforce

PAGE = Path(__file__).parents[2] / "docs" / "python.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
PROGRAMS = [block for block in BLOCKS if "import tipforce\n" in block]
LOAD = (4.4, 90.0, 45.0)
LOG = "(1700000000.000120) can0 285#2E1129239A110303\n(1700000000.001120) can0 285#3011282394110305\n"


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
    assert capsys.readouterr().out == "finger 5: 2 samples, 1 lost, peak 4.40 N\nin contact: 1.0\n"


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
