"""User-mode Linux: a Linux kernel that runs as an ordinary program, used for its CAN modules. The virtual machine
mounts the caller's files (hostfs) below an overlay in memory, so that a command may write anywhere and the caller's
files stay unchanged. Debian's package ``user-mode-linux`` contains kernel and modules; it needs neither KVM nor root.
`init.sh`, the first process of the machine, runs the command.
"""

import contextlib
import os
import re
import selectors
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.resources import as_file, files
from pathlib import Path
from typing import IO

from canopen_device.visible_text import visible
from tipforce.errors import EnvironmentLackError, InputError
from tipforce_tools.kernel import host
from tipforce_tools.kernel.host import ELSEWHERE, PREFIX, find_program, require_parts, short_temporary_folder

PIPE_CLOSED = 141  # 128 + SIGPIPE: the shell's exit code for a writer whose reader closed the pipe
BOOT_LIMIT_S = 120.0
HALT_LIMIT_S, _KILL_LIMIT_S = 10.0, 5.0
_LOOK_S = 0.05
_LINE_S = 10.0  # between two lines while it boots
_MCONSOLE_MAGIC, _MCONSOLE_VERSION = 0xCAFEBABE, 2  # arch/um/drivers/mconsole.h
_COMPILERS = ("gcc", "cc", "clang")
_INSTALL = "`apt-get install -y gcc libc6-dev` (as root)"

# Start the kernel and, in the same process group, a process that waits for the end of the pipe on stdin and then kills
# the group: no process remains even if the caller is killed.
# The copy on 9 is needed: bash gives a background process /dev/null as stdin.
# Raise the limit of open files: the kernel keeps files of the caller open while they are cached, closed or not, and
# the usual limit of 1024 is too low.
_WATCHED = """exec 9<&0 </dev/null
ulimit -S -n "$(ulimit -H -n)" 2>/dev/null
{ read -r <&9; kill -KILL 0; } >/dev/null 2>&1 &
exec 9<&- "$@"
"""


def write_lists(folder: Path, **lists: Sequence[str | bytes]) -> None:
    """Write each list, NUL-terminated as `init.sh` reads it, to the file of its name; also the environment. Raises
    InputError for an item that holds a NUL."""
    for name, items in {"environment": [b"=".join(pair) for pair in os.environb.items()], **lists}.items():
        encoded = [os.fsencode(item) for item in items]
        if any(b"\0" in item for item in encoded):
            raise InputError("an argument or a variable contains a NUL byte, which exec does not allow")
        (folder / name).write_bytes(b"".join(item + b"\0" for item in encoded))


def run_in_uml(
    command: Sequence[str], interfaces: Sequence[str], memory: str, timeout_s: float | None, writable: bool
) -> int:
    """Boot, run the command, halt; return as `run_here` does. Raises EnvironmentLackError if it does not boot."""
    require_parts()
    terminal = _on_terminal()
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=short_temporary_folder()) as name, _terminal_kept(terminal):
        folder, access = Path(name), "write" if writable else "layer"
        settings = [os.getcwd(), access, "terminal" if terminal else "pipes", _terminal_size(), os.uname().nodename]
        write_lists(folder, settings=[*settings, *interfaces], command=command)
        (folder / "init.sh").write_bytes(files("tipforce_tools.kernel").joinpath("init.sh").read_bytes())
        (folder / "init.sh").chmod(0o700)
        try:
            with contextlib.closing(_Machine(folder, memory, terminal, writable)) as machine:
                return machine.follow(timeout_s)
        except KeyboardInterrupt:
            return host.INTERRUPTED
        except BrokenPipeError:
            return PIPE_CLOSED


