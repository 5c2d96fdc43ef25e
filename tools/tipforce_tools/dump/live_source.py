"""Frames from buses, as blocks of what has arrived.

A SocketCAN bus is opened by python-can and then read here: python-can makes a float of the kernel's timestamp, which
is too coarse for candump's microseconds, and gives the kernel neither candump's filters nor its error mask.
"""

import queue
import select
import socket
import struct
import threading
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from typing import Any

import can
import numpy as np

from tipforce.host.candump import CandumpBlock
from tipforce.host.frames import FRAME, raw_frame
from tipforce_tools import common
from tipforce_tools.dump.targets import ANY, Filter, Target

BURST = 512  # frames of one bus before they are shown and the next bus has its turn
_POLL_S = 0.1
_FRAME = struct.Struct("=IB3x8s")
_STAMP = struct.Struct("@qq")
_CLASSIC_BYTES, _FD_BYTES = 16, 72
_SO_TIMESTAMPNS = 35  # what follows is from linux/can/raw.h; Python's socket has not all of it, and that on Linux alone
_SOL_CAN_RAW = 101
_CAN_RAW_FILTER, _CAN_RAW_ERR_FILTER, _CAN_RAW_FD_FRAMES, _CAN_RAW_JOIN_FILTERS = 1, 2, 5, 6
_INVERSE_FLAG = 0x20000000

Row = tuple[int, int, bytes, str, bool]  # t_ns, can_id, data, interface name, sent by this machine


