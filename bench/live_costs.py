"""Microseconds per frame of each way to receive, in turns in one process: the frames wait in the socket's buffer."""

from __future__ import annotations

import socket
import statistics
import time
from collections.abc import Callable

import can
from bench.live_loopback import CanopenHost, connected_pair, contact_frames, python_can_bus, struct_contact

from tipforce.host.decoding.decoder import Decoder
from tipforce.host.live.receive import SocketReceiver

FRAMES = 2048  # in one turn
Way = Callable[[int], None]


class Ways:
    """The ways to receive, all on the same socket."""

    def __init__(self, one: socket.socket) -> None:
        self._bus = python_can_bus(one)
        self._canopen = CanopenHost()
        self._decoder = Decoder(node_ids=range(1, 6))
        self.ways: dict[str, Way] = {}
        for batch in (256, 32, 8, 5):
            receiver = SocketReceiver(one, "loopback", tick_s=0, capacity=batch)
            self.ways[f"tipforce, receive and decode, batches of {batch}"] = self._decoded(receiver)
        receiver = SocketReceiver(one, "loopback", tick_s=0, capacity=256)
        self.ways["tipforce, receive alone, batches of 256"] = self._received(receiver)
        self.ways["python-can, bus.recv alone"] = self._python_can
        self.ways["python-can, bus.recv and struct"] = self._struct
        self.ways["canopen, PDO callback with three .raw"] = self._canopen_pdo

    def _decoded(self, receiver: SocketReceiver) -> Way:
        def take(count: int) -> None:
            while count:
                frames = receiver.receive(0)
                self._decoder.decode(frames)
                count -= len(frames)

        return take

    @staticmethod
    def _received(receiver: SocketReceiver) -> Way:
        def take(count: int) -> None:
            while count:
                count -= len(receiver.receive(0))

        return take

    def _python_can(self, count: int) -> None:
        for _ in range(count):
            if self._bus.recv(0) is None:
                raise RuntimeError("a frame is missing")

    def _struct(self, count: int) -> None:
        for _ in range(count):
            message = self._bus.recv(0)
            if message is None:
                raise RuntimeError("a frame is missing")
            struct_contact(message)

    def _canopen_pdo(self, count: int) -> None:
        before = self._canopen.frames
        for _ in range(count):
            message = self._bus.recv(0)
            if isinstance(message, can.Message):
                self._canopen.take(message)
        if self._canopen.frames - before != count:
            raise RuntimeError("a PDO did not reach its callback")


def measure(rounds: int) -> dict[str, list[float]]:
    """Microseconds per frame, one figure for each round and way; CPU time of the process."""
    one, sender = connected_pair()
    with one, sender:
        ways = Ways(one).ways
        found: dict[str, list[float]] = {name: [] for name in ways}
        frames = contact_frames(FRAMES)
        for number in range(rounds + 1):
            for name, take in ways.items():
                for frame in frames:
                    sender.send(frame)
                start_ns = time.process_time_ns()
                take(FRAMES)
                spent_ns = time.process_time_ns() - start_ns
                if number:  # the first round warms up
                    found[name].append(spent_ns / 1000 / FRAMES)
    return found


def table(found: dict[str, list[float]]) -> list[str]:
    """Lines of a markdown table: median, spread, and what each way costs of the first one's cost."""
    first = statistics.median(next(iter(found.values())))
    lines = ["| way | microseconds a frame | smallest to largest | times the first |", "|---|---|---|---|"]
    for name, figures in found.items():
        middle = statistics.median(figures)
        spread = f"{min(figures):.2f} to {max(figures):.2f}"
        lines.append(f"| {name} | {middle:.2f} | {spread} | {middle / first:.1f} |")
    return lines
