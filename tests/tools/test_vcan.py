"""`tipforce vcan`, as far as it goes without booting anything: test_vcan_boot.py and the Makefile do that."""

import argparse
import io
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path

import pytest

from tipforce.errors import EnvironmentLackError, InputError
from tipforce_tools import vcan
from tipforce_tools.cli.main import main
from tipforce_tools.kernel import host, uml
from tools.rig import Terminal

SCRIPT = files("tipforce_tools.kernel").joinpath("init.sh").read_text()
needs_bash = pytest.mark.skipif(shutil.which("bash") is None, reason="the machine has no bash")


def parse(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    subcommands = parser.add_subparsers()
    vcan.add_arguments(subcommands.add_parser("vcan"))
    return parser.parse_args(["vcan", *words])


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[str]]]:
    """Nothing runs: what would have run is noted, as (place, command)."""
    calls: list[tuple[str, list[str]]] = []

    def here(words: Sequence[str], _timeout_s: float | None = None) -> int:
        calls.append(("here", list(words)))
        return 3

    def in_uml(command: Sequence[str], *_: object) -> int:
        calls.append(("uml", list(command)))
        return 4

    monkeypatch.setattr(host, "run_here", here)
    monkeypatch.setattr(uml, "run_in_uml", in_uml)
    return calls


def fake_kernel(monkeypatch: pytest.MonkeyPatch, *, up: Sequence[str] = (), can_make: bool = False) -> None:
    monkeypatch.setattr("tipforce_tools.kernel.host.can_interfaces", lambda: dict.fromkeys(up, True))
    monkeypatch.setattr(host, "can_make", lambda _interfaces: can_make)


# The choice of the place


