"""What the subcommands share: node-ids, buses, JSON, asking before something persists."""

from __future__ import annotations

import argparse
import io
import json
import math
import sys

import pytest

from tipforce.errors import InputError
from tipforce_tools.cli import bus_flags, common


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("5", [5]), ("1,2,5-9", [1, 2, 5, 6, 7, 8, 9]), ("0x0A-0x0C, 3", [3, 10, 11, 12]), ("9,1,9,1-2", [1, 2, 9]),
        ("7-7", [7]), ("0x7f", [127]), ("0b101", [5]), ("1-127", list(range(1, 128))), (" 1 - 3 ", [1, 2, 3]),
    ],
)  # fmt: skip
def test_a_set_of_node_ids(text: str, numbers: list[int]) -> None:
    assert common.node_ids(text) == numbers


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "write 1,2,5-9"), ("1,,2", "write 1,2,5-9"), ("1-", "write 1,2,5-9"), ("-3", "write 1,2,5-9"),
        ("1-2-3", "write 1,2,5-9"), ("1;2", "write 1,2,5-9"), ("9-5", "the second is smaller than the first"),
        ("0-5", "node-id '0': allowed are 1 to 127"), ("1-128", "node-id '128': allowed are 1 to 127"),
        *((text, f"node-id '{text}': allowed are 1 to 127 .10 or 0x0A") for text in ("x", "0x80", "0A", "010", "1e1")),
    ],
)  # fmt: skip
def test_what_is_no_set_of_node_ids(text: str, message: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=message):
        common.node_ids(text)


def test_json_has_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    values = [1.0, math.nan, (math.inf, -math.inf)]
    common.print_json({"x": math.nan, "list": values, "nested": {"y": math.inf, "z": 1}, "text": "NaN"})
    line = capsys.readouterr().out
    assert line.count("\n") == 1
    found = json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert found == {"x": None, "list": [1.0, None, [None, None]], "nested": {"y": None, "z": 1}, "text": "NaN"}


def bus_arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    bus_flags.add_sdo_arguments(parser)
    common.add_confirm_argument(parser)
    return parser.parse_args(words)


def test_only_what_was_said_goes_to_python_can() -> None:
    assert bus_flags.bus_options(bus_arguments()) == {}
    words = ["-i", "socketcan", "-c", "vcan0", "-b", "500000", "--bus-kwargs", "receive_own_messages=True"]
    expected = {"interface": "socketcan", "channel": "vcan0", "bitrate": 500000, "receive_own_messages": True}
    assert bus_flags.bus_options(bus_arguments(*words)) == expected


class Terminal(io.StringIO):
    """A stdin with a person at it."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    "words",
    ["--yes -i socketcan -c can0", "-y", "-i virtual -c x", "-i udp_multicast -c 239.0.0.1", "-i socketcan -c vcan0"],
)
def test_nobody_is_asked(words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    bus_flags.confirm(bus_arguments(*words.split()), "this persists")
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("answer", "done"), [("y\n", True), ("YES\n", True), ("n\n", False), ("\n", False), ("", False)]
)
def test_on_a_real_bus_a_person_is_asked(
    answer: str, done: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    args = bus_arguments("-i", "socketcan", "-c", "can0")
    if done:
        bus_flags.confirm(args, "this persists")
    else:
        with pytest.raises(InputError, match="not done"):
            bus_flags.confirm(args, "this persists")
    assert capsys.readouterr() == ("", "this persists. Continue? [y/N] ")


@pytest.mark.parametrize("words", ["-i socketcan -c can0", ""])
def test_without_a_person_the_answer_is_no(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    with pytest.raises(InputError, match=r"this persists; stdin is not a terminal: add --yes to confirm"):
        bus_flags.confirm(bus_arguments(*words.split()), "this persists")


def test_notes_go_to_stderr_and_not_with_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    for words, text in (((), "hello"), (("-q",), "silence")):
        common.OUTPUT.set_up(bus_arguments(*words))
        common.note(text)
    assert capsys.readouterr() == ("", "hello\n")


@pytest.mark.parametrize(
    ("words", "environment", "coloured"),
    [
        ("", {}, False), ("--color always", {}, True), ("--color always", {"NO_COLOR": "1"}, True),
        ("--color never", {"FORCE_COLOR": "1"}, False), ("", {"NO_COLOR": "1", "FORCE_COLOR": "1"}, False),
    ],
)  # fmt: skip
def test_colour(
    words: str, environment: dict[str, str], coloured: bool, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    for name in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    for stderr in (False, True):
        common.OUTPUT.set_up(bus_arguments(*words.split()))
        common.console(stderr=stderr).print("x", style="bold red")
        out, err = capsys.readouterr()
        assert ("\x1b[1;31m" in (err if stderr else out)) is coloured
        assert ("\x1b" in out + err) is coloured  # plain is plain: not bold, either


@pytest.mark.parametrize(("quiet", "absolute", "said"), [(False, False, "5"), (False, True, "3"), (True, True, "")])
def test_a_pipe_gets_lines_of_progress(
    quiet: bool, absolute: bool, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(common, "_LINE_S", 0.0)
    monkeypatch.setattr(common.OUTPUT, "quiet", quiet)
    with common.progress("loads", 9, absolute=absolute) as advance:
        advance(2)
        advance(3)
    assert capsys.readouterr().err.endswith(f"loads: {said} of 9, 0 s\n" if said else "")
