"""A raw socket that shares no code with what is tested, and commands whose processes end with their test."""

import contextlib
import gc
import itertools
import multiprocessing
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Self

WAIT_S = 120.0  # only a test that fails waits so long: in User-mode Linux everything is slow
BUS = ("-i", "socketcan", "-c", "vcan0")
REPOSITORY = Path(__file__).parents[2]
NODE_ID = 5
SYNC, NMT = 0x80, 0x000
SDO_REQUEST, SDO_ANSWER, HEARTBEAT = 0x600, 0x580, 0x700
OPERATIONAL_BEAT = (HEARTBEAT + NODE_ID, b"\x05")
_FRAME = struct.Struct("=IB3x8s")  # struct can_frame, linux/can.h
_numbers = itertools.count()

# In User-mode Linux a command of `tipforce` takes 3 s, nearly all of it for its imports. So they are imported once, in
# a server that forks a process for each command; test_readme.py starts fresh interpreters.
_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(
    [
        "numpy", "can.cli", "can.interfaces.socketcan", "canopen", "tomllib", "importlib.resources.readers",
        "tipforce.host.configuration.calibration_file", "tipforce.host.configuration.configuration_file",
        "tipforce.host.network.find", "tipforce.host.hand.polled", "tipforce.host.hand.hand",
        "canopen_device.running.loop", "tipforce.fingertip.node", "canopen_device.running.store",
        "tipforce.dictionary.eds",
        "canopen_device.running.ports", "tipforce.sensor.structure.strain",
        *(f"tipforce_tools.cli.{name}" for name in ("main", "bus_flags", "service")), "tipforce.sources.layout_file",
        "tipforce_tools.node", "tipforce.scene.delivered",
        *(f"tipforce_tools.network.{name}" for name in ("nodes", "config", "hand", "sdo")),
        "tipforce_tools.calibrate.fit",
        "tipforce_tools.dump", "tipforce_tools.dump.session", "tipforce_tools.log", "tipforce_tools.replay",
        "tipforce.host.live.receiver", "tipforce.host.live.send",
    ]
)  # fmt: skip

Frame = tuple[int, bytes]


class RawBus:
    """A raw CAN socket: frames as (can_id with the flags of linux/can.h, data); ``only`` this identifier, if given."""

    def __init__(self, channel: str = "vcan0", only: int | None = None) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        if only is not None:
            self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", only, 0x7FF))
        self._socket.bind((channel,))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self, can_id: int, data: bytes = b"") -> None:
        self._socket.send(_FRAME.pack(can_id, len(data), data))

    def receive(self, timeout_s: float = WAIT_S) -> Frame:
        """The next frame. Raises TimeoutError."""
        self._socket.settimeout(timeout_s)
        can_id, length, data = _FRAME.unpack(self._socket.recv(_FRAME.size))
        return can_id, data[:length]

    def waiting(self) -> list[Frame]:
        """What has come and was not received yet."""
        found: list[Frame] = []
        with contextlib.suppress(BlockingIOError):
            while True:
                found.append(self.receive(0.0))
        return found

    def until(self, wanted: Callable[[Frame], bool], timeout_s: float = WAIT_S) -> list[Frame]:
        """Every frame up to the first that is ``wanted``, and that one. Raises TimeoutError."""
        deadline = time.monotonic() + timeout_s
        frames: list[Frame] = []
        while not frames or not wanted(frames[-1]):
            frames.append(self.receive(max(0.001, deadline - time.monotonic())))
        return frames

    def answers(self, node_id: int = NODE_ID) -> list[Frame]:
        """What the node has sent so far: all before its answer to one SDO request, because it answers in order."""
        self.send(SDO_REQUEST + node_id, bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0)))
        return self.until(lambda frame: frame[0] == SDO_ANSWER + node_id)[:-1]

    def start_node(self) -> None:
        """Operational, with a heartbeat every 20 ms (1017h): a clock of its own, and it soon notices a lost bus."""
        self.send(SDO_REQUEST + NODE_ID, b"\x2b\x17\x10\0\x14\0\0\0")
        self.until(lambda frame: frame[0] == SDO_ANSWER + NODE_ID)
        self.send(NMT, bytes((1, NODE_ID)))
        self.until(lambda frame: frame == OPERATIONAL_BEAT)

    def answers_a_sync(self) -> bool:
        """Does the node send its PDOs to a SYNC?"""
        self.send(SYNC)
        return {0x180 + NODE_ID, 0x280 + NODE_ID} <= {can_id for can_id, _ in self.answers()}


