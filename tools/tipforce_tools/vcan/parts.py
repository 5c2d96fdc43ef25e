"""Requirements of User-mode Linux on this machine: find missing parts, and name the command that installs them."""

import os
import shutil
from pathlib import Path

from tipforce.errors import EnvironmentLackError

ELSEWHERE = (
    "`tipforce demo`, the library and the log tools work without vcan, and nodes and hosts on UDP: "
    "-i udp_multicast -c 239.74.163.2; "
    "vcan works on any machine whose kernel has it (`sudo modprobe vcan`)"
)

# program (or file) -> the Debian package that contains it
_PROGRAMS = {"linux.uml": "user-mode-linux", "ip": "iproute2", "insmod": "kmod", "setsid": "util-linux"}
_MACHINES = ("x86_64", "i686", "i586", "i386")  # Debian builds the package for these
_MODULES = Path("/usr/lib/uml/modules")
SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


def missing_packages() -> list[str]:
    """Return the Debian packages that User-mode Linux needs and this machine lacks, sorted."""
    lacking = {package for name, package in _PROGRAMS.items() if find_program(name) is None}
    if not any(_MODULES.glob("*/kernel/drivers/net/can/vcan.ko*")):
        lacking.add("user-mode-linux")
    return sorted(lacking)


def find_program(name: str) -> str | None:
    """Return the path of a system program, also if the caller's PATH omits the sbin folders."""
    return shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", ""), SYSTEM_PATH]))


def require_parts() -> None:
    """Raise EnvironmentLackError with the command that installs what is missing."""
    lacking = missing_packages()
    if "user-mode-linux" in lacking and os.uname().machine not in _MACHINES:
        raise EnvironmentLackError(
            f"this kernel has no vcan, and User-mode Linux, which has it, exists for x86 only, not for "
            f"{os.uname().machine}; {ELSEWHERE}"
        )
    if lacking:
        raise EnvironmentLackError(
            "this kernel has no vcan, and User-mode Linux, which has it, is not installed completely: install it with "
            f"`apt-get install -y {' '.join(lacking)}` (as root); {ELSEWHERE}"
        )
