"""`tipforce completion`: each shell knows every command, action, flag and choice, and its script runs."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from tipforce_tools.cli.main import COMMANDS, main
from tipforce_tools.completion import command, model

LINES = {" ".join(line.path): line for line in model.command_lines()}
SCRIPTS = {shell: command.script(shell, tuple(LINES.values())) for shell in command.SHELLS}
DRIVER = """
while IFS= read -r typed; do
    COMP_LINE=$typed COMP_POINT=${#typed}
    _tipforce
    echo "${COMPREPLY[*]}"
done
"""


def bash(tmp_path: Path, *typed: str) -> list[list[str]]:
    """What bash offers after each of these beginnings of a command line."""
    script = tmp_path / "tipforce.bash"
    script.write_text(SCRIPTS["bash"] + DRIVER)
    words = ["bash", "--norc", "--noprofile", str(script)]
    done = subprocess.run(
        words, input="\n".join(typed) + "\n", capture_output=True, text=True, check=False, cwd=tmp_path, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
    return [line.split() for line in done.stdout.splitlines()]


def test_the_model_has_every_command_and_action() -> None:
    assert {line.path[0] for line in LINES.values()} == set(COMMANDS)
    assert {path for path in LINES if path.startswith("calibrate ")} == {
        f"calibrate {action}" for action in LINES["calibrate"].actions
    }


def test_bash_knows_every_command(tmp_path: Path) -> None:
    ((*offered,),) = bash(tmp_path, "tipforce ")
    assert set(offered) == {*COMMANDS, "--help", "--version"}
    for name, (found,) in zip(COMMANDS, zip(bash(tmp_path, *(f"tipforce {name}" for name in COMMANDS))), strict=True):
        assert name in found


def test_bash_knows_every_flag_and_action(tmp_path: Path) -> None:
    """For each command line: its flags behind `-`, or its actions."""
    answers = bash(tmp_path, *(f"tipforce {path} {'' if line.actions else '-'}" for path, line in LINES.items()))
    for (path, line), offered in zip(LINES.items(), answers, strict=True):
        names = [name for flag in line.flags for name in flag.names]
        assert offered == ([*line.actions, "--help"] if line.actions else names), path


def test_bash_knows_every_choice(tmp_path: Path) -> None:
    """For each flag with choices, in each of its spellings; and for the first positional word."""
    typed, expected = [], []
    for path, line in LINES.items():
        for flag in line.flags:
            if flag.value is not None and flag.value.words and not flag.value.sources:
                typed += [f"tipforce {path} {name} " for name in flag.names]
                expected += [list(flag.value.words)] * len(flag.names)
        if line.positionals and line.positionals[0].words and not line.positionals[0].sources:
            typed.append(f"tipforce {path} ")
            expected.append(list(line.positionals[0].words))
    assert len(typed) > 50
    assert bash(tmp_path, *typed) == expected


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("tipforce ca", "calibrate"),
        ("tipforce sdo ", "read write dump"),
        ("tipforce sdo -i virtual -c x --fd re", "read"),
        ("tipforce sdo read 5 calibration.gen", "calibration.generation"),
        ("tipforce sdo read 5 heartbeat.consumer:", "1 2 3 4"),
        ("tipforce sdo write 5 heartbeat.prod", "heartbeat.producer_ms"),
        ("tipforce dump --color=al", "always"),
        ("tipforce dump --color al", "always"),
        ("tipforce dump -i soc", "socketcan socketcand"),
        ("tipforce export ", "eds dbc dcf c"),
        ("tipforce export eds ", ""),
        ("tipforce calibrate fit --drift ", "none tare linear"),
        ("tipforce node --layout I", "I II III"),
        ("tipforce scan --wait ", ""),
        ("tipforce nothing -", ""),
    ],
)
def test_bash_offers(tmp_path: Path, typed: str, offered: str) -> None:
    assert bash(tmp_path, typed) == [offered.split()]


@pytest.mark.parametrize(
    "typed",
    [
        "config apply 5 r", "estimate r", "budget r", "dump r", "replay r", "monitor r", "plot r", "plot run.log r",
        "calibrate fit r", "calibrate apply r", "log -o r", "plot x.log -o r", "node --store r",
        "plot x --calibration r",
    ],
)  # fmt: skip
def test_bash_offers_files(tmp_path: Path, typed: str) -> None:
    (tmp_path / "run.log").touch()
    assert "run.log" in bash(tmp_path, f"tipforce {typed}")[0]


def test_bash_offers_programs_behind_vcan(tmp_path: Path) -> None:
    assert "python3" in bash(tmp_path, "tipforce vcan -- python")[0]


def test_no_script_starts_python() -> None:
    for shell, script in SCRIPTS.items():
        code = [line for line in script.splitlines() if not line.lstrip().startswith(("#", "complete -c", "'"))]
        assert not any(word in line for line in code for word in ("python ", "$(tipforce", "(tipforce ")), shell


@pytest.mark.parametrize("shell", ["fish", "zsh"])
def test_the_other_shells_know_every_flag(shell: str) -> None:
    for path, line in LINES.items():
        for flag in () if line.actions else line.flags:
            for name in flag.names:
                long = name.startswith("--")
                wanted = f"-{'l' if long else 's'} {name.lstrip('-')} " if shell == "fish" else name
                assert wanted in SCRIPTS[shell], (path, name)


@pytest.mark.skipif(shutil.which("zsh") is None, reason="no zsh here")
def test_zsh_takes_the_script(tmp_path: Path) -> None:
    script = tmp_path / "_tipforce"
    script.write_text(SCRIPTS["zsh"])
    code = f"fpath=({tmp_path} $fpath); autoload -U compinit; compinit -u -D; autoload +X _tipforce; "
    code += "print $_comps[tipforce]"
    done = subprocess.run(["zsh", "-f", "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "_tipforce\n", "")
    assert subprocess.run(["zsh", "-n", str(script)], check=False, timeout=60).returncode == 0


@pytest.mark.skipif(shutil.which("fish") is None, reason="no fish here")
@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("tipforce ", set(COMMANDS)),
        ("tipforce calibrate ", set(LINES["calibrate"].actions)),
        ("tipforce calibrate fit --drift ", {"none", "tare", "linear"}),
        ("tipforce sdo read 5 calibration.gen", {"calibration.generation"}),
        ("tipforce dump --deco", {"--decode"}),
    ],
)
def test_fish_offers(tmp_path: Path, typed: str, offered: set[str]) -> None:
    script = tmp_path / "tipforce.fish"
    script.write_text(SCRIPTS["fish"])
    code = f"source {script}; complete -C '{typed}'"
    done = subprocess.run(
        ["fish", "--no-config", "-c", code], capture_output=True, text=True, check=False, timeout=60,
        env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert {line.partition("\t")[0] for line in done.stdout.splitlines()} == offered


@pytest.mark.parametrize("shell", command.SHELLS)
def test_the_command_prints_it(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    assert capsys.readouterr() == (SCRIPTS[shell], "")
    assert main(["completion", shell, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"shell": shell, "script": SCRIPTS[shell]}
