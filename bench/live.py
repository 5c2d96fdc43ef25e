"""Measure the live receive path beside canopen's PDO path and python-can, over loopback sockets.

    python -m bench.live    about five minutes, and writes docs/live-performance.md

Frames are ``struct can_frame`` in datagrams between connected UDP sockets on 127.0.0.1; what reads them is the code
that reads SocketCAN, options and time stamps included. Costs are CPU time and come from one run in which the ways take
turns.
"""

from __future__ import annotations

import socket
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import can
import numpy as np
from bench.loopback import (
    CanopenHost,
    bound_receiver,
    connected_pair,
    contact_frames,
    python_can_bus,
    running_numbers,
    sending,
    struct_contact,
)
from bench.measure import Meter, arguments, cpu_us, in_turns, machine, table, write_page

from tipforce.host.decoding.decoder import Decoder
from tipforce.host.live.receive import SocketReceiver
from tipforce.host.logs.recorder import open_writer
from tipforce_tools.log import TICK_S

SECONDS = 20.0
RATES_HZ = (5000, 30_000)
LOGGER_HZ = 10_000
FRAMES, ROUNDS = 2048, 40  # of the costs: frames in one turn
_SILENCE_S = 5.0
_PAGE = """\
# The live receive path: cost, losses, lag

Written by `python -m bench.live` on: {machine}.

Frames are `struct can_frame` in datagrams between connected UDP sockets on 127.0.0.1, read by the code that reads
SocketCAN (`host/live/`), with the kernel's time stamps. `tests/vcan` tests the same code on a real vcan.

## Cost per frame

CPU time of the process per Contact PDO, {rounds} rounds of {frames} frames in which the ways take turns. "Decode" means
all signals of the PDO as numpy columns. python-can and canopen are called without a Notifier thread, their best case.

{costs}

## At a steady rate

{seconds:g} s each, received and decoded as they come; the sender is a process of its own. Lag: from the kernel's stamp
to decoded values, of every frame, in milliseconds; also the 99th percentile of the median second, and of the best and
the worst. The busy thread is a Python loop in the receiving process that never pauses; its CPU time is in the share of
a core. While a receiver is open, Python's switch interval is 0.5 ms; 5 ms is Python's own.

{loads}

Recording {logger_hz:,} frames a second for {seconds:g} s to a file in candump's log format, one after the
other: {loggers}.
"""


def ways(receiver_socket: socket.socket) -> dict[str, Callable[[], int]]:
    """The ways to receive FRAMES frames that wait in the socket's buffer; each returns how many it took."""
    bus, host, decoder = python_can_bus(receiver_socket), CanopenHost(), Decoder(node_ids=range(1, 6))

    def in_batches(batch: int, decodes: bool) -> Callable[[], int]:
        receiver = SocketReceiver(receiver_socket, "loopback", tick_s=0, capacity=batch)

        def take() -> int:
            count = 0
            while count < FRAMES:
                frames = receiver.receive(0)
                if decodes:
                    decoder.decode(frames)
                count += len(frames)
            return count

        return take

    def one_by_one(use: Callable[[can.Message], object]) -> int:
        for _ in range(FRAMES):
            message = bus.recv(0)
            if message is None:
                raise RuntimeError("a frame is missing")
            use(message)
        return FRAMES

    def by_canopen() -> int:
        before = host.frames
        one_by_one(host.take)
        if host.frames - before != FRAMES:
            raise RuntimeError("a PDO did not reach its callback")
        return FRAMES

    decoding = {f"tipforce, receive and decode, batches of {n}": in_batches(n, True) for n in (256, 32, 8, 5)}
    return {
        **decoding,
        "tipforce, receive alone, batches of 256": in_batches(256, False),
        "python-can, bus.recv alone": partial(one_by_one, lambda _message: None),
        "python-can, bus.recv and struct": partial(one_by_one, struct_contact),
        "canopen, PDO callback with three .raw": by_canopen,
    }


def costs(rounds: int) -> dict[str, list[float]]:
    """Microseconds per frame, one figure for each round and way; CPU time of the process."""
    receiver, sender = connected_pair()
    frames = contact_frames(0, FRAMES)

    def turn(take: Callable[[], int]) -> float:
        for frame in frames:
            sender.send(frame)
        return cpu_us(take)

    with receiver, sender:
        turns = {name: partial(turn, take) for name, take in ways(receiver).items()}
        in_turns(turns, 1)  # warms up
        return in_turns(turns, rounds)