def is_boot_up(node_id: int) -> Callable[[Frame], bool]:
    """Is it the boot-up message of this node (CiA 301, 7.2.8.3.3)?"""
    return lambda frame: frame == (HEARTBEAT + node_id, b"\0")


class Command:
    """One `tipforce` command in a process of its own; its stdout and stderr go to files."""

    def __init__(self, words: Sequence[str], folder: Path) -> None:
        number = next(_numbers)
        self.words = tuple(words)
        self._outputs = [folder / f"{number}.{stream}" for stream in ("stdout", "stderr")]
        for path in self._outputs:
            path.touch()
        self._process = _context.Process(target=_run_here, args=(self.words, [str(p) for p in self._outputs]))
        self._process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    @property
    def stdout(self) -> str:
        return self._outputs[0].read_text()

    @property
    def stderr(self) -> str:
        return self._outputs[1].read_text()

    @property
    def ended(self) -> bool:
        return self._process.exitcode is not None

    def wait(self, timeout_s: float = WAIT_S) -> int:
        """Its exit code, or minus the number of the signal that ended it. Raises AssertionError after the time."""
        self._process.join(timeout_s)
        code = self._process.exitcode
        assert code is not None, f"tipforce {' '.join(self.words)} still runs after {timeout_s:g} s\n{self.stderr}"
        return code

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def end(self, number: int = signal.SIGTERM) -> int:
        self.send_signal(number)
        return self.wait()

    def close(self) -> None:
        if not self.ended:
            self.end(signal.SIGKILL)


Launch = Callable[..., Command]
"""The fixture that starts `tipforce WORDS`."""


def _run_here(words: Sequence[str], outputs: Sequence[str]) -> None:
    """In the forked process: be `tipforce WORDS`."""
    from tipforce_tools.cli.main import main

    gc.freeze()  # a collection that visits what was imported would copy all of it, which takes half a second
    for fd, path in zip((1, 2), outputs, strict=True):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, fd)
        os.close(file)
    sys.exit(main(words))


@contextlib.contextmanager
def running_node(folder: Path, *flags: str, node_id: int = NODE_ID, channel: str = "vcan0") -> Iterator[Command]:
    """A node that has sent its boot-up message, ended by SIGTERM unless the test ended it."""
    words = ["node", "--node-id", str(node_id), "-i", "socketcan", "-c", channel, "--layout", "I", *flags]
    with RawBus(channel) as bus:
        command = Command(words, folder)
        try:
            bus.until(is_boot_up(node_id))
        except TimeoutError:
            raise AssertionError(f"node {node_id} sent no boot-up message\n{command.stderr}") from None
        finally:
            if sys.exc_info()[0] is not None:
                command.close()
    try:
        yield command
    finally:
        command.close()


def ip_link(*words: str, check: bool = True) -> None:
    subprocess.run(["ip", "link", *words], check=check, capture_output=True, timeout=WAIT_S)


def wait_until(condition: Callable[[], bool], what: str, again: Callable[[], object] = lambda: None) -> None:
    """Poll until the condition holds, doing ``again`` before each look. Raises AssertionError after WAIT_S."""
    deadline = time.monotonic() + WAIT_S
    while True:
        again()
        if condition():
            return
        assert time.monotonic() < deadline, what
        time.sleep(0.02)