class _Machine:
    def __init__(self, folder: Path, memory: str, terminal: bool, writable: bool) -> None:
        self.folder = folder
        kernel = [
            find_program("linux.uml") or "linux.uml", f"mem={memory}", f"uml_dir={folder}/", "umid=machine",
            "rootfstype=hostfs", "root=/dev/root", "rw" if writable else "ro",
            f"init={folder}/init.sh", "con=null", "con0=null,fd:1", "quiet",
        ]  # fmt: skip
        self.selector = selectors.DefaultSelector()
        self.reading: list[int] = []
        with contextlib.ExitStack() as given:
            if terminal:
                fds = [os.dup(0), os.dup(1)]
                consoles = [f"con1=fd:{fds[0]},fd:{fds[1]}"]
            else:
                fds = [self._pipe_to(1), self._pipe_to(2)]
                consoles = [f"con1=null,fd:{fds[0]}", f"con2=null,fd:{fds[1]}"]
            alive, self.ours = os.pipe()
            for fd in (*fds, alive):
                given.callback(os.close, fd)
            log: IO[bytes] = given.enter_context((folder / "log").open("wb"))
            self.process = subprocess.Popen(
                ["bash", "-c", _WATCHED, "vcan", *kernel, *consoles],
                stdin=alive, stdout=log, stderr=subprocess.STDOUT, pass_fds=fds, start_new_session=True,
                env={"PATH": host.SYSTEM_PATH, "TMPDIR": memory_folder(memory, folder), **preloading(folder)},
            )  # fmt: skip

    def _pipe_to(self, target: int) -> int:
        read_end, write_end = os.pipe()
        self.reading.append(read_end)
        self.selector.register(read_end, selectors.EVENT_READ, target)
        return write_end

    def close(self) -> None:
        # Helper processes of the kernel and the programs inside belong to the group that start_new_session created.
        """End what still runs."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        end_s = time.monotonic() + _KILL_LIMIT_S
        while time.monotonic() < end_s and self._lives():  # kill is asynchronous
            time.sleep(0.005)
        self.selector.close()
        for fd in (*self.reading, self.ours):
            os.close(fd)

    def _lives(self) -> bool:
        """Return whether a process of the group is left that is no zombie."""
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError, ValueError):
                # proc(5): after the name in brackets come state, parent, group
                state, _, group = stat.read_text(errors="replace").rpartition(")")[2].split()[:3]
                if state not in "ZX" and int(group) == self.process.pid:
                    return True
        return False

    def follow(self, timeout_s: float | None) -> int:
        """Copy the output until the machine has halted; return the command's exit code."""
        begin = quiet_since = said = time.monotonic()
        started: float | None = None  # the command's time begins when it does
        while True:
            ended = self.process.poll() is not None
            now = time.monotonic()
            if started is None and self._file("started") is not None:
                started = now
            if started is None and now - said > _LINE_S:
                said = now
                print(f"tipforce vcan: User-mode Linux boots, {now - begin:.0f} s\r", file=sys.stderr)
            if self._copy_output():
                quiet_since = time.monotonic()
            elif ended or (self._file("status") and now - quiet_since > HALT_LIMIT_S):
                return self._exit_code()
            if started is None and now - begin > BOOT_LIMIT_S:
                raise self._failure(f"User-mode Linux did not boot within {BOOT_LIMIT_S:g} s ({ELSEWHERE})")
            late = started is not None and timeout_s is not None and now - started > timeout_s
            if late and not self._file("status"):
                print(f"tipforce vcan: the command was ended after {timeout_s:g} s (--timeout)", file=sys.stderr)
                return 1

    def _copy_output(self) -> bool:
        """Pass on output, with a short wait; return False if none arrived."""
        arrived = False
        if not self.selector.get_map():
            time.sleep(0.05)
        for key, _ in self.selector.select(0.05):
            data = os.read(key.fd, 65536)
            if not data:
                self.selector.unregister(key.fd)
                continue
            arrived = True
            while data:
                data = data[os.write(key.data, data) :]
        return arrived

    def _file(self, name: str) -> str | None:
        path = self.folder / name
        # An empty status file is still being written.
        return path.read_text() if path.exists() and (name == "started" or path.stat().st_size) else None

    def _exit_code(self) -> int:
        status = self._file("status")
        if status is not None:
            return int(status)
        cause = "ended before the command did (out of memory? try a larger --memory)"
        if failed := self._file("failed"):
            cause = f"booted, but {failed.strip()}"
        elif self._file("started") is None:
            cause = f"ended before it had booted ({ELSEWHERE})"
        raise self._failure(f"User-mode Linux {cause}")

    def _failure(self, what: str) -> EnvironmentLackError:
        log = (self.folder / "log").read_text(errors="replace").splitlines()[-15:]
        return EnvironmentLackError("\n".join([f"{what}; its last messages were:", *(f"  {line}" for line in log)]))


