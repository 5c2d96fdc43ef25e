"""The command `tipforce` itself: help, unknown commands, what is imported, exit codes, pipes that close."""

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tipforce.dictionary.table import SOFTWARE_VERSION
from tipforce.errors import (
    EnvironmentLackError,
    InputError,
    LogError,
    NoResponseError,
    RefusedError,
    SdoAbortError,
    TipforceError,
)
from tipforce_tools.cli.main import COMMANDS, EXIT_CODES, command_parser, main
from tools.command_lines import LINES
from tools.decode.logs import log_lines, write_log
from tools.rig import Printed

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
    assert "usage: tipforce COMMAND" in printed(2, []).out


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - set(RUN_ALONE)))
def test_what_is_missing_is_a_usage_error(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = [name, "--no-such-flag"] if name == "scan" else [name]
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
    [line] = capsys.readouterr().err.splitlines()
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
        if cause is None:
            raise error
        try:
            raise cause
        except BaseException:
            raise error from None

    return body


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (InputError("x"), 2), (EnvironmentLackError("x"), 2), (NoResponseError("x"), 5),
        (SdoAbortError("x", 0x06020000), 11), (RefusedError("x"), 12), (TipforceError("x"), 1),
    ],
)  # fmt: skip
def test_each_error_has_its_exit_code(
    run_command: Run, error: TipforceError, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(raising(error)) == code
    assert capsys.readouterr() == ("", "tipforce: x\n")


def test_every_error_class_is_mapped() -> None:
    assert set(EXIT_CODES) == {LogError, *TipforceError.__subclasses__()}


WRAPPED = OSError("could not open")
"""As python-can does: its own error, caused by the system's."""
WRAPPED.__cause__ = PermissionError()


@pytest.mark.parametrize(
    ("cause", "code"),
    [
        (PermissionError(13, "Permission denied"), 9), (PermissionError(1, "Operation not permitted"), 9), (WRAPPED, 9),
        (FileNotFoundError(2, "x"), 2), (ValueError("x"), 2),
    ],
)  # fmt: skip
@pytest.mark.parametrize("error", [EnvironmentLackError("an operation is not permitted"), InputError("x")])
def test_a_lack_of_permission_is_9(run_command: Run, error: TipforceError, cause: BaseException, code: int) -> None:
    assert run_command(raising(error, cause)) == code


def test_a_permission_error_itself_is_9(run_command: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(raising(PermissionError(13, "Permission denied", "x.toml"))) == 9
    assert capsys.readouterr().err == "tipforce: [Errno 13] Permission denied: 'x.toml'\n"


def test_a_fault_of_ours_keeps_its_traceback(run_command: Run) -> None:
    with pytest.raises(ZeroDivisionError):
        run_command(raising(ZeroDivisionError()))


def test_numbers_with_a_minus_are_values_not_flags(run_command: Run) -> None:
    assert run_command(lambda args: 7 if args.values == ["-1.5e-3", "-1,0,0", "-.5"] else 0) == 7


@pytest.mark.parametrize(
    "name", ["calibrate", "dataset", "design", "firmware", "sdo", "lss", "config", "hand", "nmt", "export"]
)
def test_a_missing_action_is_one_line_with_all_of_them(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    choice = command_parser(name).choice
    assert len(choice) >= 1
    for words in ([], ["-q"]):
        with pytest.raises(SystemExit) as caught:
            main([name, *words])
        assert caught.value.code == 2
        out, err = capsys.readouterr()
        [line] = err.splitlines()
        assert out == ""
        assert line.startswith(f"tipforce {name}: error: which ")
        assert line.endswith(f"? {', '.join(choice)}; see `tipforce {name} --help`")


def run_into(stdout: int, command: str) -> tuple[int, str]:
    """Exit code and stderr of `tipforce COMMAND` with its output going to a file descriptor."""
    words = [sys.executable, "-m", "tipforce_tools.cli.main", *command.split()]
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
    words = [sys.executable, "-W", "error", "-m", "tipforce_tools.cli.main", "export", "eds", "-o", "out.eds"]
    done = subprocess.run(
        ["sh", "-c", '"$@" <&- >&-', "sh", *words], cwd=tmp_path, stderr=subprocess.PIPE, text=True, check=False
    )
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    assert (tmp_path / "out.eds").read_text().startswith("[FileInfo]")


HEAVY_FOR_HELP = (*HEAVY_FOR_ALL, "matplotlib", "scipy", "pyarrow", "importlib.metadata")
PATHS = [tuple(path.split()[1:]) for path in LINES]
CODE = f"""\
import contextlib, io, sys
from tipforce_tools.cli.main import main
for path in {PATHS!r}:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([*path, "--help"])
    assert text.getvalue().startswith("usage: tipforce " + " ".join(path)), path
    heavy = [name for name in {HEAVY_FOR_HELP!r} if name in sys.modules]
    print(*path, "imports" if heavy else "", *heavy)
    for name in heavy:
        del sys.modules[name]
"""


@pytest.fixture(scope="module")
def told() -> list[str]:
    """A line for each command and action: what heavy its help imports."""
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return [line.strip() for line in done.stdout.splitlines()]


def test_no_help_imports_anything_heavy(told: list[str]) -> None:
    assert told == [" ".join(path) for path in PATHS]
