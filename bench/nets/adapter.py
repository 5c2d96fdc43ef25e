"""What needs the product's Python: the one file to change where internal names move. Runs in a process of its own.

adapter.py @bus SETUP      command lines from stdin, in this process, beside simulated nodes on a virtual bus
adapter.py @talk           the first line is a command that runs until Ctrl-C; the others are what is done meanwhile
adapter.py @rows SEED N [show]   sequences of a hand: a digest of the rows of each
adapter.py @api WHAT       public names
adapter.py @collector N M  processor time of a collector per row, N fingers, M frames a call
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import io
import json
import os
import re
import shlex
import signal
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
from can.interfaces import virtual

CHANNEL = "nets"
BUS: dict[str, Any] = {"interface": "virtual", "channel": CHANNEL}
WAIT_S = 10.0
PAGE = "http://127.0.0.1:8471/"


# --- where names of the product are used ----------------------------------------------------------------------------


def product_main() -> Callable[[list[str]], int]:
    """The command line's function, as pyproject.toml names it."""
    names: dict[str, Any] = {}
    exec(os.environ["NETS_MAIN"], names)
    return names["main"]  # type: ignore[no-any-return]


class Collector:
    """A hand's collector: frames (t_ns, identifier, data) in, rows out."""

    def __init__(self, fingers: int, wait_s: float, own_sync: bool, modulus: int, messages: Sequence[str]) -> None:
        from tipforce.host.frames.frame_array import frame_array

        try:
            from tipforce.host.hand.rows import Collector as Product
        except ImportError:  # of the reference
            from tipforce.host.hand.collector import Collector as Product  # type: ignore[import-untyped, no-redef]

        self.block = frame_array
        self.product = Product(range(1, fingers + 1), messages, wait_s=wait_s, own_sync=own_sync)
        self.product._numbers.modulus = modulus
        self.add = self.product.add

    def rows(self, frames: list[tuple[int, int, bytes]], now_s: float) -> Iterator[tuple[Any, ...]]:
        """The rows that become complete: number, time, numbered, and of each finger counter, reason, and values."""
        rows = self.product.add(self.block(frames), now_s)
        columns = [(name, rows.columns[name].tolist()) for name in sorted(rows.columns)]
        head = zip(
            rows.sync_ns.tolist(), rows.numbered.tolist(), rows.counter.tolist(), rows.reason.tolist(), strict=True
        )
        for at, (t_ns, numbered, counter, reason) in enumerate(head):
            yield (rows.first + at, t_ns, numbered, counter, reason, *((name, values[at]) for name, values in columns))

    def tally(self) -> dict[str, Any]:
        """Its counts, by name."""
        tally = self.product.tally
        return {
            name: np.asarray(getattr(tally, name)).tolist() for name in sorted(dir(tally)) if _is_value(tally, name)
        }


def recorded_observations(log: Any) -> Any:
    """Fingers of a log as observations."""
    try:
        from tipforce_robots.learning import recorded_observations as product
    except ImportError:  # its place before
        product = importlib.import_module("tipforce.learning").recorded_observations
    return product(log)


def grasp_env() -> Any:
    """The environment of the twin."""
    try:
        plug_in = importlib.import_module("tipforce_robots.mujoco")
    except ImportError:  # its place before
        plug_in = importlib.import_module("tipforce.mujoco")
    return plug_in.GraspEnv()


# --- nodes on a virtual bus, and command lines beside them ----------------------------------------------------------


@contextlib.contextmanager
def setup(name: str) -> Iterator[None]:
    """Nodes that run meanwhile."""
    import tipforce

    with contextlib.ExitStack() as stack:
        if name == "fingers":
            loads = {5: (4.4, 90.0, 45.0), 6: (2.0, -90.0, 80.0)}
            stack.enter_context(tipforce.simulated_hand([5, 6], loads, noise_microstrain=0.0, **BUS))
        elif name in ("lamp", "drive"):
            file = "in/lamp.eds" if name == "lamp" else "cia402"
            stack.enter_context(tipforce.simulated_device(file, 7, dict(BUS)))
        elif name == "unconfigured":
            stack.enter_context(tipforce.simulated_device("in/lamp.eds", 255, dict(BUS)))
        yield


