"""SYNC to the last TPDO over loopback sockets: the node's loop beside canopen's LocalNode and raw-socket loops.

Frames are ``struct can_frame`` in datagrams between two connected UDP sockets on 127.0.0.1, each set of nodes in a
process of its own, the master in this one. The node's loop is running/loop.py with the node's own SocketCanPort,
only its socket is another one.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import multiprocessing
import select
import socket
import statistics
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import canopen
from bench.device import EDS, calibrated_node
from bench.loopback import connected_pair, python_can_bus

from canopen_device.can_frame import CAN_FRAME
from canopen_device.running import loop, ports
from tipforce.fingertip.sample import Sample

SYNC = CAN_FRAME.pack(0x80, 0, b"")
STOP_ID, MARK_ID = 0x7FF, 0x7FE  # the master ends a process, or has it note its CPU time
ROUNDS, WARM_UP, SYNCS = 5, 20, 1500


class Stopped(Exception):  # noqa: N818
    """The master is done."""


class Usage:
    """CPU time and time by the clock at each mark of the master."""

    def __init__(self) -> None:
        self._marks: list[tuple[float, float]] = []

    def control(self, can_id: int) -> None:
        """Act on a control frame. Raises Stopped at the last one."""
        if can_id == STOP_ID:
            raise Stopped
        self._marks.append((time.process_time(), time.perf_counter()))

    @property
    def share(self) -> float:
        """CPU time over wall time; 0 without two marks."""
        if len(self._marks) < 2:
            return 0.0
        (cpu_0, wall_0), (cpu_1, wall_1) = self._marks[0], self._marks[-1]
        return (cpu_1 - cpu_0) / (wall_1 - wall_0)


class CountingPort(ports.SocketCanPort):
    """The node's own port on a socket that is given; it looks for the master's control frames besides."""

    def __init__(self, bus: socket.socket, usage: Usage) -> None:
        ports._bound_socket = lambda interface: bus  # noqa: ARG005
        super().__init__("loopback")
        self._usage = usage

    def receive(self, timeout_s: float) -> loop.Frame | None:
        """The next frame."""
        frame = super().receive(timeout_s)
        if frame is not None and frame[0] >= MARK_ID:
            self._usage.control(frame[0])
        return frame


def run_tipforce(bus: socket.socket, nodes: int, usage: Usage) -> None:
    """The product: fingertip nodes in their loop."""
    loop.run([calibrated_node(k + 1, operational=False) for k in range(nodes)], CountingPort(bus, usage))


def _syncs(bus: socket.socket, usage: Usage) -> Iterator[None]:
    """Yields at each SYNC; the shortest loop there is that can also wait for a time."""
    while True:
        if not select.select([bus], [], [], 0.2)[0]:
            continue
        can_id, _, _ = CAN_FRAME.unpack(bus.recv(16))
        if can_id == 0x80:
            yield
        elif can_id >= MARK_ID:
            usage.control(can_id)


def run_raw(bus: socket.socket, nodes: int, usage: Usage) -> None:
    """By hand, with the same gauges, the same estimate and the same two PDOs, and no CANopen at all."""
    fingers = []
    for k in range(nodes):
        application: Any = calibrated_node(k + 1).application
        fingers.append((k + 1, application.source, application.channels.scaling, application.calibration.active))
    present, readings, counter = [False] * nodes, [finger[1].read(0) for finger in fingers], 0
    for _ in _syncs(bus, usage):
        now_us = loop.now_us()
        counter = counter + 1 & 0xFF
        for k, (node_id, source, scaling, active) in enumerate(fingers):
            readings[k] = source.read(now_us) or readings[k]
            sample = Sample(readings[k], scaling, active, was_present=present[k])
            status = sample.status()
            present[k] = bool(status & 1)
            strains = [round(10 * strain) for strain in sample.microstrains]
            P, phi, theta, _ = sample.contact()
            bus.send(CAN_FRAME.pack(0x180 + node_id, 8, struct.pack("<hhhBB", *strains, status, counter)))
            contact = (round(1000 * P), round(5729.578 * phi), round(5729.578 * theta)) if status & 1 else (-32768,) * 3
            bus.send(CAN_FRAME.pack(0x280 + node_id, 8, struct.pack("<hhhBB", *contact, status, counter)))


def run_local_node(bus: socket.socket, nodes: int, usage: Usage) -> None:
    """canopen's LocalNode with our EDS: at each SYNC a node of ours has the values, which two TPDOs send."""
    network, ended = canopen.Network(python_can_bus(bus)), threading.Event()
    fingers: list[tuple[Any, list[Any]]] = []
    for node_id in range(1, nodes + 1):
        file = io.StringIO(EDS.decode())
        file.name = "node.eds"
        node = network.create_node(node_id, canopen.import_od(file, node_id))
        node.tpdo.read(from_od=True)
        fingers.append((calibrated_node(node_id).application, [node.tpdo[1], node.tpdo[2]]))

    def on_sync(_can_id: int, _data: bytearray, _timestamp: float) -> None:
        for application, pdos in fingers:
            application.on_sync(loop.now_us(), 0)
            for pdo in pdos:
                for variable in pdo.map:
                    variable.raw = application.device.od.get(variable.index, variable.subindex)
            for pdo in pdos:
                pdo.transmit()

    network.subscribe(0x80, on_sync)
    network.subscribe(MARK_ID, lambda can_id, *_: usage.control(can_id))
    network.subscribe(STOP_ID, lambda *_: ended.set())
    network.connect()
    ended.wait()
    if network.notifier is not None:
        network.notifier.stop()