def cost_rows(figures: dict[str, list[float]]) -> list[list[str]]:
    """Median, spread, and what each way costs of the first one's cost."""
    first = statistics.median(next(iter(figures.values())))
    return [
        [
            name,
            f"{statistics.median(us):.2f}",
            f"{min(us):.2f} to {max(us):.2f}",
            f"{statistics.median(us) / first:.1f}",
        ]
        for name, us in figures.items()
    ]


@dataclass(frozen=True, slots=True)
class Load:
    """What a run at a steady rate gave. Lags are from the kernel's stamp to the decoded values, of every frame."""

    sent: int
    received: int
    dropped: int
    in_order: bool
    stamps_rise: bool
    lag_median_ms: float
    lag_p99_ms: float
    lag_p99_seconds_ms: tuple[float, ...]
    """The 99th percentile of each second of the run."""
    lag_max_ms: float
    cpu_share: float
    frames_a_batch: float

    def row(self, name: str, rate_hz: int) -> list[str]:
        """A line of the table of steady runs."""
        each = self.lag_p99_seconds_ms
        typical = f"{statistics.median(each):.1f} ({min(each):.1f} to {max(each):.1f})"
        order = "yes" if self.in_order and self.stamps_rise else "NO"
        lags = [f"{self.lag_median_ms:.2f}", f"{self.lag_p99_ms:.1f}", typical, f"{self.lag_max_ms:.1f}"]
        counts = [str(self.sent), str(self.received), str(self.dropped), order]
        return [f"{rate_hz:,} Hz, {name}", *counts, *lags, f"{self.cpu_share:.0%}", f"{self.frames_a_batch:.0f}"]


LOAD_HEADER = ["run", "sent", "received", "dropped", "in order", "lag median", "p99", "p99 by seconds", "largest",
               "CPU", "frames a batch"]  # fmt: skip


@contextmanager
def busy_thread() -> Iterator[None]:
    """A Python thread that computes without a pause."""
    stop = threading.Event()

    def work() -> None:
        total = 0
        while not stop.is_set():
            for number in range(10_000):
                total += number * number

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


class _Record:
    """What came: running numbers, kernel's stamps and times of decoding, as numbers or arrays."""

    def __init__(self) -> None:
        self.numbers: list[Any] = []
        self.stamps_ns: list[Any] = []
        self.decoded_ns: list[int] = []
        self.counts: list[int] = []

    def note(self, numbers: Any, stamps_ns: Any, count: int) -> int:
        """Keep what is decoded now; return the count."""
        self.numbers.append(numbers)
        self.stamps_ns.append(stamps_ns)
        self.decoded_ns.append(time.time_ns())
        self.counts.append(count)
        return count


Take = Callable[[float, _Record], int]
"""Waits at most the given time; returns the number of frames received and decoded, and notes them."""


def run_load(rate_hz: int, seconds: float, *, busy: bool = False, switch_s: float | None = None) -> Load:
    """Receive and decode everything that a process sends at ``rate_hz`` for ``seconds``.

    ``switch_s``: another switch interval than that of a receiver.
    """
    receiver_socket, decoder, before_s = bound_receiver(), Decoder(node_ids=range(1, 6)), sys.getswitchinterval()
    with SocketReceiver(receiver_socket, "loopback") as receiver:
        if switch_s is not None:
            sys.setswitchinterval(switch_s)

        def take(timeout_s: float, record: _Record) -> int:
            frames = receiver.receive(timeout_s)
            decoder.decode(frames)
            return record.note(running_numbers(frames), frames["t_ns"], len(frames)) if len(frames) else 0

        try:
            return _run(take, receiver_socket, rate_hz, seconds, busy, lambda: receiver.dropped)
        finally:
            sys.setswitchinterval(before_s)


