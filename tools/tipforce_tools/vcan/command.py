"""`tipforce vcan [-- COMMAND ...]`: run a command on this kernel, in a namespace of it, or in User-mode Linux."""

import argparse
import os
import re
import shutil
import sys
from collections.abc import Sequence

from canopen_device.visible_text import visible
from tipforce.errors import EnvironmentLackError, InputError
from tipforce_tools.cli import common

DESCRIPTION = """\
Run COMMAND where vcan0 and vcan1 are up, and exit with its exit code. The first of these that works is used: this
kernel, if the interfaces are up; this kernel in a temporary network namespace, which leaves the host unchanged;
User-mode Linux, a kernel that runs as a program (apt-get install user-mode-linux). COMMAND has your directory and
environment. Without any vcan (macOS, containers) commands take -i udp_multicast -c 239.74.163.2.

In User-mode Linux COMMAND is root on one CPU. It can read your files; files that it writes are lost afterwards (--rw
keeps them, except for temporary files: TMPDIR is a folder in memory). stdin is /dev/null, and stdout and stderr are
pipes, unless all three are a terminal, which COMMAND then uses.
"""
EPILOG = """\
exit codes besides COMMAND's own: 1 after --timeout, 2 usage, 126 and 127 when COMMAND cannot be started, 128+n when
signal n ended it, 130 interrupted

  tipforce vcan --interfaces can0,can1,can2 -- python -m pytest tests/vcan
  tipforce vcan --attach -- tipforce scan -i socketcan -c vcan0          from another terminal
"""
NOT_FOUND = 127  # what a shell reports for a command that it cannot find
_KEPT = "--rw: files that you write are kept"
_LOST = "files that you write are lost on exit (--rw keeps them)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce vcan` to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument(
        "--interfaces", default="vcan0,vcan1", metavar="NAMES", help="buses to make (default: %(default)s)"
    )
    parser.add_argument("--memory", default="2G", metavar="SIZE", help="of User-mode Linux (default: %(default)s)")
    parser.add_argument("--timeout", type=common.seconds, metavar="S", help="end COMMAND after S seconds, exit with 1")
    parser.add_argument("--attach", action="store_true", help="run COMMAND on the buses of a running `tipforce vcan`")
    parser.add_argument("--rw", action="store_true", help="User-mode Linux: let COMMAND write your files")
    places = parser.add_mutually_exclusive_group()
    places.add_argument(
        "--uml", dest="place", action="store_const", const="uml", default="auto", help="use User-mode Linux"
    )
    places.add_argument(
        "--host", dest="place", action="store_const", const="host", help="use this kernel; an error if it has no vcan"
    )
    parser.add_argument(
        "command", nargs=argparse.REMAINDER, metavar="-- COMMAND ...", help="default: a shell, on a terminal"
    )


def run(args: argparse.Namespace) -> int:
    """Run the command or a shell. Raises InputError and EnvironmentLackError as `run_with_vcan` does."""
    if sys.platform != "linux":
        raise EnvironmentLackError(
            f"vcan exists on Linux only, and this is {sys.platform}; "
            "here -i udp_multicast -c 239.74.163.2 is a bus of UDP datagrams; `tipforce demo` and log tools work too"
        )
    command = args.command[1:] if args.command[:1] == ["--"] else args.command
    if args.attach:
        from tipforce_tools.vcan.attach import run_attached

        return run_attached(command, _shell, args.timeout)
    return run_with_vcan(
        command or _shell(),
        interfaces=[name.strip() for name in args.interfaces.split(",")],
        memory=args.memory,
        timeout_s=args.timeout,
        place=args.place,
        writable=args.rw,
        announced=not command,
    )


def _shell() -> list[str]:
    if not sys.stdin.isatty():
        raise InputError("no command, and stdin is not a terminal: add one after --, `tipforce vcan -- COMMAND ...`")
    shell = os.environ.get("SHELL", "")
    return [shell if shutil.which(shell) else "bash"]


def choose(interfaces: Sequence[str], place: str = "auto") -> str:
    """Return ``"direct"`` (the interfaces are up), ``"namespace"`` (this kernel can create them) or ``"uml"``.

    `place` restricts the choice. Raises EnvironmentLackError when it is ``"host"`` and this kernel has no vcan.
    """
    from tipforce.host.network.interfaces import interfaces as can_interfaces
    from tipforce_tools.vcan import host

    if place == "uml":
        return "uml"
    known = can_interfaces()
    if all(known.get(name) for name in interfaces):
        return "direct"
    if host.can_make(interfaces):
        return "namespace"
    if place == "host":
        raise EnvironmentLackError(
            f"--host: {', '.join(interfaces)} cannot be created on kernel {os.uname().release}. As root, "
            "`modprobe vcan` shows whether the kernel has it; without --host, User-mode Linux is used"
        )
    return "uml"


def run_with_vcan(
    command: Sequence[str],
    *,
    interfaces: Sequence[str] = ("vcan0", "vcan1"),
    memory: str = "2G",
    timeout_s: float | None = None,
    place: str = "auto",
    writable: bool = False,
    announced: bool = False,
) -> int:
    """Run `command` where all `interfaces` are vcan buses and up; return the command's own exit code.

    Directory and environment are the caller's. Besides the command's own codes: 127 if it is not found, 126 if it
    cannot be started, 128 + n if signal n ended it, 130 after SIGINT or SIGTERM to this process, 1 (with a message
    on stderr) after `timeout_s`. `memory` and `writable` (let the command write the caller's files) apply to
    User-mode Linux only. `announced`: first print on stderr where the command runs. Raises InputError for an
    unusable argument and EnvironmentLackError if the machine cannot provide vcan; its text names what to install.
    """
    from tipforce_tools.vcan import host, uml

    _check(interfaces)
    uml.memory_bytes(memory)
    if shutil.which(command[0]) is None:
        print(f"tipforce vcan: {visible(command[0])}: command not found", file=sys.stderr)
        return NOT_FOUND
    # Flush, so that earlier output precedes that of the command.
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    chosen = choose(interfaces, place)
    if announced:
        exit_words = "`exit` ends the shell"
        if chosen == "uml":
            exit_words = f"you are root; {_KEPT if writable else _LOST}"
        kernel = "User-mode Linux" if chosen == "uml" else "this kernel"
        print(f"tipforce vcan: {kernel}, with {', '.join(interfaces)}; {exit_words}", file=sys.stderr, flush=True)
    if chosen == "uml":
        return uml.run_in_uml(command, interfaces, memory, timeout_s, writable)
    return host.run_here(host.namespace_command(interfaces, command) if chosen == "namespace" else command, timeout_s)


def _check(interfaces: Sequence[str]) -> None:
    for name in interfaces:
        if re.fullmatch(r"[A-Za-z][\w.-]{0,14}", name, re.ASCII) is None:
            raise InputError(f"--interfaces: {name!r}: allowed are a letter, then up to 14 letters, digits, . _ or -")
    if not interfaces or len(set(interfaces)) != len(interfaces):
        raise InputError(f"--interfaces {','.join(interfaces)}: expected distinct names, for example vcan0,vcan1")
