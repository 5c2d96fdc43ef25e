"""Measure the live receive path beside canopen's PDO path and python-can, over loopback sockets.

    python -m bench.live    about five minutes, and writes build/bench/live-performance.md

Frames are ``struct can_frame`` in datagrams between connected UDP sockets on 127.0.0.1; what reads them is the code
that reads SocketCAN. Costs are CPU time of ways that take turns."""

import socket
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import can
import numpy as np
from bench import loopback
from bench.measure import Meter, arguments, background, cpu_us, in_turns, machine, table, write_page

from tipforce.arrays import FloatArray, IntArray
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.live.receive import SocketReceiver
from tipforce.host.logs.recorder import open_writer
from tipforce_tools.log import TICK_S

SECONDS = 20.0
LOGGER_HZ = 10_000
FRAMES, ROUNDS = 2048, 40  # of the costs: frames in one turn


def ways(receiver_socket: socket.socket) -> dict[str, Callable[[], int]]:
    """The ways to receive FRAMES frames that wait in the socket's buffer; each returns how many it took."""
    bus, host, decoder = loopback.python_can_bus(receiver_socket), loopback.CanopenHost(), Decoder(node_ids=range(1, 6))

    def in_batches(batch: int) -> Callable[[], int]:
        receiver = SocketReceiver(receiver_socket, "loopback", tick_s=0, capacity=batch)

        def take() -> int:
            count = 0
            while count < FRAMES:
                frames = receiver.receive(0)
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

    return {
        **{f"tipforce, receive and decode, batches of {n}": in_batches(n) for n in (256, 8, 5)},
        "python-can, bus.recv and struct": partial(one_by_one, loopback.struct_contact),
        "canopen, PDO callback with three .raw": by_canopen,
    }


def costs(rounds: int) -> dict[str, list[float]]:
    """Microseconds per frame, one figure for each round and way; CPU time of the process."""
    receiver, sender = loopback.connected_pair()
    frames = loopback.contact_frames(0, FRAMES)

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
    medians = {name: statistics.median(us) for name, us in figures.items()}
    return [
        [name, f"{medians[name]:.2f}", f"{min(us):.2f} to {max(us):.2f}", f"{medians[name] / first:.1f}"]
        for name, us in figures.items()
    ]


class Load(NamedTuple):
    """What a run at a steady rate gave; arrays (n,) by frame."""

    rate_hz: int
    sent: int
    dropped: int
    number: IntArray
    stamp_ns: IntArray
    lag_ms: FloatArray  # from the kernel's stamp to the decoded values
    cpu_share: float

    @property
    def in_order(self) -> bool:
        """The running numbers rise, and the stamps do not fall."""
        return bool((np.diff(self.number) > 0).all() and (np.diff(self.stamp_ns) >= 0).all())

    def row(self, name: str) -> list[str]:
        """A line of the table of steady runs."""
        median, p99, largest = np.quantile(self.lag_ms, (0.5, 0.99, 1.0))
        return [
            f"{self.rate_hz:,} Hz, {name}", str(self.sent), str(len(self.number)), str(self.dropped),
            "yes" if self.in_order else "NO", f"{median:.2f}", f"{p99:.1f}", f"{largest:.1f}", f"{self.cpu_share:.0%}",
        ]  # fmt: skip


LOAD_HEADER = ["run", "sent", "received", "dropped", "in order", "lag median", "p99", "largest", "CPU"]


def compute(stop: threading.Event) -> None:
    """A Python thread that never pauses."""
    total = 0
    while not stop.is_set():
        for number in range(10_000):
            total += number * number


def run_load(rate_hz: int, seconds: float, *, busy: bool = False) -> Load:
    """Receive and decode everything that a process sends at ``rate_hz`` for ``seconds``."""
    receiver_socket, decoder = loopback.bound_receiver(), Decoder(node_ids=range(1, 6))
    with SocketReceiver(receiver_socket, "loopback") as receiver:

        def take(timeout_s: float) -> tuple[Any, Any]:
            frames = receiver.receive(timeout_s)
            decoder.decode(frames)
            return loopback.running_numbers(frames), frames["t_ns"]

        return _run(take, receiver_socket, rate_hz, seconds, busy, lambda: receiver.dropped)


