"""Choose where a command runs with vcan: on this kernel, in a namespace of it, or in User-mode Linux."""

import os
import re
import shutil
import sys
from collections.abc import Sequence

from canopen_device.visible_text import visible
from tipforce.errors import EnvironmentLackError, InputError
from tipforce_tools.vcan import host, uml

PLACES = ("auto", "host", "uml")
NOT_FOUND = 127  # what a shell reports for a command that it cannot find


def choose(interfaces: Sequence[str], place: str = "auto") -> str:
    """Return ``"direct"`` (the interfaces are up), ``"namespace"`` (this kernel can create them) or ``"uml"``.

    `place` restricts the choice. Raises EnvironmentLackError when it is ``"host"`` and this kernel has no vcan.
    """
    if place == "uml":
        return "uml"
    if all(host.is_up(name) for name in interfaces):
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
    _check(command, interfaces, timeout_s, place)
    uml.memory_bytes(memory)
    if shutil.which(command[0]) is None:
        print(f"tipforce vcan: {visible(command[0])}: command not found", file=sys.stderr)
        return NOT_FOUND
    # Flush, so that earlier output precedes that of the command.
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    chosen = choose(interfaces, place)
    if announced:
        print(_banner(chosen, interfaces, writable), file=sys.stderr, flush=True)
    if chosen == "direct":
        return host.run_here(command, timeout_s)
    if chosen == "namespace":
        return host.run_here(host.namespace_command(interfaces, command), timeout_s)
    return uml.run_in_uml(command, interfaces, memory, timeout_s, writable)


def _banner(chosen: str, interfaces: Sequence[str], writable: bool) -> str:
    """Return the line printed before a shell starts."""
    buses = ", ".join(interfaces)
    if chosen != "uml":
        return f"tipforce vcan: this kernel, with {buses}; `exit` ends the shell"
    kept = (
        "--rw: files that you write are kept" if writable else "files that you write are lost on exit (--rw keeps them)"
    )
    return f"tipforce vcan: User-mode Linux, with {buses}; you are root; {kept}"


def _check(command: Sequence[str], interfaces: Sequence[str], timeout_s: float | None, place: str) -> None:
    if not command:
        raise InputError("no command to run: add one after --, for example `tipforce vcan -- ip -br link`")
    for name in interfaces:
        if re.fullmatch(r"[A-Za-z][\w.-]{0,14}", name, re.ASCII) is None:
            raise InputError(f"--interfaces: {name!r}: allowed are a letter, then up to 14 letters, digits, . _ or -")
    if not interfaces or len(set(interfaces)) != len(interfaces):
        raise InputError(f"--interfaces {','.join(interfaces)}: expected distinct names, for example vcan0,vcan1")
    if timeout_s is not None and not 0 < timeout_s < float("inf"):
        raise InputError(f"--timeout {timeout_s:g}: expected seconds above 0")
    if place not in PLACES:
        raise InputError(f"place {place!r}: allowed are {', '.join(PLACES)}")
