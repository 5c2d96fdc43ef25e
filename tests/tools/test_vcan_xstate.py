"""The library preloaded into User-mode Linux: what it does to ptrace(), and what is said where it cannot be built."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tipforce.errors import EnvironmentLackError
from tipforce_tools.kernel import uml

HERE = Path(__file__).parent


def test_amx_is_what_the_kernel_says_of_the_processor(tmp_path: Path) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    for flags, expected in (("fpu avx512f amx_tile amx_int8", True), ("fpu avx512f", False)):
        cpuinfo.write_text(f"processor\t: 0\nflags\t\t: {flags}\n")
        assert uml.needs_whole_xstate(cpuinfo) == expected
    assert not uml.needs_whole_xstate(tmp_path / "none")


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uml, "_COMPILERS", ("no-such-compiler",))


@pytest.mark.usefixtures("no_compiler")
def test_without_a_compiler_one_line_says_so_and_the_rest_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(uml, "needs_whole_xstate", lambda: False)
    assert uml.preloading(tmp_path) == {}
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "`apt-get install -y gcc libc6-dev` (as root); this processor does not need it" in said


@pytest.mark.usefixtures("no_compiler")
def test_without_a_compiler_a_processor_with_amx_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(uml, "needs_whole_xstate", lambda: True)
    with pytest.raises(EnvironmentLackError, match=r"^User-mode Linux on a processor with AMX .* gcc libc6-dev` .*$"):
        uml.preloading(tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in is a shell script")
def test_a_compiler_that_fails_is_quoted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    compiler = tmp_path / "compiler"
    compiler.write_text("#!/bin/sh\necho 'no crti.o' >&2\necho more >&2\nexit 1\n")
    compiler.chmod(0o755)
    monkeypatch.setattr(uml, "_COMPILERS", (str(compiler),))
    with pytest.raises(EnvironmentLackError, match=r"compiler failed \(no crti.o\): "):
        uml.build_whole_xstate(tmp_path)


def _larger_than_576_bytes() -> bool:
    """Has this processor AVX, so that its floating-point state is larger than the beginning that the test sets?"""
    cpuinfo = Path("/proc/cpuinfo")
    return cpuinfo.exists() and "avx" in cpuinfo.read_text().split()


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is missing: apt-get install gcc")
@pytest.mark.skipif(not _larger_than_576_bytes(), reason="no x86 processor with AVX under Linux")
def test_the_beginning_of_the_state_is_set_and_the_rest_stays(tmp_path: Path) -> None:
    """What AMX does to 2696 bytes happens to 576 bytes on every processor with AVX."""
    program = tmp_path / "set_xstate"
    subprocess.run(["gcc", "-o", str(program), str(HERE / "set_xstate.c")], check=True)

    def said(**environment: str) -> str:
        return subprocess.run([str(program)], env=environment, capture_output=True, text=True, check=True).stdout

    assert said() == "larger, EFAULT, not arrived, the rest as it was\n", "the kernel as it is"
    assert said(LD_PRELOAD=str(uml.build_whole_xstate(tmp_path))) == "larger, set, arrived, the rest as it was\n"
