"""The bus flags: defined here, but python-can's to the letter."""

from __future__ import annotations

import argparse
import importlib.metadata
import subprocess
import sys
from pathlib import Path
from typing import Any

import can
import can.cli
import pytest
from can.interfaces import BACKENDS

from tipforce_tools.cli import bus_flags


def parsers() -> tuple[argparse.ArgumentParser, argparse.ArgumentParser]:
    ours, theirs = (argparse.ArgumentParser(prog="x") for _ in range(2))
    bus_flags.add_bus_arguments(ours)
    can.cli.add_bus_arguments(theirs)
    return ours, theirs


def described(action: argparse.Action) -> dict[str, Any]:
    """What a flag takes; the words of its help are ours."""
    return {
        "flags": list(action.option_strings),
        "dest": action.dest,
        "nargs": action.nargs,
        "const": action.const,
        "default": action.default,
        "type": action.type,
        "choices": None if action.choices is None else list(action.choices),
        "required": action.required,
    }


def test_the_flags_are_python_cans() -> None:
    ours, theirs = (
        [(group.title, [described(action) for action in group._group_actions]) for group in parser._action_groups]
        for parser in parsers()
    )
    assert ours == theirs
    assert ours[-1][0] == "bus arguments"


def test_the_built_in_interfaces_are_python_cans() -> None:
    plugins = {entry.name for entry in importlib.metadata.entry_points(group="can.interface")}
    assert set(bus_flags.BUILT_IN_INTERFACES) >= set(can.VALID_INTERFACES) - plugins
    assert set(bus_flags.BUILT_IN_INTERFACES) <= set(BACKENDS)


TIMING = "--timing f_clock=8000000 tseg1=5 tseg2=2 sjw=2 brp=2 nof_samples=1"


@pytest.mark.parametrize(
    "words",
    [
        "",
        "-i socketcan -c vcan0 -b 500000",
        "--interface virtual --channel x --fd --data-bitrate 2000000",
        TIMING,
        "--bus-kwargs a=1 b=x c=True d=1.5",
        "-i nothing",
        "-b fast",
        "--timing f_clock=8000000",
        "--timing x",
        "--bus-kwargs =1",
    ],
)
def test_they_parse_as_python_cans(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    results = []
    for parser in parsers():
        try:
            found: Any = {name: str(value) for name, value in vars(parser.parse_args(words.split())).items()}
        except SystemExit as end:
            found = end.code, capsys.readouterr().err.partition("error: ")[2]
        results.append(found)
    assert results[0] == results[1]
    capsys.readouterr()


def test_stdout_stays_for_data(capsys: pytest.CaptureFixture[str]) -> None:
    parsers()[0].parse_args(TIMING.split())
    out, err = capsys.readouterr()
    assert not out
    assert "CLK: 8MHz" in err


LISTED = """\
import argparse, sys
from tipforce_tools.cli import bus_flags
parser = argparse.ArgumentParser()
bus_flags.add_bus_arguments(parser)
assert "can" not in sys.modules
text = parser.format_help()
print("can" in sys.modules, "my_interface" in text)
assert parser.parse_args(["-i", "my_interface"]).interface == "my_interface"
"""


def test_an_interface_of_a_plugin_is_allowed_and_listed(tmp_path: Path) -> None:
    info = tmp_path / "plugin-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[can.interface]\nmy_interface = my_module:MyBus\n")
    code = f"import sys\nsys.path.append({str(tmp_path)!r})\n{LISTED}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "True True\n"), done.stderr