def _on_terminal() -> bool:
    return all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr))


def _terminal_size() -> str:
    columns, rows = os.get_terminal_size() if _on_terminal() else (0, 0)
    return f"{rows} {columns}" if rows and columns else ""


def memory_folder(memory: str, otherwise: Path) -> str:
    """Return the folder of the machine's memory: /dev/shm if it is large enough and executable, else `otherwise`. A
    container's /dev/shm is often 64 MB and noexec; the machine would crash at the first page beyond it."""
    if os.access("/dev/shm", os.W_OK):
        shm = os.statvfs("/dev/shm")
        if not shm.f_flag & os.ST_NOEXEC and shm.f_bavail * shm.f_frsize >= memory_bytes(memory):
            return "/dev/shm"
    return str(otherwise)


def memory_bytes(memory: str) -> int:
    """``"512M"`` -> 536870912. Raises InputError for anything but a number with K, M or G."""
    match = re.fullmatch(r"([1-9][0-9]*)([KMG])", memory, re.IGNORECASE)
    if match is None:
        raise InputError(f"--memory {memory}: expected a number with K, M or G, for instance 2G")
    return int(match[1]) << {"K": 10, "M": 20, "G": 30}[match[2].upper()]


@contextlib.contextmanager
def _terminal_kept(terminal: bool) -> Iterator[None]:
    before = termios.tcgetattr(0) if terminal else None
    try:
        yield
    finally:
        if before is not None:
            termios.tcsetattr(0, termios.TCSADRAIN, before)


