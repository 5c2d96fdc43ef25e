"""What User-mode Linux needs of this machine: which parts are here, and what to do about those that are not."""

import os
import shutil
from pathlib import Path

from tipforce.errors import EnvironmentLackError

ELSEWHERE = (
    "`tipforce demo`, the library and the log tools work without vcan; "
    "vcan works on any machine whose kernel has it (`sudo modprobe vcan`)"
)

# program (or file) -> the Debian package that brings it
_PROGRAMS = {"linux.uml": "user-mode-linux", "ip": "iproute2", "insmod": "kmod", "setsid": "util-linux"}
_MACHINES = ("x86_64", "i686", "i586", "i386")  # Debian builds the package for these
_MODULES = Path("/usr/lib/uml/modules")
SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


def missing_packages() -> list[str]:
    """The Debian packages that this machine lacks for a run in User-mode Linux, sorted."""
    lacking = {package for name, package in _PROGRAMS.items() if find_program(name) is None}
    if not any(_MODULES.glob("*/kernel/drivers/net/can/vcan.ko*")):
        lacking.add("user-mode-linux")
    return sorted(lacking)


def find_program(name: str) -> str | None:
    """The path of a system program, also where the caller's PATH leaves the sbin folders out."""
    return shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", ""), SYSTEM_PATH]))


def require_parts() -> None:
    """Raise EnvironmentLackError with the command that installs what is missing."""
    lacking = missing_packages()
    if "user-mode-linux" in lacking and os.uname().machine not in _MACHINES:
        raise EnvironmentLackError(
            f"this kernel has no vcan, and User-mode Linux, which has, exists for x86 only, not for "
            f"{os.uname().machine}; {ELSEWHERE}"
        )
    if lacking:
        raise EnvironmentLackError(
            "this kernel has no vcan, and User-mode Linux, which has, is not complete here: install it with "
            f"`apt-get install -y {' '.join(lacking)}` (as root); {ELSEWHERE}"
        )
