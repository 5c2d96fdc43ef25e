"""The library preloaded into linux.uml, which otherwise crashes at boot on a processor with AMX (whole_xstate.c).

It is built for each run on every processor, so that the code needed by a few is tested on all.
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
    """Return whether the floating-point state of this processor is larger than linux.uml expects."""
    try:
        return "amx_tile" in cpuinfo.read_text().split()
    except OSError:
        return False


def build(folder: Path) -> Path:
    """Compile the library into `folder`. Raises EnvironmentLackError, in one line, if no compiler works."""
    compiler = next((found for name in _COMPILERS if (found := shutil.which(name))), None)
    what = "User-mode Linux on a processor with AMX needs a C compiler"
    if compiler is None:
        raise EnvironmentLackError(f"{what}, and none is installed: {_INSTALL}")
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
    """Return the variable that preloads whole_xstate.c. Without a compiler: nothing, and a line on stderr.

    Raises EnvironmentLackError if this processor needs the library.
    """
    try:
        return {"LD_PRELOAD": str(build(folder))}
    except EnvironmentLackError as error:
        if is_needed():
            raise
        print(f"tipforce vcan: {error}; this processor does not need it", file=sys.stderr)
        return {}