@pytest.mark.parametrize(
    ("up", "can_make", "place"),
    [(("vcan0", "vcan1"), True, "direct"), (("vcan0",), True, "namespace"), ((), False, "uml")],
)
def test_the_place_follows_from_the_kernel(
    up: Sequence[str], can_make: bool, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_kernel(monkeypatch, up=up, can_make=can_make)
    assert host.choose(["vcan0", "vcan1"]) == place


@pytest.mark.parametrize(
    ("platform", "words", "error", "message"),
    [
        ("linux", "--host -- true", EnvironmentLackError, r"vcan0, vcan1 cannot be created.*modprobe vcan"),
        ("linux", "", InputError, r"tipforce vcan -- COMMAND"),  # no terminal, so no shell
        ("darwin", "-- true", EnvironmentLackError, r"^vcan exists on Linux only.*darwin.*`tipforce demo`.*$"),
    ],
)
def test_where_it_cannot_run_one_line_says_what_to_try(
    platform: str, words: str, error: type[Exception], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_kernel(monkeypatch)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    with pytest.raises(error, match=message):
        vcan.run(parse(*words.split()))


def test_the_namespace_command_makes_every_bus_before_it_runs_the_command(
    monkeypatch: pytest.MonkeyPatch, asked: list[tuple[str, list[str]]]
) -> None:
    fake_kernel(monkeypatch, can_make=True)
    assert uml.run_with_vcan(["true", "-x"], interfaces=["a0", "b1"]) == 3
    ((place, words),) = asked
    assert place == "here"
    assert {"--net", "--mount"} <= set(words)
    assert words[-5:] == ["a0", "b1", "--", "true", "-x"]


@pytest.mark.parametrize("user", [0, 1000])
def test_an_ordinary_user_gets_a_user_namespace(user: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: user)
    assert ("--map-root-user" in host.namespace_command(["vcan0"], ["true"])) == (user != 0)


# Arguments


@pytest.mark.parametrize(
    ("words", "shell", "expected"),
    [
        ("-- echo hi", "", "echo hi"), ("echo -n --uml", "", "echo -n --uml"), ("-- env -- ls", "", "env -- ls"),
        ("--uml --timeout 5 -- sh -c 'exit 1'", "", "sh -c 'exit 1'"),
        ("", "/bin/sh", "/bin/sh"), ("", "/no/such/shell", "bash"), ("", "", "bash"),
    ],
)  # fmt: skip
def test_the_command_is_taken_word_for_word_and_without_one_it_is_a_shell_on_a_terminal(
    words: str, shell: str, expected: str, monkeypatch: pytest.MonkeyPatch, asked: list[tuple[str, list[str]]]
) -> None:
    fake_kernel(monkeypatch)
    monkeypatch.setattr(sys, "stdin", Terminal())
    monkeypatch.setenv("SHELL", shell)
    assert vcan.run(parse(*shlex.split(words))) == 4
    assert asked == [("uml", shlex.split(expected))]


@pytest.mark.parametrize(
    ("flags", "can_make", "expected"),
    [
        ([], False, "User-mode Linux, with vcan0, vcan1; you are root; files that you write are lost on exit (--rw"),
        (["--rw"], False, "--rw: files that you write are kept"),
        ([], True, "this kernel, with vcan0, vcan1; `exit` ends the shell"),
    ],
)
@pytest.mark.usefixtures("asked")
def test_a_shell_is_told_where_it_is_and_what_becomes_of_its_files(
    flags: list[str], can_make: bool, expected: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fake_kernel(monkeypatch, can_make=can_make)
    monkeypatch.setattr(sys, "stdin", Terminal())
    vcan.run(parse(*flags))
    said = capsys.readouterr()
    assert expected in said.err
    assert (said.out, said.err.count("\n")) == ("", 1)
    vcan.run(parse(*flags, "--", "true"))
    assert capsys.readouterr().err == "", "a command's stderr is its own"


def test_a_command_that_is_not_there_is_127_before_anything_boots(
    asked: list[tuple[str, list[str]]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert uml.run_with_vcan(["no-such-program-here"]) == 127
    assert asked == []
    assert capsys.readouterr().err == "tipforce vcan: no-such-program-here: command not found\n"


# Running on this kernel


@pytest.mark.parametrize(
    ("script", "expected"), [("true", 0), ("exit 3", 3), ("kill -9 $$", 137), ("kill -15 $$", 143)]
)
def test_exit_codes_are_the_commands_own(script: str, expected: int) -> None:
    assert host.run_here(["sh", "-c", script]) == expected


def test_a_program_that_the_system_refuses_is_126_or_127(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken"
    broken.write_bytes(b"\x7fnot a program")
    broken.chmod(0o755)
    assert host.run_here([str(broken)]) == 126
    assert host.run_here([str(tmp_path / "none")]) == 127
    assert "Exec format error" in capfd.readouterr().err


def test_a_timeout_or_a_signal_ends_the_command(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    assert host.run_here(["sleep", "60"], timeout_s=0.2) == 1
    assert "ended after 0.2 s (--timeout)" in capfd.readouterr().err
    monkeypatch.setattr(host, "choose", lambda *_: "direct")
    signals = f"sleep 0.3; kill -TERM {os.getpid()}; sleep 60"
    assert main(["vcan", "--timeout", "30", "--", "sh", "-c", signals]) == 130


@needs_bash
def test_a_namespace_is_found_by_attach_only_when_its_buses_are_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for program in ("mount", "ip"):
        (tmp_path / program).write_text(f"#!/bin/sh\nsleep 0.1; cat {tmp_path}/*/{host.PROCESS} 2>/dev/null; true\n")
        (tmp_path / program).chmod(0o755)
    monkeypatch.setattr(host, "short_temporary_folder", lambda: str(tmp_path))
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    command = ["sh", "-c", f"echo $$ $TIPFORCE_VCAN_PROCESS; cat {tmp_path}/*/{host.PROCESS}"]
    words = host.namespace_command(["a0", "b1"], command)
    assert host.run_here(words[words.index("bash") :]) == 0  # all but the namespace
    own, found = capfd.readouterr().out.splitlines()
    assert own == found


# User-mode Linux: all but the boot


@pytest.mark.parametrize(
    ("machine", "message"),
    [
        ("x86_64", r"`apt-get install -y user-mode-linux` \(as root\)"),
        ("aarch64", r"^this kernel has no vcan.* x86 only, not for aarch64; .*modprobe.*$"),
    ],
)
def test_what_is_missing_is_named_with_the_command_that_installs_it(
    machine: str, message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(host, "find_program", lambda name: None if name == "linux.uml" else f"/bin/{name}")
    monkeypatch.setattr(host, "_MODULES", tmp_path)
    monkeypatch.setattr(os, "uname", lambda: os.uname_result(("Linux", "here", "6.1", "#1", machine)))
    with pytest.raises(EnvironmentLackError, match=message):
        uml.run_in_uml(["true"], ["vcan0"], "1G", None, False)


@needs_bash
@pytest.mark.parametrize("kernel", ["6.1", "6.12"])
def test_the_exchange_is_mounted_by_either_interface_of_hostfs(kernel: str) -> None:
    """6.1 takes the whole option for the folder's path; 6.12 knows options by their names, and this one is hostfs=."""
    function = SCRIPT[SCRIPT.index("mount_exchange() {") : SCRIPT.index("mount_basics() {")]
    stand_in = (
        "mount() { case $kernel,$4 in 6.12,hostfs=/tmp/x | 6.1,/tmp/x) echo mounted; return 0;; esac\nreturn 1; }\n"
    )
    script = f"{stand_in}{function}\nmount_exchange"
    variables = {"kernel": kernel, "folder": "/tmp/x", "exchange": "/run/x"}
    done = subprocess.run(["bash", "-c", script], env=variables, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "mounted\n")


def test_all_that_is_missing_is_named_at_once_also_the_modules(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(host, "_MODULES", tmp_path)
    monkeypatch.setattr(host, "find_program", lambda _name: None)
    assert host.missing_packages() == ["iproute2", "kmod", "user-mode-linux", "util-linux"]
    monkeypatch.setattr(host, "find_program", lambda name: f"/bin/{name}")
    assert host.missing_packages() == ["user-mode-linux"]
    module = tmp_path / "6.1/kernel/drivers/net/can/vcan.ko"
    module.parent.mkdir(parents=True)
    module.touch()
    assert host.missing_packages() == []


@needs_bash
def test_the_environment_comes_through_the_file_unchanged(tmp_path: Path) -> None:
    items = [b"PLAIN=1", b"EMPTY=", b"LINES=a\nb\n", b"BYTES=\xff\xfe", b"BASH_FUNC_f%%=() { echo; }", "ÄÖ=ß".encode()]
    uml.write_lists(tmp_path, environment=items)
    # The very words of init.sh, followed by a dump.
    read = next(line.strip() for line in SCRIPT.splitlines() if "mapfile" in line and "environment" in line)
    dump = "printf '%s\\0' \"${environment[@]}\""
    result = subprocess.run(["bash", "-c", f"exchange={tmp_path}; {read}; {dump}"], capture_output=True, check=True)
    assert result.stdout.split(b"\0")[:-1] == items
    with pytest.raises(InputError, match="NUL"):
        uml.write_lists(tmp_path, command=["a\0b"])


Boot = Callable[..., int]


@pytest.fixture
def boot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Boot:
    """Run a command with a script in the place of linux.uml, which behaves as it and init.sh do. The script runs in the
    folder that is otherwise shared with init.sh."""
    if sys.platform != "linux" or shutil.which("bash") is None:
        pytest.skip("linux.uml exists on Linux alone, and the script needs bash")
    program = tmp_path / "linux.uml"
    monkeypatch.setattr(uml, "find_program", lambda _name: str(program))
    monkeypatch.setattr(uml, "require_parts", lambda: None)
    monkeypatch.setattr(uml, "preloading", lambda _folder: {})
    monkeypatch.setattr(sys, "stdin", io.StringIO())

    def run(script: str, timeout_s: float | None = None) -> int:
        read_arguments = (
            'for word; do case $word in init=*) cd "$(dirname "${word#init=}")";; '
            "con1=*) out=${word##*:};; con2=*) err=${word##*:};; esac; done\n"
        )
        program.write_text(f"#!/bin/bash\n{read_arguments}{script}\n")
        program.chmod(0o755)
        return uml.run_in_uml(["true"], ["vcan0"], "64M", timeout_s, False)

    return run


def test_the_status_file_is_the_exit_code(boot: Boot, capfd: pytest.CaptureFixture[str]) -> None:
    assert boot("touch started; echo out >&$out; echo err >&$err; echo kernel; echo 42 >status; exit 7") == 42
    assert capfd.readouterr() == ("out\n", "err\n")


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo Kernel panic; exit 1", r"ended before it had booted \(.*\n  Kernel panic"),
        ("echo 'the interface x0 could not be made' >failed", "booted, but the interface x0 could not be made"),
        ("touch started", r"before the command did .*--memory"),
        ("sleep 60", "did not boot within"),
    ],
)
def test_a_machine_that_fails_says_why(script: str, said: str, boot: Boot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uml, "BOOT_LIMIT_S", 0.3 if script == "sleep 60" else 60.0)
    with pytest.raises(EnvironmentLackError, match=said):
        boot(script)


def test_a_halt_that_hangs_does_not_hold_up_the_exit(boot: Boot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uml, "HALT_LIMIT_S", 0.2)
    assert boot("touch started; echo 5 >status; sleep 60") == 5


def test_a_timeout_or_a_signal_ends_the_whole_group(
    boot: Boot, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert boot("sleep 60 & echo $! >&$out; touch started; sleep 60", timeout_s=0.5) == 1
    printed = capfd.readouterr()
    assert "ended after 0.5 s (--timeout)" in printed.err
    assert ended(int(printed.out))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as `tipforce` does for each command
    more_than_a_pipe_holds = "head -c 200000 /dev/zero >&$out"  # so it ends when the output is followed
    script = f"touch started; echo $$ >{tmp_path}/pid; {more_than_a_pipe_holds}; kill -TERM {os.getpid()}; sleep 60"
    assert boot(script) == 130
    assert ended(int((tmp_path / "pid").read_text()))


def test_the_time_of_the_command_begins_when_it_does_and_ends_though_it_has_ever_more_to_say(boot: Boot) -> None:
    assert boot("sleep 0.5; echo 7 >status; touch started", timeout_s=0.1) == 7
    assert boot("touch started; while :; do echo; done >&$out", timeout_s=0.2) == 1


def ended(process: int) -> bool:
    """Gone, or a zombie that whoever adopted it has not yet collected."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_an_attached_command_that_ends_as_its_machine_does_keeps_its_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Output(io.StringIO):
        def flush(self) -> None:
            for folder in (*tmp_path.glob("attach-*"), tmp_path):
                (folder / "status").write_text("7\n")

        def fileno(self) -> int:
            return 1

    monkeypatch.setattr(sys, "stdout", Output())
    assert uml._in_machine(tmp_path, ["true"], None) == 7


def test_a_run_that_ends_while_attach_looks_for_one_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "glob", lambda *_: [tmp_path / "gone"])
    with pytest.raises(EnvironmentLackError, match="no `tipforce vcan` of yours runs"):
        uml.run_attached(["true"], list)


# The library preloaded into User-mode Linux: what it does to ptrace(), and what is said where it cannot be built


@pytest.mark.parametrize(("flags", "needed"), [("fpu amx_tile amx_int8", True), ("fpu avx512f", False), (None, False)])
@pytest.mark.parametrize(
    ("compiler", "lack"), [(None, "none is installed"), ("echo 'no crti.o' >&2; echo more >&2", "failed (no crti.o)")]
)
def test_without_a_compiler_that_works_one_line_says_so_and_amx_is_refused(
    flags: str | None, needed: bool, compiler: str | None, lack: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    program, cpuinfo = tmp_path / "compiler", tmp_path / "cpuinfo"
    if compiler:
        program.write_text(f"#!/bin/sh\n{compiler}\nexit 1\n")
        program.chmod(0o755)
    if flags:
        cpuinfo.write_text(f"processor\t: 0\nflags\t\t: {flags}\n")
    monkeypatch.setattr(uml, "_COMPILERS", (str(program),))
    what = f"{lack}: `apt-get install -y gcc libc6-dev` (as root)"
    if needed:
        with pytest.raises(EnvironmentLackError) as refused:
            uml.preloading(tmp_path, cpuinfo)
        assert str(refused.value).startswith("User-mode Linux on a processor with AMX ")
        assert str(refused.value).endswith(what)
    else:
        assert uml.preloading(tmp_path, cpuinfo) == {}
        assert capsys.readouterr().err.endswith(f"{what}; this processor does not need it\n")


def _larger_than_576_bytes() -> bool:
    """Has this processor AVX, so that its floating-point state is larger than the beginning that the test sets?"""
    cpuinfo = Path("/proc/cpuinfo")
    return cpuinfo.exists() and "avx" in cpuinfo.read_text().split()


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is missing: apt-get install gcc")
@pytest.mark.skipif(not _larger_than_576_bytes(), reason="no x86 processor with AVX under Linux")
def test_the_beginning_of_the_state_is_set_and_the_rest_stays(tmp_path: Path) -> None:
    """What AMX does to 2696 bytes happens to 576 bytes on every processor with AVX."""
    program = tmp_path / "set_xstate"
    subprocess.run(["gcc", "-o", str(program), str(Path(__file__).with_name("set_xstate.c"))], check=True)

    def said(**environment: str) -> str:
        return subprocess.run([str(program)], env=environment, capture_output=True, text=True, check=True).stdout

    assert said() == "larger, EFAULT, not arrived, the rest as it was\n", "the kernel as it is"
    assert said(**uml.preloading(tmp_path)) == "larger, set, arrived, the rest as it was\n"
