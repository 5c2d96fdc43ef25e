"""Completion in each shell, and docs/commands.md: every command, action, flag and value."""

import argparse
import os
import pty
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from bench.documents import PATH, page

from tipforce_tools.cli.completion import SHELLS, root_parser, script
from tipforce_tools.cli.main import COMMANDS, EXIT_CODES, EXIT_TEXTS, all_parsers
from tools.rig import Printed


def lines(parser: argparse.ArgumentParser, path: str = "tipforce") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Each command line with its parser, before those of its commands or actions."""
    yield path, parser
    for name, below in choices(parser).items():
        yield from lines(below, f"{path} {name}")


def choices(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands or actions of a parser; none where flags and values follow."""
    return next((dict(a.choices) for a in parser._actions if isinstance(a, argparse._SubParsersAction)), {})


ALL = dict(lines(root_parser("bash", all_parsers())))
LINES = {path: list(choices(parser)) for path, parser in ALL.items()}
PARSERS = {path: parser for path, parser in ALL.items() if not choices(parser)}
SCRIPTS = {shell: script(shell, all_parsers()) for shell in SHELLS}
WAIT_S = 60.0
DRIVER = """
while IFS= read -r typed; do
    COMP_LINE=$typed COMP_POINT=${#typed}
    _tipforce
    echo "${COMPREPLY[*]}"
done
"""


def flags(parser: argparse.ArgumentParser) -> list[str]:
    return [
        name for action in parser._actions if action.help != argparse.SUPPRESS for name in action.option_strings
    ]  # fmt: skip


def bash(tmp_path: Path, *typed: str) -> list[list[str]]:
    """What bash completes after each of these beginnings of a command line."""
    path = tmp_path / "tipforce.bash"
    path.write_text(SCRIPTS["bash"] + DRIVER)
    words = ["bash", "--norc", "--noprofile", str(path)]
    done = subprocess.run(
        words, input="\n".join(typed) + "\n", capture_output=True, text=True, check=False, cwd=tmp_path, timeout=WAIT_S
    )
    assert done.returncode == 0
    # A script has no readline, whose options shtab sets.
    assert [line for line in done.stderr.splitlines() if "compopt" not in line] == []
    return [line.split() for line in done.stdout.splitlines()]


def test_bash_completes_every_command_action_and_flag(tmp_path: Path) -> None:
    found = bash(tmp_path, *(f"{path} {'' if actions else '-'}" for path, actions in LINES.items()))
    for (path, actions), completed in zip(LINES.items(), found, strict=True):
        assert completed == (actions or flags(PARSERS[path])), path


def test_bash_completes_every_choice(tmp_path: Path) -> None:
    """For each flag with choices, in each of its spellings; and for the first positional word."""
    typed, expected = [], []
    for path, parser in PARSERS.items():
        positionals = [action for action in parser._actions if not action.option_strings]
        for action in parser._actions:
            if action.choices is not None and action.help != argparse.SUPPRESS:
                names = action.option_strings or ([""] if action is positionals[0] else [])
                typed += [f"{path} {name} " if name else f"{path} " for name in names]
                expected += [[str(choice) for choice in action.choices]] * len(names)
    assert len(typed) > 50
    assert bash(tmp_path, *typed) == expected


COMPLETIONS = [
    ("tipforce ca", "calibrate"), ("tipforce sdo ", "read write dump"),
    ("tipforce sdo -i virtual -c x --fd re", "read"),
    ("tipforce sdo read 5 calibration.gen", "calibration.generation"),
    ("tipforce sdo write 5 heartbeat.prod", "heartbeat.producer_ms"), ("tipforce dump --color=al", "always"),
    ("tipforce dump --color al", "always"), ("tipforce dump --color=never --deco", "--decode"),
    ("tipforce dump -i soc", "socketcan socketcand"), ("tipforce export ", "eds dbc dcf xdd ros2 c mjcf"),
    ("tipforce calibrate fit --drift ", "none tare linear"), ("tipforce node --node-id 1", "1 10 11 12 13 14 15"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        *COMPLETIONS, ("tipforce sdo read 5 heartbeat.consumer:", "1 2 3 4"), ("tipforce export eds ", ""),
        ("tipforce node --layout I", "I II III"), ("tipforce scan --wait ", ""),
        ("tipforce nothing -", "-h --help -V --version --help-bus --completion"),
        ("tipforce -", "-h --help -V --version --help-bus --completion"), ("tipforce --completion ", "bash zsh fish"),
    ],
)  # fmt: skip
def test_bash_completes(tmp_path: Path, typed: str, completed: str) -> None:
    assert bash(tmp_path, typed) == [completed.split()]


@pytest.mark.parametrize(
    "typed",
    [
        "config apply 5 r", "estimate r", "calibrate budget r", "dump r", "replay r", "monitor r", "plot r",
        "plot run.log r", "calibrate fit r", "calibrate apply r", "log -o r", "plot x.log -o r", "node --store r",
        "plot x --calibration r", "vcan -- python",
    ],
)  # fmt: skip
def test_bash_completes_files_and_programs(tmp_path: Path, typed: str) -> None:
    (tmp_path / "run.log").touch()
    assert ("python3" if typed.startswith("vcan") else "run.log") in bash(tmp_path, f"tipforce {typed}")[0]


