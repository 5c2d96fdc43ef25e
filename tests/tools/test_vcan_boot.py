"""`tipforce vcan --uml` booted: on a processor with AMX, as `larger_xstate.c` plays one, and for an ordinary user."""

import os
import pty
import resource
import select
import subprocess
import sys
import tempfile
import termios
import time
from pathlib import Path

import pytest

from tipforce.errors import EnvironmentLackError
from tipforce_tools.doctor.machine import vcan_checks
from tipforce_tools.kernel import host, uml
from tools.rig import TIPFORCE

FILES = 600
LACKING = host.missing_packages() if sys.platform == "linux" else ["Linux"]
pytestmark = pytest.mark.skipif(bool(LACKING), reason=f"User-mode Linux is not complete here: no {', '.join(LACKING)}")


@pytest.fixture
def amx(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A library that makes this processor one with AMX; it is preloaded after ours, and so stands behind it."""
    library = tmp_path / "larger_xstate.so"
    source = Path(__file__).with_name("larger_xstate.c")
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)

    ours = uml.preloading(tmp_path)["LD_PRELOAD"]
    monkeypatch.setattr(uml, "preloading", lambda _folder: {"LD_PRELOAD": f"{ours}:{library}"})
    return str(library)


def run_inside(code: str, writable: bool = False) -> int:
    command = [sys.executable, "-c", code]
    return uml.run_with_vcan(command, place="uml", timeout_s=120.0, memory="512M", writable=writable)


def test_without_the_library_that_processor_shows_the_fault(amx: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that `amx` below tests something."""
    monkeypatch.setattr(uml, "preloading", lambda _folder: {"LD_PRELOAD": amx})
    with pytest.raises(EnvironmentLackError, match=r"(?s)before it had booted .*(put_fp_registers|fatal_sigsegv)"):
        run_inside("pass")


@pytest.mark.parametrize("writable", [False, True])
def test_it_boots_for_an_ordinary_user_where_the_floating_point_state_is_larger(
    writable: bool, tmp_path: Path, request: pytest.FixtureRequest, capfd: pytest.CaptureFixture[str]
) -> None:
    """Two starts for three things, because each takes seconds: the processor, the caller's folder of temporary files,
    and the caller's limit of open files.

    The folder has a pytest folder in it that pytest wants to own inside. User-mode Linux keeps files open that were
    closed inside, on the account of whom it runs for."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 4 * FILES:
        pytest.skip(f"the hard limit of open files here is {hard}: `ulimit -Hn`")
    if not writable:
        request.getfixturevalue("amx")
    theirs = tmp_path / "pytest-of-somebody"
    theirs.mkdir(mode=0o700)
    if os.geteuid() == 0:
        os.chown(theirs, 12345, 12345)
    request.getfixturevalue("monkeypatch").setenv("TMPDIR", str(tmp_path))
    code = (
        "import itertools, os, pathlib, tempfile; "
        "folder = os.path.join(tempfile.gettempdir(), 'pytest-of-somebody'); "
        "os.makedirs(folder, 0o700, exist_ok=True); print(os.stat(folder).st_uid == os.getuid() == 0); "
        f"paths = list(itertools.islice(pathlib.Path(os.__file__).parent.rglob('*.py'), {FILES})); "
        "print(len([path.read_bytes() for path in paths])); print(2.5 * len(paths))"
    )
    resource.setrlimit(resource.RLIMIT_NOFILE, (FILES // 2, hard))
    try:
        assert run_inside(code, writable=writable) == 0
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert capfd.readouterr().out == f"True\n{FILES}\n{2.5 * FILES}\n"


def test_doctor_tries_it() -> None:
    (check,) = vcan_checks()
    assert check.state == "ok", check
    assert check.finding.startswith("`tipforce vcan` works: vcan0 and vcan1, ")


def read_until(terminal: int, wanted: bytes, shell: subprocess.Popen[bytes]) -> None:
    """Read what a shell shows until it is ``wanted``. Raises AssertionError if it ends, or after 120 s."""
    shown, over, deadline = b"", False, time.monotonic() + 120.0
    while wanted not in shown:
        assert not over, shown
        over = shell.poll() is not None or time.monotonic() > deadline  # before the last look
        while select.select([terminal], [], [], 0.1)[0]:
            shown += os.read(terminal, 65536)


def test_a_command_is_attached_to_a_running_machine(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """It sees the same buses, its output and exit code arrive, and the machine goes on."""
    with tempfile.TemporaryDirectory(prefix="v", dir="/tmp") as folder, monkeypatch.context() as patch:
        patch.setattr(tempfile, "tempdir", folder)
        with pytest.raises(EnvironmentLackError, match="no `tipforce vcan` of yours runs"):
            uml.run_attached(["true"], list)
        words = ["vcan", "--uml", "--memory", "512M", "--", "sleep", "600"]
        machine = subprocess.Popen([*TIPFORCE, *words], env={**os.environ, "TMPDIR": folder})
        try:
            deadline = time.monotonic() + 120.0
            while not list(Path(folder).glob("*/started")) and time.monotonic() < deadline:
                time.sleep(0.1)
            code = "cat /sys/class/net/vcan1/type; echo $TOLD >&2; exit 7"
            patch.setenv("TOLD", "two words")
            assert uml.run_attached(["bash", "-c", code], list, 60.0) == 7
            assert capfd.readouterr() == ("280\n", "two words\n")
            ours, theirs = pty.openpty()
            termios.tcsetwinsize(theirs, (40, 100))
            shell = subprocess.Popen(
                [*TIPFORCE, "vcan", "--attach"], start_new_session=True,
                env={**os.environ, "TMPDIR": folder, "HOME": folder, "SHELL": "/bin/bash"},
                stdin=theirs, stdout=theirs, stderr=theirs,
            )  # fmt: skip
            read_until(ours, b"# ", shell)  # the prompt; what is typed before it may be lost
            os.write(ours, b"cat /sys/class/net/vcan1/type; tty; stty size; exit 9\n")
            read_until(ours, b"280\r\n/dev/tty3\r\n40 100\r\n", shell)
            assert shell.wait(120.0) == 9
            os.close(ours)
            os.close(theirs)
            assert machine.poll() is None
        finally:
            machine.terminate()
            machine.wait()
