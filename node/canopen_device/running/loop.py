"""Run devices on a bus: pass received frames and the time in, send the frames that come out. One thread, many nodes.
And a store for devices that need none on disk."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from canopen_device.core import codes
from canopen_device.core.node import Device

Frame = tuple[int, bytes]

_LOG = logging.getLogger(__name__)
_IDLE_S = 0.2  # the longest wait: bounds the time until a loop notices a stop request


class Port(Protocol):
    """One connection to a bus: frames as (SocketCAN can_id, data). ports.py has SocketCAN and python-can."""

    def receive(self, timeout_s: float) -> Frame | None:
        """Return the next frame, error frames included, or None if none arrived in time."""

    def send(self, frames: Iterable[Frame]) -> None:
        """Send frames in order."""

    def request(self, what: str, value: int, delay_ms: int) -> None:
        """Execute a device's request to its bus: see ``Device.requests``."""


class Runnable(Protocol):
    """What the loop steps: a ``Device``, or what behaves as one."""

    @property
    def node_id(self) -> int:
        """The node-id at present."""

    def step(self, now_us: int, frames: Iterable[Frame] = ()) -> tuple[list[Frame], int]:
        """Frames in; frames out and the next due time."""

    @property
    def requests(self) -> list[tuple[str, int, int]]:
        """Requests to the bus, see ``Device.requests``; the loop empties it."""


def now_us() -> int:
    """Return microseconds of the monotonic clock."""
    return time.monotonic_ns() // 1000


def run(devices: Sequence[Runnable], port: Port, stop: Callable[[], bool] = lambda: False) -> None:
    """Step ``devices`` on one bus until ``stop()``, called at least five times a second, returns true. Each frame goes
    to every device. The clock is the monotonic one; changes of the time of day have no effect."""
    frames: list[Frame] = []
    while not stop():
        t_us = now_us()
        due_us = t_us + 1_000_000
        for device in devices:
            sent, device_due_us = device.step(t_us, frames)
            if sent:
                port.send(sent)
            if device.requests:
                for what, value, delay_ms in device.requests:
                    _LOG.info("node %d: %s", device.node_id, what)
                    port.request(what, value, delay_ms)
                device.requests.clear()
            due_us = min(due_us, device_due_us)
        frame = port.receive(min(max(0.0, (due_us - now_us()) * 1e-6), _IDLE_S))
        frames = [] if frame is None else [frame]


@contextmanager
def running(
    devices: Sequence[Runnable], port: Port, wake: Callable[[], object] = lambda: None
) -> Iterator[threading.Thread]:
    """Run ``devices`` in a thread during the block, then raise their error; ``wake`` ends the wait of the port."""
    stopped, failures = threading.Event(), list[BaseException]()

    def work() -> None:
        try:
            run(devices, port, stopped.is_set)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=work, name="devices", daemon=True)
    thread.start()
    try:
        yield thread
    finally:
        stopped.set()
        wake()
        thread.join()
    if failures:
        raise failures[0]


def say_stopped(devices: Sequence[Device], port: Port) -> None:
    """Return the last frame of each node that ends on purpose, a heartbeat with STOPPED (04h): a host sees the end at
    once, of a killed node only after the heartbeat time. A node without a node-id sends nothing."""
    for device in devices:
        if device.node_id != codes.LSS_UNCONFIGURED:
            device.nmt.enter(codes.STOPPED)
            port.send([(codes.HEARTBEAT_BASE + device.node_id, bytes((codes.STOPPED,)))])


class MemoryStore:
    """Parameter groups in memory: ``save`` and ``load`` of a ``Device``. ``refuses`` makes it a broken store."""

    def __init__(self) -> None:
        self.groups: dict[str, bytes] = {}
        self.refuses = False

    def save(self, group: str, data: bytes) -> bool:
        """Keep a group; return whether it is kept."""
        if not self.refuses:
            self.groups[group] = data
        return not self.refuses

    def load(self, group: str) -> bytes | None:
        """Return what was kept."""
        return self.groups.get(group)