class LiveSource:
    """The buses of a command line. A context manager; ``fd_frames`` counts what is no classic frame."""

    def __init__(self, targets: Sequence[Target], args: Namespace) -> None:
        """Raises EnvironmentLackError when a bus can't be opened."""
        self.targets = tuple(targets) or (Target(getattr(args, "channel", "")),)
        self.fd_frames = 0
        self._open = ExitStack()
        self._numbers: dict[str, int] = {}
        with ExitStack() as opened:
            self._buses = [opened.enter_context(_open_bus(target, args, bool(targets))) for target in self.targets]
            self._open = opened.pop_all()

    def __enter__(self) -> "LiveSource":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def blocks(self, timeout_ms: int | None = None) -> Iterator[CandumpBlock]:
        """What arrives, as soon as it does, until nothing has come for ``timeout_ms``. Raises can.CanError."""
        sockets: list[Any] = [getattr(bus, "socket", None) for bus in self._buses]
        timeout_s = None if timeout_ms is None else timeout_ms / 1000
        if all(isinstance(one, socket.socket) and one.family == getattr(socket, "AF_CAN", -1) for one in sockets):
            for target, one in zip(self.targets, sockets, strict=True):
                _configure(one, target)
            bursts = self._socket_bursts(sockets, timeout_s)
        else:
            bursts = self._bus_bursts(timeout_s)
        for rows in bursts:
            if rows:
                yield self._block(rows)

    def _socket_bursts(self, sockets: Sequence[Any], timeout_s: float | None) -> Iterator[list[Row]]:
        names = {one: target.channel for one, target in zip(sockets, self.targets, strict=True)}
        while ready := select.select(sockets, [], [], timeout_s)[0]:
            rows: list[Row] = []
            for one in ready:
                rows += self._drain(one, names[one])
            if len(ready) > 1:
                rows.sort(key=lambda row: row[0])
            yield rows

    def _drain(self, one: socket.socket, name: str) -> Iterator[Row]:
        """What a SocketCAN socket holds, a burst at most."""
        for _ in range(BURST):
            try:
                frame, ancillary, flags, address = one.recvmsg(_FD_BYTES, 64, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            except OSError as error:
                raise can.CanOperationError(f"{name}: {error.strerror}") from None
            if len(frame) != _CLASSIC_BYTES:
                self.fd_frames += 1
                continue
            can_id, length, data = _FRAME.unpack(frame)
            seconds, nanoseconds = _STAMP.unpack(ancillary[0][2]) if ancillary else (0, 0)
            from_name = address[0] if name in {"", ANY} and address else name
            sent = bool(flags & socket.MSG_DONTROUTE)
            yield seconds * 1_000_000_000 + nanoseconds, can_id, data[:length], from_name, sent

    def _bus_bursts(self, timeout_s: float | None) -> Iterator[list[Row]]:
        """One thread per bus: not every bus of python-can has a file to wait for."""
        arrived: queue.SimpleQueue[tuple[int, can.Message | Exception]] = queue.SimpleQueue()
        stop = threading.Event()
        threads = [
            threading.Thread(target=_receive, args=(bus, number, arrived, stop), daemon=True)
            for number, bus in enumerate(self._buses)
        ]
        for thread in threads:
            thread.start()
        try:
            while True:
                try:
                    items = [arrived.get(timeout=timeout_s)]
                except queue.Empty:
                    return
                while not arrived.empty() and len(items) < BURST:
                    items.append(arrived.get())
                yield [row for number, item in items for row in self._message_rows(number, item)]
        finally:
            stop.set()
            for thread in threads:
                thread.join()

    def _message_rows(self, number: int, item: can.Message | Exception) -> list[Row]:
        if isinstance(item, Exception):
            raise item
        if item.is_fd:
            self.fd_frames += 1
            return []
        target = self.targets[number]
        t_ns, can_id, data = raw_frame(item)
        if item.is_remote_frame:
            data = bytes(item.dlc)
        if not target.passes(np.array([can_id], dtype=np.uint32))[0]:
            return []
        name = target.channel if target.channel not in {"", ANY} else str(item.channel or "can")
        return [(t_ns, can_id, data, name, not item.is_rx)]

    def _block(self, rows: Sequence[Row]) -> CandumpBlock:
        frames = np.zeros(len(rows), dtype=FRAME)
        packed = b"".join(data.ljust(8, b"\0")[:8] for _, _, data, _, _ in rows)
        frames["t_ns"] = [row[0] for row in rows]
        frames["can_id"] = [row[1] for row in rows]
        frames["length"] = [min(len(row[2]), 8) for row in rows]
        frames["data"] = np.frombuffer(packed, dtype=np.uint8).reshape(-1, 8)
        interface = [self._numbers.setdefault(row[3], len(self._numbers)) for row in rows]
        sent = np.array([row[4] for row in rows], dtype=np.bool_)
        return CandumpBlock(frames, np.array(interface, dtype=np.uint16), tuple(self._numbers), sent)


def _open_bus(target: Target, args: Namespace, named: bool) -> can.BusABC:
    from tipforce.host.bus import open_bus

    options = common.bus_options(args)
    if named:
        options["channel"] = target.channel
        options.setdefault("interface", _configured_interface())
        if options["interface"] == "socketcan" and target.channel == ANY:
            options["channel"] = ""
    return open_bus(**options)


def _configured_interface() -> str:
    """What python-can's files and environment name, else SocketCAN, so that `dump vcan0` works as `candump vcan0`."""
    try:
        return str(can.util.load_config()["interface"])
    except can.CanInterfaceNotImplementedError:
        return "socketcan"


def _configure(one: socket.socket, target: Target) -> None:
    """Give a SocketCAN socket candump's options, and forget what came in before it had them."""
    one.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, 0)
    one.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, b"")
    with suppress(BlockingIOError):
        while one.recv(_FD_BYTES, socket.MSG_DONTWAIT):
            pass
    one.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)
    one.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    one.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("=I", target.error_mask))
    if target.join:
        one.setsockopt(_SOL_CAN_RAW, _CAN_RAW_JOIN_FILTERS, 1)
    rules = [number for rule in target.filters for number in _kernel_filter(rule)] or [0, 0]
    one.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, struct.pack(f"={len(rules)}I", *rules))


def _kernel_filter(rule: Filter) -> tuple[int, int]:
    return rule.can_id | (_INVERSE_FLAG if rule.inverse else 0), rule.mask


def _receive(
    bus: can.BusABC,
    number: int,
    arrived: "queue.SimpleQueue[tuple[int, can.Message | Exception]]",
    stop: threading.Event,
) -> None:
    try:
        while not stop.is_set():
            message = bus.recv(_POLL_S)
            if message is not None:
                arrived.put((number, message))
    except (can.CanError, OSError) as error:
        arrived.put((number, error))