def run_struct(rate_hz: int, seconds: float, *, busy: bool = False) -> Load:
    """The same with python-can's ``recv`` and struct: what a user writes by hand."""
    receiver_socket = loopback.bound_receiver()
    bus = loopback.python_can_bus(receiver_socket)

    def take(timeout_s: float) -> tuple[Any, Any]:
        message = bus.recv(timeout_s)
        if message is None:
            return (), ()
        loopback.struct_contact(message)
        return (int.from_bytes(message.data[:4], "little"),), (round(message.timestamp * 1e9),)

    with receiver_socket:
        return _run(take, receiver_socket, rate_hz, seconds, busy, lambda: 0)


def _run(
    take: Callable[[float], tuple[Any, Any]], receiver: socket.socket, rate_hz: int, seconds: float, busy: bool,
    dropped: Callable[[], int],
) -> Load:  # fmt: skip
    """``take`` waits at most so long; it returns running numbers and stamps (ns) of the frames received and decoded."""
    total, count, batches = round(rate_hz * seconds), 0, list[tuple[Any, Any, int]]()
    with background(compute) if busy else nullcontext(), loopback.sending(receiver, rate_hz, seconds):
        numbers, stamps_ns = take(30.0)
        meter = Meter()
        while len(numbers):
            batches.append((numbers, stamps_ns, time.time_ns()))
            count += len(numbers)
            if count + dropped() >= total:
                break
            numbers, stamps_ns = take(5.0)  # no silence is so long
        share = meter.share
    number, stamp_ns = (np.concatenate([batch[k] for batch in batches]).astype(np.int64) for k in (0, 1))
    decoded_ns = np.repeat([batch[2] for batch in batches], [len(batch[0]) for batch in batches])
    return Load(rate_hz, total, dropped(), number, stamp_ns, (decoded_ns - stamp_ns) / 1e6, share)


def log_shares(rate_hz: int, seconds: float) -> dict[str, tuple[float, int]]:
    """CPU share of a core, and how many frames the file holds: our logger and python-can's, one after the other."""
    shares = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.log"
        for name, logger in (("tipforce log", _our_logger), ("python-can's logger", _their_logger)):
            receiver = loopback.bound_receiver()
            with receiver, loopback.sending(receiver, rate_hz, seconds):
                share = logger(receiver, path, seconds - 0.5)
            shares[name] = share, path.read_bytes().count(b"\n")
            path.unlink()
    return shares


def _our_logger(receiver_socket: socket.socket, path: Path, seconds: float) -> float:
    writer = open_writer(path)
    with SocketReceiver(receiver_socket, "loopback", tick_s=TICK_S) as receiver:
        block = receiver.receive_block(30.0)
        meter = Meter()
        while meter.elapsed_s < seconds:
            writer.write(block)
            block = receiver.receive_block(1.0)
        share = meter.share
        writer.write(block)
    writer.close()
    return share


def _their_logger(receiver_socket: socket.socket, path: Path, seconds: float) -> float:
    bus, logger = loopback.python_can_bus(receiver_socket), can.Logger(path)
    assert bus.recv(30.0) is not None
    meter = Meter()
    notifier = can.Notifier(bus, [logger])
    time.sleep(seconds)
    share = meter.share
    notifier.stop()  # stops the logger, too
    return share


def main() -> None:
    arguments(__doc__).parse_args()
    on, figures = machine("python-can", "canopen"), costs(ROUNDS)
    loads = [run_load(5000, SECONDS).row("alone")]
    for busy, beside in ((False, "alone"), (True, "one busy Python thread")):
        loads.append(run_load(30_000, SECONDS, busy=busy).row(beside))
        loads.append(run_struct(30_000, SECONDS, busy=busy).row(f"python-can with struct, {beside}"))
    shares = log_shares(LOGGER_HZ, SECONDS)
    loggers = "; ".join(f"{name} {share:.1%} of a core, {frames} frames" for name, (share, frames) in shares.items())
    parts = (
        f"Written by `python -m bench.live` on: {on}.",
        table(["way", "microseconds a frame", "smallest to largest", "times the first"], cost_rows(figures)),
        table(LOAD_HEADER, loads),
        f"Recording {LOGGER_HZ:,} frames a second for {SECONDS:g} s to a file in candump's log format, one after the "
        f"other: {loggers}.",
    )
    write_page("live-performance", "\n\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