Runner = Callable[[socket.socket, int, Usage], None]
LOOPS: tuple[tuple[str, Runner], ...] = (
    ("fingertip node", run_tipforce),
    ("raw socket loop, same measurement by hand", run_raw),
    ("canopen LocalNode, same values set", run_local_node),
)


class Process:
    """One set of nodes in a process of its own, and the master's socket to it."""

    def __init__(self, runner: Runner, nodes: int) -> None:
        theirs, self._bus = connected_pair()
        self._pipe, end = multiprocessing.Pipe()
        self._expected = 2 * nodes
        self._process = multiprocessing.Process(target=_child, args=(runner, theirs, nodes, end), daemon=True)
        self._process.start()
        theirs.close()
        # Boot-up messages, heartbeats: wait until a SYNC is answered in full.
        self._bus.settimeout(0.3)
        for _ in range(60):
            self._bus.send(CAN_FRAME.pack(0x000, 2, b"\x01\x00"))
            if self.sync_us() is not None:
                with contextlib.suppress(TimeoutError):  # what a slow start left behind: answers to the SYNCs before
                    while True:
                        self._bus.recv(16)
                return
        raise RuntimeError("the nodes do not respond")

    def sync_us(self) -> float | None:
        """Send a SYNC; microseconds until its last TPDO, None if one is missing."""
        bus, left = self._bus, self._expected
        started_s = time.perf_counter()
        bus.send(SYNC)
        try:
            while left:
                # 180h-3FFh in little-endian: a TPDO; the rest is heartbeats and EMCY.
                if 1 <= bus.recv(16)[1] <= 3:
                    left -= 1
        except TimeoutError:
            return None
        return 1e6 * (time.perf_counter() - started_s)

    def mark(self) -> None:
        """Have the process note its CPU time."""
        self._bus.send(CAN_FRAME.pack(MARK_ID, 0, b""))

    def stop(self) -> float:
        """End the process; its CPU share between the marks."""
        self._bus.send(CAN_FRAME.pack(STOP_ID, 0, b""))
        share: float = self._pipe.recv()
        self._process.join()
        self._bus.close()
        return share


def _child(runner: Runner, bus: socket.socket, nodes: int, end: Any) -> None:
    usage = Usage()
    with contextlib.suppress(Stopped):
        runner(bus, nodes, usage)
    end.send(usage.share)


def latencies(nodes: int, syncs: int, period_s: float) -> list[list[list[float]]]:
    """Latencies in microseconds of each loop, by turn. The loops take turns, so that a busy machine hits all alike."""
    processes = [Process(runner, nodes) for _, runner in LOOPS]
    turns: list[list[list[float]]] = [[] for _ in LOOPS]
    for _ in range(ROUNDS):
        for of_loop, process in zip(turns, processes, strict=True):
            values = []
            for _ in range(syncs // ROUNDS + WARM_UP):
                time.sleep(period_s)
                values.append(process.sync_us())
            of_loop.append([value for value in values[WARM_UP:] if value is not None])
    for process in processes:
        process.stop()
    return turns


def report_latency(nodes: int, syncs: int = SYNCS) -> list[str]:
    """Median, p99, max of each loop, and the ratios of the medians."""
    turns = latencies(nodes, syncs, 0.002)
    lines = [f"SYNC to last TPDO, {nodes} nodes with TPDO1+TPDO2, {syncs} SYNCs each, microseconds"]
    own = statistics.median(itertools.chain(*turns[0]))
    for (what, _), of_loop in zip(LOOPS, turns, strict=True):
        values, medians = sorted(itertools.chain(*of_loop)), [statistics.median(turn) for turn in of_loop]
        median, p99 = statistics.median(values), values[min(len(values) - 1, int(0.99 * len(values)))]
        lines.append(
            f"  {what:<44}median {median:7.0f} ({min(medians):.0f}-{max(medians):.0f})  p99 {p99:7.0f}  "
            f"max {values[-1]:8.0f}  ours / this {own / median:5.2f}"
        )
    return lines


def report_cpu(nodes: int = 15, rate_hz: int = 500, seconds: float = 6.0) -> list[str]:
    """The load of a whole hand: CPU time over wall time of the nodes' process, and SYNCs answered in time."""
    lines = [f"{nodes} nodes at {rate_hz} Hz for {seconds:.0f} s (aim: under 25 % of a core)"]
    for what, runner in LOOPS[:2]:
        process = Process(runner, nodes)
        process.mark()
        count, answered, due_s = int(seconds * rate_hz), 0, time.perf_counter()
        for _ in range(count):
            due_s += 1.0 / rate_hz
            time.sleep(max(0.0, due_s - time.perf_counter()))
            answered += process.sync_us() is not None
        process.mark()
        share = process.stop()
        lines.append(
            f"  {what:<44}{100 * share:5.1f} % of a core, {100 * answered / count:.1f} % of the SYNCs answered"
        )
    return lines
