"""What somebody meets who has just installed it: no bus, a wrong file, a narrow terminal, a pipe that closes."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from tipforce.errors import InputError
from tipforce.host.configuration.calibration import write_calibration
from tipforce.scene import beam_calibration
from tipforce.watching.watcher import Finger
from tipforce_tools.cli import common
from tipforce_tools.cli.main import main
from tipforce_tools.view.sources import is_scene, scene_source
from tools.rig import Printed

SCENE = """\
duration_s = 0.2
sync_hz = 100

[[nodes]]
ids = [5, 6]
pdos = ["gauges", "contact"]
layout = "II"

[[loads]]
kind = "static"
P_N = 2.0
phi_deg = -90
theta_deg = 80
"""
EXPECTS = SCENE + "\n[[expect]]\nfrom_s = 0.1\nto_s = 0.2\nP_error_N = 0.1\n"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(EXPECTS)
    return path


@pytest.fixture
def log(scene: Path, tmp_path: Path) -> Path:
    path = tmp_path / "run.log"
    assert main(["run", str(scene), "-q", "--json", "-o", str(path)]) == 0
    return path


def test_no_row_says_why(log: Path, tmp_path: Path, printed: Printed) -> None:
    (tmp_path / "empty.log").write_text("")
    out, err = printed(1, ["decode", str(tmp_path / "empty.log")])
    assert not out
    assert "empty.log: no frames in it; is it a log?" in err
    out, err = printed(0, ["decode", str(log), "--nodes", "77"])
    assert not out
    assert err.startswith("no sample of a fingertip in ")
    assert err.endswith(" frames; --nodes may exclude it\n")


def test_filters_behind_a_log_hold_for_it(log: Path, tmp_path: Path, printed: Printed) -> None:
    lines = printed(0, ["dump", f"{log},285:7FF", "-n", "3"]).out.splitlines()
    assert [line.split()[1] for line in lines] == ["285"] * 3
    assert "is a directory" in printed(2, ["dump", str(tmp_path)]).err


def test_log_ends_after_seconds(tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / "v.log"
    out, _ = printed(0, ["log", "-i", "virtual", "-c", "first_use", "-o", str(path), "--seconds", "0.05", "--json"])
    assert json.loads(out)["frames"] == 0
    assert json.loads(out)["seconds"] >= 0.05


@pytest.mark.parametrize("command", ["log -o {}.log --seconds 0.3", "dump -n 3", "monitor --once 0.3"])
def test_sync_is_sent_while_a_command_listens(command: str, tmp_path: Path, printed: Printed) -> None:
    """On a bus where no other device sends it; each also receives what it sends."""
    words = [*command.format(tmp_path / "v").split(), "-i", "virtual", "-c", f"sync {command}"]
    out = printed(0, [*words, "--sync", "100"]).out
    if command.startswith("log"):
        out = (tmp_path / "v.log").read_text()
        assert out.count(" 080#\n") > 10
    assert "080" in out or float(out.partition("SYNC ")[2].split()[0]) > 50


@pytest.mark.parametrize("command", ["dump", "monitor", "view"])
def test_sync_needs_a_bus(command: str, log: Path, printed: Printed) -> None:
    assert "is no bus to listen to" in printed(2, [command, str(log), "--sync", "100"]).err


def test_a_run_that_was_too_short_to_judge_does_not_pass(scene: Path, printed: Printed) -> None:
    last = printed(0, ["run", str(scene), "-q", "--duration", "0.05"]).out.splitlines()[-1]
    assert last == "NOT JUDGED: 0 of 2 expectations hold, 0 do not, 2 not judged (the run was too short)"
    assert printed(0, ["run", str(scene), "-q"]).out.splitlines()[-1] == "PASS: 2 of 2 expectations hold, 0 do not"


def test_a_scene_is_viewed_as_the_log_that_it_writes(scene: Path, tmp_path: Path) -> None:
    assert is_scene(scene)
    hand = tmp_path / "hand.toml"
    hand.write_text("[hand]\n[[finger]]\nnode_id = 1\n")
    assert not is_scene(hand)
    assert not is_scene(tmp_path / "no.toml")
    source = scene_source(scene, Finger)
    assert source.title == "scene.toml"
    assert [(finger.node_id, finger.layout) for finger in source.model.fingers] == [(5, "II"), (6, "II")]
    assert source.model.counters.rows == 20
    assert list(tmp_path.glob("*.log")) == []
    silent = tmp_path / "silent.toml"
    silent.write_text(SCENE.replace('"gauges", "contact"', ""))
    with pytest.raises(InputError, match=r"silent\.toml: no PDO of a fingertip"):
        scene_source(silent, Finger)


def test_gauges_of_a_decoded_log_are_measurements(log: Path, tmp_path: Path, printed: Printed) -> None:
    calibration, gauges, both = (str(tmp_path / name) for name in ("cal.toml", "gauges.csv", "both.csv"))
    write_calibration(calibration, beam_calibration("II"))
    assert main(["decode", str(log), "--nodes", "5", "--signals", "SG1,SG2,SG3", "-q", "-o", gauges]) == 0
    rows = [json.loads(line) for line in printed(0, ["estimate", calibration, gauges, "--json", "-q"]).out.splitlines()]
    assert len(rows) == 20
    assert all(abs(row["P_N"] - 2.0) < 0.01 and row["status"] == "ok" for row in rows)
    assert main(["decode", str(log), "--nodes", "5", "-q", "-o", both]) == 0
    assert "SG1_ue beside P_N: this is a decoded log" in printed(2, ["estimate", calibration, both]).err


def test_a_number_is_never_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    for width in (200, 40, 10):
        stream = io.StringIO()
        monkeypatch.setattr(common, "console", lambda w=width, s=stream: Console(file=s, width=w))
        table = Table(title="t")
        for name in ("first value", "second value", "third value"):
            table.add_column(name, justify="right")
        table.add_column("words")
        table.add_row("-179.961", "1234.567", "+0.003", "some words that may wrap anywhere")
        common.print_table(table)
        told = stream.getvalue()
        assert all(number in told for number in ("-179.961", "1234.567", "+0.003")), told
        assert ("\u2502" in told) == (width == 200)


@pytest.mark.parametrize(
    "words", ["run scenes/grasp.toml --explain", "design table 1", "design table fig9 --repeats 2"]
)
def test_no_word_of_a_table_is_cut_in_eighty_columns(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is too long for its column goes on in the next line: a key is there to be copied."""
    stream = io.StringIO()
    monkeypatch.setattr(common, "console", lambda *_, **__: Console(file=stream, width=80))
    monkeypatch.chdir(Path(__file__).parents[2])
    assert main(words.split()) == 0
    told = stream.getvalue()
    assert max(map(len, told.splitlines())) <= 80
    assert "\u2026" not in told
    if words.startswith("run"):
        assert "noise.one_over_f_microstrain" in re.sub(r"\s+", "", told)