def run_struct(rate_hz: int, seconds: float, *, busy: bool = False) -> Load:
    """The same with python-can's ``recv`` and struct: what a user writes by hand."""
    receiver_socket = bound_receiver()
    bus = python_can_bus(receiver_socket)

    def take(timeout_s: float, record: _Record) -> int:
        message = bus.recv(timeout_s)
        if message is None:
            return 0
        struct_contact(message)
        return record.note(int.from_bytes(message.data[:4], "little"), round(message.timestamp * 1e9), 1)

    with receiver_socket:
        return _run(take, receiver_socket, rate_hz, seconds, busy, lambda: 0)


def _run(
    take: Take, receiver: socket.socket, rate_hz: int, seconds: float, busy: bool, dropped: Callable[[], int]
) -> Load:
    total, record = round(rate_hz * seconds), _Record()
    with busy_thread() if busy else nullcontext(), sending(receiver, rate_hz, seconds):
        count = part = take(30.0, record)
        meter = Meter()
        while part and count + dropped() < total:
            part = take(_SILENCE_S, record)
            count += part
        share = meter.share
    number, stamp_ns = np.hstack(record.numbers).astype(np.int64), np.hstack(record.stamps_ns)
    lag_ms = (np.repeat(record.decoded_ns, record.counts) - stamp_ns) / 1e6
    # A last part of less than half a second belongs to the second before.
    by_second = np.array_split(lag_ms, max(round(len(lag_ms) / rate_hz), 1))
    return Load(
        sent=total,
        received=len(number),
        dropped=dropped(),
        in_order=bool((np.diff(number) > 0).all()),
        stamps_rise=bool((np.diff(stamp_ns) >= 0).all()),
        lag_median_ms=float(np.median(lag_ms)),
        lag_p99_ms=float(np.quantile(lag_ms, 0.99)),
        lag_p99_seconds_ms=tuple(np.quantile(part, 0.99).item() for part in by_second),
        lag_max_ms=float(lag_ms.max()),
        cpu_share=share,
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
    receiver_socket, writer = bound_receiver(), open_writer(path)
    with (
        SocketReceiver(receiver_socket, "loopback", tick_s=TICK_S) as receiver,
        sending(receiver_socket, rate_hz, seconds),
    ):
        block = receiver.receive_block(30.0)
        meter = Meter()
        while meter.elapsed_s < seconds - 0.5:
            writer.write(block)
            block = receiver.receive_block(1.0)
        share = meter.share
        writer.write(block)
    writer.close()
    return share, path.read_bytes().count(b"\n")


def _their_logger(path: Path, rate_hz: int, seconds: float) -> tuple[float, int]:
    receiver_socket = bound_receiver()
    bus = python_can_bus(receiver_socket)
    with receiver_socket, sending(receiver_socket, rate_hz, seconds):
        logger = can.Logger(path)
        message = bus.recv(30.0)
        assert message is not None
        meter = Meter()
        notifier = can.Notifier(bus, [logger])
        time.sleep(seconds - 0.5)
        share = meter.share
        notifier.stop()  # stops the logger, too
    return share, path.read_bytes().count(b"\n")


def report() -> str:
    """The page: everything measured once."""
    on, figures = machine("python-can", "canopen"), costs(ROUNDS)
    loads = []
    for rate_hz in RATES_HZ:
        ours, by_hand = partial(run_load, rate_hz, SECONDS), partial(run_struct, rate_hz, SECONDS)
        for name, run in (
            ("alone", ours),
            ("one busy Python thread", partial(ours, busy=True)),
            ("the same, switch interval 5 ms", partial(ours, busy=True, switch_s=0.005)),
            ("python-can with struct, alone", by_hand),
            ("python-can with struct, one busy Python thread", partial(by_hand, busy=True)),
        ):
            loads.append(run().row(name, rate_hz))
    shares = log_shares(LOGGER_HZ, SECONDS)
    return _PAGE.format(
        machine=on, rounds=ROUNDS, frames=FRAMES, seconds=SECONDS, logger_hz=LOGGER_HZ,
        costs=table(["way", "microseconds a frame", "smallest to largest", "times the first"], cost_rows(figures)),
        loads=table(LOAD_HEADER, loads),
        loggers="; ".join(f"{name} {share:.1%} of a core, {frames} frames" for name, (share, frames) in shares.items()),
    )  # fmt: skip


def main() -> None:
    arguments(__doc__).parse_args()
    text = report()
    write_page("live-performance", text, text)


if __name__ == "__main__":
    main()
