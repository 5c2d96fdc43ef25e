"""Where a command finds vcan: this machine, its programs, a namespace of its kernel; else User-mode Linux."""

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tipforce.errors import EnvironmentLackError
from tipforce.host.network.interfaces import interfaces as can_interfaces

INTERRUPTED = 130
PREFIX = "tipforce-vcan-"
"""Of the folder of a run, in the folder of temporary files."""
PROCESS = "process"
"""The file in it with the number of a process on this kernel, for which the buses are up."""
_PROCESS_FILE = "TIPFORCE_VCAN_PROCESS"
ELSEWHERE = (
    "`tipforce demo`, the library and the log tools work without vcan, and nodes and hosts on UDP: "
    "-i udp_multicast -c 239.74.163.2; vcan works on any machine whose kernel has it (`sudo modprobe vcan`)"
)

# program (or file) -> the Debian package that contains it
_PROGRAMS = {"linux.uml": "user-mode-linux", "ip": "iproute2", "insmod": "kmod", "setsid": "util-linux"}
_MACHINES = ("x86_64", "i686", "i586", "i386")  # Debian builds the package for these
_MODULES = Path("/usr/lib/uml/modules")
SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

# Run inside a separate network namespace: NAME... -- COMMAND. A new sysfs mount shows the namespace's interfaces.
_MAKE_BUSES = """set -e
mount -t sysfs sysfs /sys 2>/dev/null || true
ip link set lo up
while [ "$1" != -- ]; do ip link add dev "$1" type vcan; ip link set up "$1"; shift; done
shift
if [ "$TIPFORCE_VCAN_PROCESS" ]; then echo $$ >"$TIPFORCE_VCAN_PROCESS"; unset TIPFORCE_VCAN_PROCESS; fi
exec -- "$@"
"""


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
    lacking, machine = missing_packages(), os.uname().machine
    if lacking:
        install = f"is not installed completely: install it with `apt-get install -y {' '.join(lacking)}` (as root)"
        if "user-mode-linux" in lacking and machine not in _MACHINES:
            install = f"exists for x86 only, not for {machine}"
        raise EnvironmentLackError(
            f"this kernel has no vcan, and User-mode Linux, which has it, {install}; {ELSEWHERE}"
        )


def namespace_command(interfaces: Sequence[str], command: Sequence[str]) -> list[str]:
    """Return the command that runs `command` in a new network namespace with `interfaces`, all up."""
    # An ordinary user can be root in a new user namespace, if the kernel allows it.
    as_root = [] if os.geteuid() == 0 else ["--map-root-user"]
    unshare = [find_program("unshare") or "unshare", *as_root, "--net", "--mount"]
    return [*unshare, "bash", "-c", _MAKE_BUSES, "vcan", *interfaces, "--", *command]


def can_make(interfaces: Sequence[str]) -> bool:
    """Return whether this kernel can create the interfaces in a namespace. Tries it; a loaded module may remain."""
    if find_program("ip") is None or find_program("unshare") is None:
        return False
    if (modprobe := find_program("modprobe")) and os.geteuid() == 0:
        subprocess.run([modprobe, "-q", "-a", "vcan", "can-raw"], capture_output=True, check=False)
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    trial = subprocess.run(namespace_command(interfaces, ["true"]), capture_output=True, check=False)
    return trial.returncode == 0


def short_temporary_folder() -> str:
    """Return the folder of temporary files, or /tmp where its name does not fit."""
    # The path is part of a kernel command line (no blanks) and of a socket name (at most 107 characters).
    folder = tempfile.gettempdir()
    return folder if re.fullmatch(r"[\w./+-]{1,50}", folder, re.ASCII) else "/tmp"


def run_here(command: Sequence[str], timeout_s: float | None = None) -> int:
    """Run `command` on this kernel with this terminal and environment; return its exit code (128 + n for signal n). 130
    after SIGINT or SIGTERM; 1, with a message, after the timeout; 126 or 127 when it cannot be started."""
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=short_temporary_folder()) as folder:
        return _run(command, timeout_s, Path(folder, PROCESS))  # `tipforce vcan --attach` finds it there


def _run(command: Sequence[str], timeout_s: float | None, process_file: Path) -> int:
    # A process that makes its buses enters its number itself, when they are up.
    environment = {**os.environ, _PROCESS_FILE: str(process_file)} if _MAKE_BUSES in command else None
    # On a terminal the command must stay in the foreground process group, which receives Ctrl-C.
    own_group = sys.stdin is None or not sys.stdin.isatty()
    try:
        process = subprocess.Popen(list(command), process_group=0 if own_group else None, env=environment)
    except OSError as error:
        print(f"tipforce vcan: {command[0]}: {error.strerror}", file=sys.stderr)
        return 127 if isinstance(error, FileNotFoundError) else 126
    try:
        if environment is None:
            process_file.write_text(str(process.pid))
        code = process.wait(timeout_s)
        return code if code >= 0 else 128 - code
    except subprocess.TimeoutExpired:
        print(f"tipforce vcan: the command was ended after {timeout_s:g} s (--timeout)", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        for number in (signal.SIGTERM, signal.SIGKILL):  # the second after five seconds
            if process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    (os.killpg if own_group else os.kill)(process.pid, number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(5.0)


def choose(interfaces: Sequence[str], place: str = "auto") -> str:
    """Return ``"direct"`` (the interfaces are up), ``"namespace"`` (this kernel can create them) or ``"uml"``. `place`
    restricts the choice. Raises EnvironmentLackError when it is ``"host"`` and this kernel has no vcan."""
    if place == "uml":
        return "uml"
    known = can_interfaces()
    if all(known.get(name) for name in interfaces):
        return "direct"
    if can_make(interfaces):
        return "namespace"
    if place == "host":
        raise EnvironmentLackError(
            f"--host: {', '.join(interfaces)} cannot be created on kernel {os.uname().release}. As root, "
            "`modprobe vcan` shows whether the kernel has it; without --host, User-mode Linux is used"
        )
    return "uml"