def run_command(line: str) -> None:
    """Run one command line in this process; print what it prints."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    words = shlex.split(line.replace("{bus}", f"-i virtual -c {CHANNEL}"))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code: Any = product_main()(words)
        except SystemExit as error:
            code = error.code
        except Exception as error:  # a fault of the product: what is printed must not depend on where it lies
            code = f"raised {error!r}"
    texts = [stream.buffer.getvalue().decode() for stream in (out, err)]
    print(f"$ {line}\nexit {code}\n{texts[0]}--- stderr\n{texts[1]}", flush=True)


def bus(name: str) -> None:
    """Command lines beside nodes."""
    with setup(name):
        for line in sys.stdin.read().splitlines():
            run_command(line)


def talk() -> None:
    """A command that runs until Ctrl-C, and frames to it, from it, or requests of its page."""
    command, *steps = sys.stdin.read().splitlines()
    printed: list[str] = []
    with can.Bus(interface="virtual", channel=CHANNEL) as ear:
        ended = threading.Event()

        def work() -> None:
            try:
                _wait(lambda: ended.is_set() or "{bus}" not in command or len(virtual.channels[CHANNEL]) > 1)
                for step in steps:
                    printed.append(f"{step}{_step(ear, *step.split(maxsplit=1))}")
            except Exception as error:
                printed.append(repr(error))
            _wait(ended.is_set, 0.5)
            if not ended.is_set():
                os.kill(os.getpid(), signal.SIGINT)

        thread = threading.Thread(target=work)
        thread.start()
        run_command(command)
        ended.set()
        thread.join()
    print("\n".join(printed))


def _wait(condition: Callable[[], bool], limit_s: float = WAIT_S) -> None:
    end_s = time.monotonic() + limit_s
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.01)


def _step(ear: can.BusABC, word: str, rest: str = "") -> str:
    if word == "send":
        can_id, _, data = rest.partition("#")
        ear.send(can.Message(arbitration_id=int(can_id, 16), data=bytes.fromhex(data), is_extended_id=False))
    elif word == "wait":
        end_s = time.monotonic() + WAIT_S
        while time.monotonic() < end_s:
            found = ear.recv(0.1)
            if found is not None and found.arbitration_id == int(rest, 16):
                return f" {found.data.hex().upper()}"
        return " nothing"
    elif word == "get":
        with urllib.request.urlopen(f"{PAGE}{rest}", timeout=WAIT_S) as answer:
            return f" {answer.status} {hashlib.sha256(answer.read()).hexdigest()}"
    elif word == "ask":
        return _asked(rest)
    elif word == "serving":
        _wait(_serves)
    return ""


def _serves() -> bool:
    try:
        return bool(urllib.request.urlopen(PAGE, timeout=WAIT_S).status)
    except OSError:
        return False


def _asked(request: str) -> str:
    """The answer of the page's server: its text, and the digest of the data before."""
    from websockets.sync.client import connect
    from websockets.typing import Origin

    data = b""
    with connect(f"{PAGE}live".replace("http", "ws"), origin=Origin(PAGE.rstrip("/")), max_size=None) as page:
        page.send(request)
        while isinstance(message := page.recv(timeout=WAIT_S), bytes):
            data += message
    return f" {len(data)} {hashlib.sha256(data).hexdigest()} {message}"


# --- sequences of a hand --------------------------------------------------------------------------------------------


def rows(first: int, count: int, show: bool = False) -> None:
    """Print the digest of each sequence's rows and counts; ``show``: the rows."""
    from bench.nets.sequences import calls

    for seed in range(first, first + count):
        options, blocks = calls(seed)
        collector = Collector(**options)
        lines = [repr(row) for frames, now_s in blocks for row in collector.rows(frames, now_s)]
        lines.append(repr(collector.tally()))
        print(*lines, sep="\n") if show else print(
            seed, len(lines), hashlib.sha256("\n".join(lines).encode()).hexdigest()
        )


