"""`tipforce report`: selection, text, JSON, what is left out, exit codes."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tipforce_lab.report.study import Effort, Study
from tipforce_tools.cli.main import main
from tools.report import made
from tools.rig import Printed


def one_study(key: str) -> Callable[[Effort, Callable[[], None]], list[Study]]:
    def studies(_effort: Effort, advance: Callable[[], None]) -> list[Study]:
        advance()
        return [made.study(key)]

    return studies


def lacking(_effort: Effort, _advance: Callable[[], None]) -> list[Study]:
    import skfem  # noqa: F401

    return []


def failing(_effort: Effort, _advance: Callable[[], None]) -> list[Study]:
    raise ZeroDivisionError("on purpose")


@pytest.fixture
def sound(monkeypatch: pytest.MonkeyPatch) -> None:
    modules = {"alpha": made.module(one_study("alpha")), "beta": made.module(one_study("beta"))}
    made.install(monkeypatch, modules)


def records(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


@pytest.mark.usefixtures("sound")
def test_json_lines_tell_everything(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "--json", "--quick", "--date", "2026-01-31", "--seed", "5"]) == 1
    head, *rest = records(capsys)
    assert rest[-1]["record"] == "verdict"
    assert "2 of 6 claims" in rest[-1]["verdict"][0]
    assert (head["record"], head["date"], head["quick"], head["seed"]) == ("report", "2026-01-31", True, 5)
    assert {"processor", "Python", "tipforce", "numpy"} <= set(head["machine"])
    assert [one["key"] for one in rest if one["record"] == "study"] == ["alpha", "beta"]
    seen = {one["key"]: one["held"] for one in rest if one["record"] == "case"}
    assert seen == {
        "area.pass": True, "area.bounded": True, "area.flagged": True, "area.refused": True,
        "other.wrong": False, "other.broken": False,
    }  # fmt: skip


@pytest.mark.usefixtures("sound")
def test_text_names_what_did_not_hold(printed: Printed) -> None:
    out = printed(1, ["report"]).out
    assert "2 NOT AS CLAIMED (other.wrong, other.broken)" in " ".join(out.split())
    assert "ZeroDivisionError" in out
    for shown in ("Study alpha & more", "reference: what is known <exactly>; its own error is 1.0e-09", "- a remark"):
        assert shown in out


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize(
    ("only", "studies", "cases"),
    [
        ("beta", ["beta"], []),
        ("stability", [], ["area.pass", "area.bounded", "area.flagged", "area.refused", "other.wrong", "other.broken"]),
        ("beta, alpha", ["alpha", "beta"], []),
        ("area", [], ["area.pass", "area.bounded", "area.flagged", "area.refused"]),
        ("alpha,area.pass", ["alpha"], ["area.pass"]),
        ("*.b*", [], ["area.bounded", "other.broken"]),
    ],
)
def test_only_runs_what_is_named(
    capsys: pytest.CaptureFixture[str], only: str, studies: list[str], cases: list[str]
) -> None:
    main(["report", "--json", "--only", only])
    found = records(capsys)
    assert [one["key"] for one in found if one["record"] == "study"] == studies
    assert [one["key"] for one in found if one["record"] == "case"] == cases


@pytest.mark.usefixtures("sound")
@pytest.mark.parametrize("only", ["gamma", "area.nothing", "", ","])
def test_a_key_that_names_nothing_is_refused(printed: Printed, only: str) -> None:
    assert "alpha, beta, stability" in printed(2, ["report", "--only", only]).err


@pytest.mark.usefixtures("sound")
def test_list_runs_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:4]] == ["alpha", "beta", "stability", "area.pass"]
    assert main(["report", "--list", "--json"]) == 0
    assert {"key": "alpha", "kind": "study", "what": "about alpha"} in records(capsys)


def test_a_missing_package_leaves_a_study_out_and_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    monkeypatch.setitem(sys.modules, "skfem", None)
    made.install(monkeypatch, {"fem": made.module(lacking), "beta": made.module(one_study("beta"))}, with_cases=False)
    out = printed(0, ["report"]).out
    assert 'left out fem: skfem is not installed: pip install "tipforce[fem]"' in out
    assert "Study beta" in out
    assert "1 left out (fem)" in out


def test_a_study_that_fails_is_a_line_and_an_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made.install(monkeypatch, {"bad": made.module(failing), "beta": made.module(one_study("beta"))}, with_cases=False)
    assert main(["report", "--json"]) == 1
    _, lack, study, told = records(capsys)
    assert told["verdict"][-1] == "Failed: bad."
    assert (lack["record"], lack["key"], lack["failed"]) == ("left out", "bad", True)
    assert "ZeroDivisionError in failing()" in lack["reason"]
    assert study["key"] == "beta"


def test_without_matplotlib_the_page_is_refused_before_anything_runs(
    monkeypatch: pytest.MonkeyPatch, printed: Printed, tmp_path: Path
) -> None:
    made.install(monkeypatch, {"bad": made.module(failing)})
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    captured = printed(2, ["report", "-o", str(tmp_path / "out")])
    assert 'pip install "tipforce[report]"' in captured.err
    assert not captured.out
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("sound")
def test_the_page_is_written_where_it_is_asked_for(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    assert main(["report", "--only", "alpha", "-o", str(tmp_path / "a" / "b")]) == 0
    assert sorted(path.name for path in (tmp_path / "a" / "b").iterdir()) == [
        "alpha.svg", "index.html", "report.jsonl",
    ]  # fmt: skip
    assert "index.html" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["report", "--only", "alpha", "-o", str(tmp_path / "file")]) == 2
