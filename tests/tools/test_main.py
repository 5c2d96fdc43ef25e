"""The command `tipforce` itself: help, imports, exit codes, closed pipes; what all share: node-ids, buses, asking."""

import argparse
import io
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tipforce.dictionary.table import SOFTWARE_VERSION
from tipforce.errors import EnvironmentLackError, InputError, LogError, TipforceError
from tipforce_tools.cli import bus_flags, common, tables
from tipforce_tools.cli.main import COMMANDS, EXIT_CODES, command_parser, main
from tools.decode.logs import log_lines, write_log
from tools.rig import TIPFORCE, Printed, Terminal
from tools.test_completion import LINES

HEAVY_FOR_ALL = ("numpy", "can", "canopen", "cantools", "msgspec", "rich", "shtab", "websockets")
HEAVY = (*HEAVY_FOR_ALL, "hypothesis", "cyclonedds", "mcap")
# Commands that do something when nothing more is said.
RUN_ALONE = ["decode", "demo", "doctor", "dump", "export", "log", "monitor", "report", "ros2", "vcan", "view"]
Run = Callable[[Callable[[argparse.Namespace], int]], int]


def imported_by(*words: str, cwd: Path | None = None) -> set[str]:
    """Top-level modules in memory after `tipforce WORDS`."""
    code = (
        "import sys\nfrom tipforce_tools.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "print('MODULES', *sorted({name.partition('.')[0] for name in sys.modules}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.rpartition("MODULES ")[2].split())


def test_help_lists_every_command(printed: Printed) -> None:
    for words in (["--help"], ["-h"], ["help"]):
        out, err = printed(0, words)
        assert not err
        for name, (_, summary) in COMMANDS.items():
            assert f"  {name:11}  {summary}\n" in out  # one column of names, one of summaries
        assert "exit codes: 0 ok, 1 " in out


def test_version_and_no_word(printed: Printed) -> None:
    assert printed(0, "--version") == printed(0, "-V") == (f"tipforce {SOFTWARE_VERSION}\n", "")
    assert "usage: tipforce COMMAND" in printed(2, [""]).out == printed(2, []).out


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - set(RUN_ALONE)))
def test_what_is_missing_is_a_usage_error(name: str, printed: Printed) -> None:
    [line] = printed(2, f"{name} --no-such-flag" if name == "scan" else name).err.splitlines()
    assert line.startswith(f"tipforce {name}: error: ")
    assert line.endswith(f"; see `tipforce {name} --help`")


@pytest.mark.parametrize("words", [(), ("--help",), ("--version",), ("nonsense",), ("export", "eds")])
def test_the_bare_command_imports_nothing_heavy(words: tuple[str, ...]) -> None:
    assert not imported_by(*words) & set(HEAVY)


@pytest.mark.parametrize(
    ("command", "left_out"),
    [
        ("dump --decode run.log", ("canopen",)),
        ("decode -q run.log -o run.csv", ("can", "canopen", "cantools", "pyarrow", "rich", "scipy", "dask", "mcap")),
        ("design table 1", ("matplotlib",)),
        ("report --quick --only decoders", ("matplotlib", "scipy", "skfem")),
        ("run full --explain --json", ("numpy", "can", "matplotlib", "random")),
        *(
            (f"run {scene} --json", ("can", "matplotlib", "random", "scipy", "rich", "canopen"))
            for scene in ("static", "tap")
        ),
    ],
)
def test_a_command_imports_what_it_needs(command: str, left_out: tuple[str, ...], tmp_path: Path) -> None:
    """`--help` of each imports still less."""
    write_log(tmp_path / "run.log", log_lines(20))
    by_numpy = {"random"} if np.__version__.startswith("1.") else set()
    assert not imported_by(*command.split(), cwd=tmp_path) & set(left_out) - by_numpy


@pytest.fixture
def run_command(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[argparse.Namespace], int]], int]:
    """Run `tipforce probe`, a command whose run() is what the test says."""

    def run(body: Callable[[argparse.Namespace], int]) -> int:
        probe = SimpleNamespace(add_arguments=lambda parser: parser.add_argument("values", nargs="*"), run=body)
        monkeypatch.setitem(sys.modules, "tipforce_tools.probe", probe)
        monkeypatch.setitem(COMMANDS, "probe", ("probe", "a test's own"))
        return main(["probe", "-1.5e-3", "-1,0,0", "-.5"])

    return run


def raising(error: BaseException, cause: BaseException | None = None) -> Callable[[argparse.Namespace], int]:
    def body(_args: argparse.Namespace) -> int:
        error.__context__ = cause
        raise error from None

    return body


def test_every_error_class_is_mapped() -> None:
    """test_wrong_inputs.py has the exit code of each."""
    assert set(EXIT_CODES) == {LogError, *TipforceError.__subclasses__()}


WRAPPED = OSError("could not open")
"""As python-can does: its own error, caused by the system's."""
WRAPPED.__cause__ = PermissionError()


CAUSES: list[tuple[Exception, int]] = [
    (PermissionError(13, "Permission denied"), 9), (PermissionError(1, "Operation not permitted"), 9), (WRAPPED, 9),
    (FileNotFoundError(2, "x"), 2), (ValueError("x"), 2),
]  # fmt: skip


