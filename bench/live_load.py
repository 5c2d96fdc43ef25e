"""The live path at a steady rate: what is lost, how late frames are decoded, what it costs of a core."""

from __future__ import annotations

import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np
import numpy.typing as npt
from bench.live_loopback import bound_receiver, python_can_bus, running_numbers, sending, struct_contact

from tipforce.host.decoding.decoder import Decoder
from tipforce.host.live.receive import SocketReceiver
from tipforce_tools.log.session import TICK_S
from tipforce_tools.log.writers import open_writer

_SILENCE_S = 5.0


FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Load:
    """What a run at a steady rate gave. Lags are from the kernel's stamp to the decoded values, of every frame.

    ``lag_p99_seconds_ms`` has the 99th percentile of each second of the run.
    """

    sent: int
    received: int
    dropped: int
    in_order: bool
    stamps_rise: bool
    lag_median_ms: float
    lag_p99_ms: float
    lag_p99_seconds_ms: tuple[float, ...]
    lag_max_ms: float
    cpu_share: float
    frames_a_batch: float


@contextmanager
def busy_thread(wanted: bool) -> Iterator[None]:
    """A Python thread that computes without a pause, if wanted."""
    stop = threading.Event()

    def work() -> None:
        total = 0
        while not stop.is_set():
            for number in range(10_000):
                total += number * number

    thread = threading.Thread(target=work, daemon=True)
    if wanted:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        if wanted:
            thread.join()


@contextmanager
def switch_interval(seconds: float | None) -> Iterator[None]:
    """Python's interval after which a thread must give up the GIL."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(before if seconds is None else seconds)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def _seconds(lag_ms: FloatArray, rate_hz: int) -> list[FloatArray]:
    """The frames of each second; a last part of less than half a second belongs to the one before."""
    return np.array_split(lag_ms, max(round(len(lag_ms) / rate_hz), 1))


class _Record:
    """What came: running numbers, kernel's stamps and times of decoding, as numbers or arrays."""

    def __init__(self) -> None:
        self.numbers: list[Any] = []
        self.stamps_ns: list[Any] = []
        self.decoded_ns: list[int] = []
        self.counts: list[int] = []


Take = Callable[[float, _Record], int]
"""Waits at most the given time; returns the number of frames received and decoded, and notes them."""


def run_load(rate_hz: int, seconds: float, *, busy: bool = False, switch_s: float | None = None) -> Load:
    """Receive and decode everything that a process sends at ``rate_hz`` for ``seconds``.

    ``switch_s``: another switch interval than that of a receiver.
    """
    one = bound_receiver()
    decoder = Decoder(node_ids=range(1, 6))
    with SocketReceiver(one, "loopback") as receiver, switch_interval(switch_s):

        def take(timeout_s: float, record: _Record) -> int:
            frames = receiver.receive(timeout_s)
            decoder.decode(frames)
            record.numbers.append(running_numbers(frames))
            record.stamps_ns.append(frames["t_ns"])
            return len(frames)

        return _run(take, one, rate_hz, seconds, busy, lambda: receiver.dropped)


def run_struct(rate_hz: int, seconds: float, *, busy: bool = False) -> Load:
    """The same with python-can's ``recv`` and struct: what a user writes by hand."""
    one = bound_receiver()
    bus = python_can_bus(one)

    def take(timeout_s: float, record: _Record) -> int:
        message = bus.recv(timeout_s)
        if message is None:
            return 0
        struct_contact(message)
        record.numbers.append(int.from_bytes(message.data[:4], "little"))
        record.stamps_ns.append(round(message.timestamp * 1e9))
        return 1

    with one:
        return _run(take, one, rate_hz, seconds, busy, lambda: 0)


def _run(
    take: Take, one: socket.socket, rate_hz: int, seconds: float, busy: bool, dropped: Callable[[], int]
) -> Load:  # fmt: skip
    total, record = round(rate_hz * seconds), _Record()
    with busy_thread(busy), sending(one, rate_hz, seconds):
        count = part = take(30.0, record)
        start_s, start_cpu_s = time.monotonic(), time.process_time()
        while part:
            record.decoded_ns.append(time.time_ns())
            record.counts.append(part)
            if count + dropped() >= total:
                break
            part = take(_SILENCE_S, record)
            count += part
        elapsed_s, cpu_s = time.monotonic() - start_s, time.process_time() - start_cpu_s
    number, stamp_ns = np.hstack(record.numbers).astype(np.int64), np.hstack(record.stamps_ns)
    lag_ms = (np.repeat(record.decoded_ns, record.counts) - stamp_ns) / 1e6
    return Load(
        sent=total,
        received=len(number),
        dropped=dropped(),
        in_order=bool((np.diff(number) > 0).all()),
        stamps_rise=bool((np.diff(stamp_ns) >= 0).all()),
        lag_median_ms=float(np.median(lag_ms)),
        lag_p99_ms=float(np.quantile(lag_ms, 0.99)),
        lag_p99_seconds_ms=tuple(np.quantile(part, 0.99).item() for part in _seconds(lag_ms, rate_hz)),
        lag_max_ms=float(lag_ms.max()),
        cpu_share=cpu_s / elapsed_s,
        frames_a_batch=len(number) / len(record.counts),
    )


def log_shares(rate_hz: int, seconds: float) -> dict[str, tuple[float, int]]:
    """CPU share of a core, and how many frames the file holds: our logger and python-can's, one after the other."""
    with tempfile.TemporaryDirectory() as folder:
        return {
            "tipforce log": _our_logger(Path(folder) / "ours.log", rate_hz, seconds),
            "python-can's logger": _their_logger(Path(folder) / "theirs.log", rate_hz, seconds),
        }


def _our_logger(path: Path, rate_hz: int, seconds: float) -> tuple[float, int]:
    one = bound_receiver()
    writer = open_writer(path)
    with SocketReceiver(one, "loopback", tick_s=TICK_S) as receiver, sending(one, rate_hz, seconds):
        block = receiver.receive_block(30.0)
        start_s, start_cpu_s = time.monotonic(), time.process_time()
        while time.monotonic() - start_s < seconds - 0.5:
            writer.write(block)
            block = receiver.receive_block(1.0)
        share = (time.process_time() - start_cpu_s) / (time.monotonic() - start_s)
        writer.write(block)
    writer.close()
    return share, path.read_bytes().count(b"\n")


def _their_logger(path: Path, rate_hz: int, seconds: float) -> tuple[float, int]:
    one = bound_receiver()
    bus = python_can_bus(one)
    with sending(one, rate_hz, seconds):
        logger = can.Logger(path)
        message = bus.recv(30.0)
        assert message is not None
        start_s, start_cpu_s = time.monotonic(), time.process_time()
        notifier = can.Notifier(bus, [logger])
        time.sleep(seconds - 0.5)
        share = (time.process_time() - start_cpu_s) / (time.monotonic() - start_s)
        notifier.stop()  # stops the logger, too
    one.close()
    return share, path.read_bytes().count(b"\n")
