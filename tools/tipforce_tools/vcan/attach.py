"""`tipforce vcan --attach`: a command beside the one that a running `tipforce vcan` runs, on the same buses.

Each run has a folder: of this kernel it holds the number of the process, of User-mode Linux all that is exchanged.
"""

import contextlib
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from tipforce.errors import EnvironmentLackError, InputError
from tipforce_tools.vcan import host, uml

_LOOK_S = 0.05


def run_attached(command: Sequence[str], shell: Callable[[], list[str]], timeout_s: float | None = None) -> int:
    """Run ``command``, or ``shell()``, on the buses of the latest `tipforce vcan` of this user; return its exit code.

    In User-mode Linux its stdin is /dev/null, so that a shell is refused with InputError. Raises EnvironmentLackError
    if none runs.
    """
    folders = sorted(Path(host.short_temporary_folder()).glob(f"{host.PREFIX}*"), key=lambda path: path.stat().st_mtime)
    for folder in reversed([folder for folder in folders if folder.stat().st_uid == os.geteuid()]):
        of_namespace, of_machine = folder / host.PROCESS, folder / "machine" / "pid"
        process = next((path.read_text().strip() for path in (of_namespace, of_machine) if path.exists()), "")
        if not process or not Path("/proc", process).exists():  # it was killed
            continue
        if of_namespace.exists():
            user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
            enter = [host.find_program("nsenter") or "nsenter", "--target", process, *user, "--net", "--mount"]
            return host.run_here([*enter, f"--wdns={os.getcwd()}", "--", *(command or shell())], timeout_s)
        if (folder / "started").exists() and not (folder / "status").exists():
            if not command:
                raise InputError("--attach: no second shell in User-mode Linux, which has one terminal; add -- COMMAND")
            return _in_machine(folder, command, timeout_s)
    raise EnvironmentLackError("--attach: no `tipforce vcan` of yours runs; start one in another terminal")


def _in_machine(folder: Path, command: Sequence[str], timeout_s: float | None) -> int:
    """Leave the request in the folder, where the machine looks for it; copy the output until it has a status."""
    place = Path(tempfile.mkdtemp(prefix="attach-", dir=folder))
    uml.write_list(place / "settings", [os.getcwd()])
    uml.write_list(place / "command", command)
    uml.write_list(place / "environment", [name + b"=" + value for name, value in os.environb.items()])
    outputs = [((place / name), stream) for name, stream in (("stdout", sys.stdout), ("stderr", sys.stderr))]
    for path, _ in outputs:
        path.touch()
    (place / "ready").touch()
    end_s = time.monotonic() + (timeout_s or float("inf"))
    with contextlib.ExitStack() as opened:
        files = [(opened.enter_context(path.open("rb")), stream) for path, stream in outputs]
        while True:
            status = (place / "status").read_text() if (place / "status").exists() else ""
            for file, stream in files:
                stream.flush()
                os.write(stream.fileno(), file.read())
            if status.strip():
                return int(status)
            if not folder.exists() or (folder / "status").exists() or time.monotonic() > end_s:
                print("tipforce vcan: the command was ended, with its machine or after --timeout", file=sys.stderr)
                return 1
            time.sleep(_LOOK_S)
