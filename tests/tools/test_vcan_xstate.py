"""The library preloaded into User-mode Linux: what it does to ptrace(), and what is said where it cannot be built."""

import shutil
import subprocess
from pathlib import Path

import pytest

from tipforce.errors import EnvironmentLackError
from tipforce_tools.kernel import uml

HERE = Path(__file__).parent


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
    subprocess.run(["gcc", "-o", str(program), str(HERE / "set_xstate.c")], check=True)

    def said(**environment: str) -> str:
        return subprocess.run([str(program)], env=environment, capture_output=True, text=True, check=True).stdout

    assert said() == "larger, EFAULT, not arrived, the rest as it was\n", "the kernel as it is"
    assert said(**uml.preloading(tmp_path)) == "larger, set, arrived, the rest as it was\n"
