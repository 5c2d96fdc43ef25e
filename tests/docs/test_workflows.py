"""The GitHub workflows: their form, and that the commands and files in them exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from tipforce_tools.cli.main import COMMANDS, command_parser

ROOT = Path(__file__).parents[2]
OURS = ROOT / ".github" / "workflows" / "ci.yml"
THEIRS = ROOT / "docs" / "examples" / "vcan-ci.yml"


def check_command(words: list[str]) -> None:
    """SystemExit or AssertionError for a `tipforce` command that does not exist or does not take these words."""
    if words[0] == "--completion":
        assert words[1:] in (["bash"], ["zsh"], ["fish"])
        return
    assert words[0] in COMMANDS, words
    command_parser(words[0]).parse_args(words[1:])


def steps_of(path: Path) -> list[dict[str, Any]]:
    yaml = pytest.importorskip("yaml")  # of the extra `docs`
    [job] = yaml.safe_load(path.read_text())["jobs"].values()
    return list(job["steps"])


def calls(path: Path, program: str) -> list[list[str]]:
    """The words behind ``program`` wherever a line of a ``run`` calls it, up to what ends a command."""
    lines = [line for step in steps_of(path) for line in step.get("run", "").splitlines()]
    commands = [shlex.split(part) for line in lines for part in re.split(r"&&|\|\||[;|&>]", line)]
    return [words[1:] for words in commands if words[:1] == [program]]


@pytest.mark.parametrize("path", [OURS, THEIRS], ids=lambda path: path.name)
def test_the_form_is_that_of_a_workflow(path: Path) -> None:
    assert "permissions:\n  contents: read\n" in path.read_text()
    for step in steps_of(path):
        assert ("uses" in step) != ("run" in step), step
    used = re.findall(r"uses: (.*)", path.read_text())
    assert all(re.fullmatch(r"actions/[a-z-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action) for action in used)
    assert [action.split("@")[0] for action in used[:2]] == ["actions/checkout", "actions/setup-python"]


def test_our_own_runs_what_make_has() -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    called = calls(OURS, "make")
    assert called == [["demo"], ["test"], ["oldest"], ["newest"], ["wheel"]]
    assert all(words[0] in targets for words in called)
    assert re.findall(r'"(3\.\d+)"', OURS.read_text()) == ["3.11", "3.13"]
    assert 'requires-python = ">=3.11"' in (ROOT / "pyproject.toml").read_text()


def test_yours_calls_commands_that_exist() -> None:
    commands = calls(THEIRS, "tipforce")
    assert [words[0] for words in commands] == ["node", "scan", "nmt", "decode"]
    for words in commands:
        check_command(words)
    assert (THEIRS.parent / calls(THEIRS, "python")[-1][-1]).is_file()
    for words in (["frobnicate"], ["nmt", "start", "--nowhere", "5"]):
        with pytest.raises((AssertionError, SystemExit)):
            check_command(words)