def test_no_script_starts_python() -> None:
    for shell, text in SCRIPTS.items():
        code = [line for line in text.splitlines() if "complete " not in line and "[" not in line]
        assert not any(word in line for line in code for word in ("python ", "$(tipforce", "(tipforce ")), shell


class Zsh:
    """An interactive zsh on a terminal of its own, in which the script is a completion function."""

    def __init__(self, folder: Path) -> None:
        (folder / "_tipforce").write_text(SCRIPTS["zsh"])
        environment = {"PATH": os.environ["PATH"], "HOME": str(folder), "TERM": "dumb"}
        self._terminal, theirs = pty.openpty()
        self._process = subprocess.Popen(
            ["zsh", "-f", "-i", "+o", "PROMPT_SP"], stdin=theirs, stdout=theirs, stderr=theirs, cwd=folder,
            env=environment, start_new_session=True,
        )  # fmt: skip
        os.close(theirs)
        setup = "stty cols 200; PS1=; fpath=($PWD $fpath); autoload -U compinit; compinit -u -D; bindkey '^I' "
        self.type(setup + "complete-word; print RE''ADY\n", "READY")

    def type(self, keys: str, wanted: str) -> str:
        """Send keys, and wait until the terminal shows ``wanted``; what it has shown."""
        os.write(self._terminal, keys.encode())
        shown, deadline_s = "", time.monotonic() + WAIT_S
        while wanted not in shown:
            readable, _, _ = select.select([self._terminal], [], [], max(deadline_s - time.monotonic(), 0.0))
            assert readable, f"{keys!r}: {wanted!r} is not in {shown!r}"
            shown += os.read(self._terminal, 4096).decode(errors="replace")
        return shown

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._terminal)


@pytest.mark.skipif(shutil.which("zsh") is None, reason="no zsh here")
def test_zsh_completes(tmp_path: Path) -> None:
    """Typed words, the TAB key, and what the terminal shows then."""
    (tmp_path / "run.log").touch()
    zsh = Zsh(tmp_path)
    try:
        for typed, shown in (
            ("ca", "calibrate"), ("calibrate ", "compare a calibration file"), ("dump --color=al", "always"),
            ("dump --color al", "always"), ("sdo read 5 calibration.gen", "generation"), ("plot r", "run.log"),
            ("sdo read 5 heartbeat.consumer:", "heartbeat.consumer:4"), ("plot x.log r", "run.log"),
            ("plot x.log -o r", "run.log"), ("node --layout II", "III"), ("calibrate fit --dr", "--drift"),
            ("vcan findm", "findmnt"),
        ):  # fmt: skip
            found = zsh.type(f"tipforce {typed}\t", shown)
            assert "_arguments" not in found, found
            zsh.type("\x15print DO''NE\n", "DONE")
    finally:
        zsh.close()


@pytest.mark.skipif(shutil.which("fish") is None, reason="no fish here")
def test_fish_completes(tmp_path: Path) -> None:
    (tmp_path / "tipforce.fish").write_text(SCRIPTS["fish"])
    (tmp_path / "run.log").touch()
    lines = [
        ("tipforce ", " ".join(COMMANDS)), ("tipforce calibrate ", "apply budget fit guide verify"),
        ("tipforce plot x.log -o r", "run.log"), ("tipforce plot x.log r", "run.log"),
        ("tipforce sdo read 5 heartbeat.consumer:", " ".join(f"heartbeat.consumer:{k}" for k in range(1, 5))),
        ("tipforce node --layout II", "II III"), *COMPLETIONS,
    ]  # fmt: skip
    code = "; ".join(["source tipforce.fish", *(f"complete -C '{typed}'; echo" for typed, _ in lines)])
    done = subprocess.run(
        ["fish", "--no-config", "-c", code], capture_output=True, text=True, check=False, timeout=WAIT_S, cwd=tmp_path,
        env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    found = [part.split("\n") for part in done.stdout.split("\n\n")]
    for (typed, wanted), completed in zip(lines, found, strict=False):
        words = {line.partition("\t")[0].rpartition("=")[2] for line in completed if line}
        assert words == set(wanted.split()), typed
    assert len(found) == len(lines) + 1


@pytest.mark.parametrize("shell", SHELLS)
def test_the_command_prints_it(shell: str, printed: Printed) -> None:
    assert printed(0, f"--completion {shell}") == printed(0, f"--completion={shell}") == (SCRIPTS[shell], "")


def test_the_page_is_fresh() -> None:
    assert PATH.read_text() == page(), "docs/commands.md is stale: run `make generate`"


def test_every_command_and_flag_is_on_it() -> None:
    text = PATH.read_text()
    for path, parser in PARSERS.items():
        assert f"\n## {path}\n" in text
        for action in parser._actions:
            assert all(f"`{name}`" in text for name in action.option_strings if name not in ("-h", "--help")), path


def test_every_exit_code_has_a_meaning() -> None:
    assert set(EXIT_CODES.values()) <= set(EXIT_TEXTS)