@pytest.mark.parametrize(
    ("error", "cause", "code"),
    [
        *((EnvironmentLackError("an operation is not permitted"), *cause) for cause in CAUSES),
        *((InputError("x"), *cause) for cause in CAUSES),
        (PermissionError(13, "Permission denied", "x.toml"), None, 9), (TipforceError("x"), None, 1),
    ],
)  # fmt: skip
def test_an_error_is_one_line_and_a_lack_of_permission_is_9(
    run_command: Run, error: Exception, cause: Exception | None, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(raising(error, cause)) == code
    assert capsys.readouterr() == ("", f"tipforce: {error}\n")


def test_sigterm_ends_a_command_as_ctrl_c_does(run_command: Run) -> None:
    closed = []

    def body(_args: argparse.Namespace) -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            closed.append("what it opened")
        return 0

    assert (run_command(body), closed) == (130, ["what it opened"])


def test_characters_that_stdout_cannot_encode_are_escapes(run_command: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    stdout = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", stdout)
    assert run_command(lambda _args: sys.stdout.write("\u250c\u2510")) == 2
    stdout.seek(0)
    assert stdout.read() == "\\u250c\\u2510"


def test_a_fault_of_ours_keeps_its_traceback(run_command: Run) -> None:
    with pytest.raises(ZeroDivisionError):
        run_command(raising(ZeroDivisionError()))


def test_numbers_with_a_minus_are_values_not_flags(run_command: Run) -> None:
    assert run_command(lambda args: 7 if args.values == ["-1.5e-3", "-1,0,0", "-.5"] else 0) == 7


@pytest.mark.parametrize(
    "name", ["calibrate", "dataset", "design", "firmware", "sdo", "lss", "config", "hand", "nmt", "export"]
)
def test_a_missing_action_is_one_line_with_all_of_them(name: str, printed: Printed) -> None:
    choice = command_parser(name).choice
    assert len(choice) >= 1
    for words in (name, f"{name} -q"):
        out, err = printed(2, words)
        assert out == ""
        [line] = err.splitlines()
        assert line.startswith(f"tipforce {name}: error: which ")
        assert line.endswith(f"? {', '.join(choice)}; see `tipforce {name} --help`")


def run_into(stdout: int, command: str) -> tuple[int, str]:
    """Exit code and stderr of `tipforce COMMAND` with its output going to a file descriptor."""
    words = [*TIPFORCE, *command.split()]
    done = subprocess.run(words, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    "command", ["export eds", "export dbc", "--help", "scan --help", "demo --json -q", "demo -q", "design table 3"]
)
def test_a_reader_that_left_ends_it_quietly(command: str) -> None:
    """As `| head` does: also what is still buffered when Python ends must not bring a complaint."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        assert run_into(writer, command) == (0, "")
    finally:
        os.close(writer)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
@pytest.mark.parametrize("command", ["export eds", "--version"])
def test_a_full_disk_is_told_without_a_traceback(command: str) -> None:
    with open("/dev/full", "wb") as full:
        code, err = run_into(full.fileno(), command)
    assert code != 0
    assert "tipforce: [Errno 28] No space left on device" in err
    assert "Traceback" not in err


def test_closed_streams_are_no_fault(tmp_path: Path) -> None:
    """`tipforce ... >&-`: the output file does not get the descriptor of stdout, and nothing is printed into it."""
    words = ["sh", "-c", '"$@" -W error -m tipforce_tools.cli.main export eds -o out.eds <&- >&-', "sh", sys.executable]
    done = subprocess.run(words, cwd=tmp_path, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    assert (tmp_path / "out.eds").read_text().startswith("[FileInfo]")


HEAVY_FOR_HELP = (*HEAVY_FOR_ALL, "matplotlib", "scipy", "pyarrow", "importlib.metadata")
CODE = f"""\
import contextlib, io, sys
from tipforce_tools.cli.main import main
for path in {list(LINES)!r}:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([*path.split()[1:], "--help"])
    assert text.getvalue().startswith("usage: " + path), path
    heavy = [name for name in {HEAVY_FOR_HELP!r} if name in sys.modules]
    assert not heavy, (path, heavy)
"""


def test_no_help_imports_anything_heavy() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr


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
    (line,) = capsys.readouterr().out.splitlines()
    found = json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert found == {"x": None, "list": [1.0, None, [None, None]], "nested": {"y": None, "z": 1}, "text": "NaN"}


def bus_arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    bus_flags.add_bus_arguments(parser, sdo=True)
    common.add_confirm_argument(parser)
    return parser.parse_args(words)


def test_only_what_was_said_goes_to_python_can() -> None:
    assert bus_flags.bus_options(bus_arguments()) == {}
    words = ["-i", "socketcan", "-c", "vcan0", "-b", "500000", "--bus-kwargs", "receive_own_messages=True"]
    expected = {"interface": "socketcan", "channel": "vcan0", "bitrate": 500000, "receive_own_messages": True}
    assert bus_flags.bus_options(bus_arguments(*words)) == expected


REAL = "-i socketcan -c can0"
QUESTION = "this persists. Continue? [y/N] "
NOBODY = "this persists; stdin is not a terminal: add --yes to confirm"


@pytest.mark.parametrize(
    ("words", "stdin", "question", "refused"),
    [
        *((words, io.StringIO(), "", "") for words in (
            f"--yes {REAL}", "-y", "-i virtual -c x", "-i udp_multicast -c 239.0.0.1", "-i socketcan -c vcan0")),
        *((REAL, Terminal(answer), QUESTION, "") for answer in ("y\n", "YES\n")),
        *((REAL, Terminal(answer), QUESTION, "not done") for answer in ("n\n", "\n", "")),
        *((words, io.StringIO("y\n"), "", NOBODY) for words in (REAL, "")),
    ],
)  # fmt: skip
def test_on_a_real_bus_a_person_is_asked(
    words: str, stdin: io.StringIO, question: str, refused: str, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Without a person the answer is no."""
    monkeypatch.setattr(sys, "stdin", stdin)
    with pytest.raises(InputError, match=refused) if refused else nullcontext():
        bus_flags.confirm(bus_arguments(*words.split()), "this persists")
    assert capsys.readouterr() == ("", question)


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
        tables.console(stderr=stderr).print("x", style="bold red")
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
