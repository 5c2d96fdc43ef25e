"""The library that is preloaded into linux.uml, which else dies at boot on a processor with AMX (whole_xstate.c).

It is built for each run, and on every processor: so what few processors need is tried on all of them.
"""

import os
import shutil
import subprocess
import sys
from importlib.resources import as_file, files
from pathlib import Path

from tipforce.errors import EnvironmentLackError

_COMPILERS = ("gcc", "cc", "clang")
_INSTALL = "`apt-get install -y gcc libc6-dev` (as root)"


def is_needed(cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Is the floating-point state of this processor larger than linux.uml expects?"""
    try:
        return "amx_tile" in cpuinfo.read_text().split()
    except OSError:
        return False


def build(folder: Path) -> Path:
    """Compile the library into `folder`. Raises EnvironmentLackError, in one line, where no compiler does it."""
    compiler = next((found for name in _COMPILERS if (found := shutil.which(name))), None)
    what = "User-mode Linux on a processor with AMX needs a C compiler"
    if compiler is None:
        raise EnvironmentLackError(f"{what}, and there is none: {_INSTALL}")
    library = folder / "whole_xstate.so"
    with as_file(files("tipforce_tools.vcan").joinpath("whole_xstate.c")) as source:
        built = subprocess.run(
            [compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(source)],
            capture_output=True,
            check=False,
            env={**os.environ, "LC_ALL": "C"},
        )
    if built.returncode:
        said = built.stderr.decode(errors="replace").strip().splitlines() or ["nothing"]
        raise EnvironmentLackError(f"{what}, and {compiler} failed ({said[0]}): {_INSTALL}")
    return library


def preloading(folder: Path) -> dict[str, str]:
    """The variable that preloads whole_xstate.c. Without a compiler: nothing, and a line on stderr.

    Raises EnvironmentLackError where this processor cannot do without.
    """
    try:
        return {"LD_PRELOAD": str(build(folder))}
    except EnvironmentLackError as error:
        if is_needed():
            raise
        print(f"tipforce vcan: {error}; this processor does without", file=sys.stderr)
        return {}