def collector_us(fingers: int, frames: int) -> None:
    """Print microseconds of processor time per row, of numbered SYNCs with a contact of each finger."""
    from bench.nets.sequences import steady

    collector = Collector(fingers, 0.02, True, 240, ("Contact",))
    total, found = steady(fingers)
    blocks = [collector.block(found[at : at + frames]) for at in range(0, len(found), frames)]
    start_ns = time.process_time_ns()
    made = sum(len(collector.add(block, number * 1e-3)) for number, block in enumerate(blocks))
    spent_ns = time.process_time_ns() - start_ns
    if made != total:
        raise SystemExit(f"{made} rows of {total}")
    print(spent_ns / 1000 / total)


# --- public names ---------------------------------------------------------------------------------------------------


def api(what: str) -> None:
    """What public functions return."""
    import tipforce

    if what == "logs":
        for path in sorted(Path("in").iterdir()):
            if re.search(r"\.(log|gz|zst|asc|blf|pcap|trc)$", path.name) and path.name != "large.log":
                _log(tipforce, path)
    elif what == "calibration":
        calibration = tipforce.Calibration.read("in/made/cal.toml")
        print(
            {name: str(getattr(calibration, name)) for name in sorted(dir(calibration)) if _is_value(calibration, name)}
        )
        strains = np.random.default_rng(1).normal(0, 300, (50, 3))
        _print_columns("estimate", tipforce.estimate(calibration, strains))
        print(repr(tipforce.estimate(calibration, strains[0])))
    elif what == "observations":
        found = recorded_observations(tipforce.read_log("in/made/grasp.log"))
        _print_columns("observations", found)
        _print_columns("windows", found.windows(length=64, stride=16))
    elif what == "twin":
        env = grasp_env()
        found, _ = env.reset(seed=1)
        for _ in range(60):
            found, reward, *_ = env.step(found["asked_newtons"] / 6.0)
            print({name: np.asarray(value).tolist() for name, value in sorted(found.items())}, reward)
    elif what == "names":
        for name in sorted(vars(tipforce)["__all__"]):
            print(name, *sorted(member for member in dir(getattr(tipforce, name)) if not member.startswith("_")))


def _is_value(holder: Any, name: str) -> bool:
    return not name.startswith("_") and not callable(getattr(holder, name))


def _log(tipforce: Any, path: Path) -> None:
    try:
        log = tipforce.read_log(path)
    except tipforce.TipforceError as error:
        print(f"{path}: {type(error).__name__}: {error}")
        return
    for node_id in sorted(log):
        _print_columns(f"{path.name} {node_id}", log[node_id])


def _print_columns(title: str, holder: Any) -> None:
    """Each array of an object: name, type, shape, digest; other values as text."""
    for name in sorted(filter(lambda name: _is_value(holder, name), dir(holder))):
        value = getattr(holder, name)
        if isinstance(value, np.ndarray):
            data = np.ascontiguousarray(value)
            print(title, name, data.dtype, data.shape, hashlib.sha256(data.tobytes()).hexdigest()[:16])
        else:
            print(title, name, value if isinstance(value, int | float | str) else type(value).__name__)


def main(words: list[str]) -> None:
    """Run as a command."""
    command, *rest = words
    if command == "@bus":
        bus(rest[0])
    elif command == "@talk":
        talk()
    elif command == "@rows":
        rows(int(rest[0]), int(rest[1]), len(rest) > 2)
    elif command == "@api":
        api(rest[0])
    elif command == "@collector":
        collector_us(int(rest[0]), int(rest[1]))
    else:
        raise SystemExit(json.dumps(words))


if __name__ == "__main__":
    main(sys.argv[1:])