def preloading(folder: Path, cpuinfo: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """Return the variable that preloads whole_xstate.c, built in `folder`; without a compiler nothing, and say so.

    Without it linux.uml crashes at boot on a processor with AMX; built for all, the code of a few is tested on all.
    Raises EnvironmentLackError, in one line, where the processor needs it and no compiler works."""
    lack, library = "none is installed", folder / "whole_xstate.so"
    if compiler := next(filter(None, map(shutil.which, _COMPILERS)), None):
        with as_file(files("tipforce_tools.kernel").joinpath("whole_xstate.c")) as source:
            words = [compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(source)]
            built = subprocess.run(words, capture_output=True, check=False, env={**os.environ, "LC_ALL": "C"})
        if not built.returncode:
            return {"LD_PRELOAD": str(library)}
        said = built.stderr.decode(errors="replace").strip().splitlines() or ["nothing"]
        lack = f"{compiler} failed ({said[0]})"
    text = f"User-mode Linux on a processor with AMX needs a C compiler, and {lack}: {_INSTALL}"
    if cpuinfo.exists() and "amx_tile" in cpuinfo.read_text().split():
        raise EnvironmentLackError(text)
    print(f"tipforce vcan: {text}; this processor does not need it", file=sys.stderr)
    return {}


def run_with_vcan(
    command: Sequence[str], *, interfaces: Sequence[str] = ("vcan0", "vcan1"), memory: str = "2G",
    timeout_s: float | None = None, place: str = "auto", writable: bool = False, announced: bool = False,
) -> int:  # fmt: skip
    """Run `command` where all `interfaces` are vcan buses and up; return its exit code, or that of `run_here`.

    `memory` and `writable` (let the command write the caller's files) apply to User-mode Linux only. `announced`: first
    say where it runs. Raises InputError for an argument, EnvironmentLackError naming what to install for vcan."""
    for name in interfaces:
        if re.fullmatch(r"[A-Za-z][\w.-]{0,14}", name, re.ASCII) is None:
            raise InputError(f"--interfaces: {name!r}: allowed are a letter, then up to 14 letters, digits, . _ or -")
    if not interfaces or len(set(interfaces)) != len(interfaces):
        raise InputError(f"--interfaces {','.join(interfaces)}: expected distinct names, for example vcan0,vcan1")
    memory_bytes(memory)
    if shutil.which(command[0]) is None:
        print(f"tipforce vcan: {visible(command[0])}: command not found", file=sys.stderr)
        return 127  # as a shell reports it
    # Flush, so that earlier output precedes that of the command.
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    chosen = host.choose(interfaces, place)
    if announced:
        kernel, ends = "this kernel", "`exit` ends the shell"
        if chosen == "uml":
            kept = "--rw: files that you write are kept"
            lost = "files that you write are lost on exit (--rw keeps them)"
            kernel, ends = "User-mode Linux", f"you are root; {kept if writable else lost}"
        print(f"tipforce vcan: {kernel}, with {', '.join(interfaces)}; {ends}", file=sys.stderr, flush=True)
    if chosen == "uml":
        return run_in_uml(command, interfaces, memory, timeout_s, writable)
    return host.run_here(host.namespace_command(interfaces, command) if chosen == "namespace" else command, timeout_s)


# A command beside that of a running `tipforce vcan`, on the same buses.
# Each run has a folder: of this kernel it holds the number of the process, of User-mode Linux all that is exchanged.


def run_attached(command: Sequence[str], shell: Callable[[], list[str]], timeout_s: float | None = None) -> int:
    """Run ``command``, or ``shell()``, on the buses of the user's latest `tipforce vcan`; return its exit code. Raises
    EnvironmentLackError if none runs."""
    folders = []
    for folder in Path(short_temporary_folder()).glob(f"{PREFIX}*"):
        with contextlib.suppress(FileNotFoundError):  # its run has ended meanwhile
            found = folder.stat()
            folders += [(found.st_mtime, folder)] if found.st_uid == os.geteuid() else []
    for _, folder in sorted(folders, reverse=True):
        of_namespace, of_machine = folder / host.PROCESS, folder / "machine" / "pid"
        process = _text(of_namespace) or _text(of_machine)
        if not process or not Path("/proc", process).exists():  # it was killed
            continue
        if of_namespace.exists():
            user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
            enter = [find_program("nsenter") or "nsenter", "--target", process, *user, "--net", "--mount"]
            return host.run_here([*enter, f"--wdns={os.getcwd()}", "--", *(command or shell())], timeout_s)
        if (folder / "started").exists() and not (folder / "status").exists():
            return _in_machine(folder, command or shell(), timeout_s)
    raise EnvironmentLackError("--attach: no `tipforce vcan` of yours runs; start one in another terminal")


def _in_machine(folder: Path, command: Sequence[str], timeout_s: float | None) -> int:
    """Leave the request in the folder, where the machine looks for it; copy the output until it has a status."""
    terminal = _on_terminal()
    place = Path(tempfile.mkdtemp(prefix="attach-", dir=folder))
    settings = [os.getcwd(), _terminal_size(), _console(folder) if terminal else ""]
    write_lists(place, settings=settings, command=command)
    end_s = time.monotonic() + (timeout_s or float("inf"))
    with (place / "stdout").open("w+b") as out, (place / "stderr").open("w+b") as err, _terminal_kept(terminal):
        (place / "ready").touch()
        while True:
            # In this order: what the command left before the machine ended counts.
            over = not folder.exists() or (folder / "status").exists() or time.monotonic() > end_s
            status = _text(place / "status")
            for file, stream in ((out, sys.stdout), (err, sys.stderr)):
                stream.flush()
                os.write(stream.fileno(), file.read())
            if status:
                return int(status)
            if over:
                print("tipforce vcan: the command was ended, with its machine or after --timeout\r", file=sys.stderr)
                return 1
            time.sleep(_LOOK_S)


def _text(file: Path) -> str:
    """Return the words of a file; empty while there is none."""
    with contextlib.suppress(FileNotFoundError):
        return file.read_text().strip()
    return ""


def _console(folder: Path) -> str:
    """Give this terminal to the machine as one more console, by the kernel's management socket; return its number."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as management:
        management.bind("")  # an address for the answer
        management.settimeout(10.0)
        management.connect(str(folder / "machine" / "mconsole"))
        for number in range(3, 16):  # a console in use is refused
            request = f"config con{number}=tty:{os.ttyname(0)}".encode()
            management.send(struct.pack("=3I512s", _MCONSOLE_MAGIC, _MCONSOLE_VERSION, len(request), request))
            if management.recv(1024)[:4] == bytes(4):
                return str(number)
    raise EnvironmentLackError("--attach: this User-mode Linux has no console left; end another attached shell")
