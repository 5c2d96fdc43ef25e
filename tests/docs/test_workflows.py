"""The GitHub workflows: their form, and that the commands and files in them exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs.workflow import commands, read_workflow
from tipforce_tools.cli.main import COMMANDS, command_parser

ROOT = Path(__file__).parents[2]
OURS = ROOT / ".github" / "workflows" / "ci.yml"
THEIRS = ROOT / "docs" / "examples" / "vcan-ci.yml"
both = pytest.mark.parametrize("path", [OURS, THEIRS], ids=lambda path: path.name)


def check_command(words: list[str]) -> None:
    """SystemExit or AssertionError for a `tipforce` command that does not exist or does not take these words."""
    if words[0] == "--completion":
        assert words[1:] in (["bash"], ["zsh"], ["fish"])
        return
    assert words[0] in COMMANDS, words
    command_parser(words[0]).parse_args(words[1:])


@both
def test_the_form_is_that_of_a_workflow(path: Path) -> None:
    workflow = read_workflow(path)
    assert {"name", "on", "jobs"} <= set(workflow.keys)
    assert workflow.jobs
    assert "permissions:\n  contents: read\n" in path.read_text()
    for step in workflow.steps:
        assert ("uses" in step.keys) != ("run" in step.keys), step
        if "uses" in step.keys:
            assert re.fullmatch(r"actions/[a-z-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", step.keys["uses"])
        else:
            assert step.lines
    assert [step.keys.get("uses", "").split("@")[0] for step in workflow.steps[:2]] == [
        "actions/checkout",
        "actions/setup-python",
    ]


def test_a_yaml_parser_sees_the_same() -> None:
    yaml = pytest.importorskip("yaml")  # not in the extra `dev`: where it is installed anyway
    for path in (OURS, THEIRS):
        [job] = yaml.safe_load(path.read_text())["jobs"].values()
        runs = [step["run"].split("\n") for step in job["steps"] if "run" in step]
        expected = [[line.strip() for line in lines if line.strip()] for lines in runs]
        assert expected == [step.lines for step in read_workflow(path).steps if step.lines]


def test_our_own_runs_what_make_has() -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    called = commands(read_workflow(OURS), "make")
    assert called == [["demo"], ["test"], ["oldest"], ["newest"], ["wheel"]]
    assert all(words[0] in targets for words in called)
    versions = re.findall(r'"(3\.\d+)"', OURS.read_text())
    assert versions == ["3.11", "3.13"]
    assert 'requires-python = ">=3.11"' in (ROOT / "pyproject.toml").read_text()


def test_yours_calls_commands_that_exist() -> None:
    calls = commands(read_workflow(THEIRS), "tipforce")
    assert [words[0] for words in calls] == ["node", "scan", "nmt", "decode"]
    for words in calls:
        check_command(words)
    [words] = commands(read_workflow(THEIRS), "python")[-1:]
    assert (THEIRS.parent / words[-1]).is_file()


def test_a_command_that_does_not_exist_is_found() -> None:
    for words in (["frobnicate"], ["nmt", "start", "--nowhere", "5"]):
        with pytest.raises((AssertionError, SystemExit)):
            check_command(words)


def test_a_file_that_is_no_workflow_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.yml"
    for text in ("jobs:\n\ttest:\n", "jobs:\n   odd:\n", "jobs:\n  test\n"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"bad\.yml:2"):
            read_workflow(path)
