"""Run COMMAND where vcan0 and vcan1 are up, and exit with its exit code. The first of these that works is used: this
kernel, if the interfaces are up; this kernel in a temporary network namespace, which leaves the host unchanged;
User-mode Linux, a kernel that runs as a program (apt-get install user-mode-linux). COMMAND has your directory and
environment. Without any vcan (macOS, containers) commands take -i udp_multicast -c 239.74.163.2.

In User-mode Linux COMMAND is root on one CPU. It can read your files; files that it writes are lost afterwards (--rw
keeps them, except for temporary files: TMPDIR is a folder in memory). stdin is /dev/null, and stdout and stderr are
pipes, unless all three are a terminal, which COMMAND then uses."""

import argparse
import os
import shutil
import sys

from tipforce.errors import EnvironmentLackError, InputError
from tipforce_tools.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """exit codes besides COMMAND's own: 1 after --timeout, 2 usage, 126 and 127 when COMMAND cannot be started, 128+n
    when signal n ended it, 130 interrupted

      tipforce vcan --interfaces can0,can1,can2 -- python -m pytest tests/vcan
      tipforce vcan --attach                 from another terminal: a second shell on the same buses
    """
    parser.description = __doc__
    parser.add_argument("--interfaces", default="vcan0,vcan1", metavar="NAMES", help="buses to make (%(default)s)")
    parser.add_argument("--memory", default="2G", metavar="SIZE", help="of User-mode Linux (default: %(default)s)")
    parser.add_argument("--timeout", type=common.seconds, metavar="S", help="end COMMAND after S seconds, exit with 1")
    what = "COMMAND or a shell on the buses of a running `tipforce vcan`"
    parser.add_argument("--attach", action="store_true", help=what)
    parser.add_argument("--rw", action="store_true", help="User-mode Linux: let COMMAND write your files")
    places = parser.add_mutually_exclusive_group()
    parser.set_defaults(place="auto")
    for place, what in (("uml", "use User-mode Linux"), ("host", "use this kernel; an error if it has no vcan")):
        places.add_argument(f"--{place}", dest="place", action="store_const", const=place, help=what)
    parser.add_argument("command", nargs=argparse.REMAINDER, metavar="-- COMMAND ...", help="default: a shell")


def run(args: argparse.Namespace) -> int:
    """Run the command or a shell. Raises InputError and EnvironmentLackError as `run_with_vcan` does."""
    if sys.platform != "linux":
        raise EnvironmentLackError(
            f"vcan exists on Linux only, and this is {sys.platform}; "
            "here -i udp_multicast -c 239.74.163.2 is a bus of UDP datagrams; `tipforce demo` and log tools work too"
        )
    command = args.command[1:] if args.command[:1] == ["--"] else args.command
    from tipforce_tools.kernel.uml import run_attached, run_with_vcan

    if args.attach:
        return run_attached(command, _shell, args.timeout)
    return run_with_vcan(
        command or _shell(), interfaces=[name.strip() for name in args.interfaces.split(",")], memory=args.memory,
        timeout_s=args.timeout, place=args.place, writable=args.rw, announced=not command,
    )  # fmt: skip


def _shell() -> list[str]:
    if not sys.stdin.isatty():
        raise InputError("no command, and stdin is not a terminal: add one after --, `tipforce vcan -- COMMAND ...`")
    shell = os.environ.get("SHELL", "")
    return [shell if shutil.which(shell) else "bash"]
