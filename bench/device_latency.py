"""SYNC to the last TPDO over loopback sockets: the node's loop beside canopen's LocalNode and raw-socket loops.

Frames are ``struct can_frame`` in datagrams between two connected UDP sockets on 127.0.0.1, each set of nodes in a
process of its own, the master in this one. The node's loop is running/loop.py with the node's own SocketCanPort,
only its socket is another one.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import select
import socket
import statistics
import struct
import time
from collections.abc import Callable
from typing import Any

from bench import device_local_node
from bench.device_costs import calibrated_node
from bench.device_usage import MARK_ID, STOP_ID, Stopped, Usage

from tipforce.device.node import Device
from tipforce.fingertip.dictionary import build
from tipforce.fingertip.sample import Sample
from tipforce.running import loop, ports
from tipforce.socketcan import CAN_FRAME

SYNC = CAN_FRAME.pack(0x80, 0, b"")
ROUNDS = 5
BASES = (0x180, 0x280)


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
    devices = [calibrated_node(k + 1, operational=False) for k in range(nodes)]
    loop.run(devices, CountingPort(bus, usage))


def run_core(bus: socket.socket, nodes: int, usage: Usage) -> None:
    """The device core with the fingertip's dictionary and no fingertip: the values in the PDOs never change."""
    devices = [Device(build(3, k + 1, True)) for k in range(nodes)]
    loop.run(devices, CountingPort(bus, usage))


def _syncs(bus: socket.socket, usage: Usage) -> Any:
    """Yields at each SYNC; the shortest loop there is that can also wait for a time."""
    while True:
        if not select.select([bus], [], [], 0.2)[0]:
            continue
        can_id, _, _ = CAN_FRAME.unpack(bus.recv(16))
        if can_id == 0x80:
            yield
        elif can_id >= MARK_ID:
            usage.control(can_id)


def run_raw_constant(bus: socket.socket, nodes: int, usage: Usage) -> None:
    """By hand, sending frames that are ready: nothing is measured, nothing is computed."""
    frames = [CAN_FRAME.pack(base + k + 1, 8, bytes(8)) for k in range(nodes) for base in BASES]
    for _ in _syncs(bus, usage):
        for frame in frames:
            bus.send(frame)


def run_raw_measuring(bus: socket.socket, nodes: int, usage: Usage) -> None:
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


Runner = Callable[[socket.socket, int, Usage], None]


class Process:
    """One set of nodes in a process of its own, and the master's socket to it."""

    def __init__(self, runner: Runner, nodes: int) -> None:
        self._bus, theirs = _connected_pair()
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
                self._drain()
                return
        raise RuntimeError(f"{runner.__name__} does not answer")

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

    def _drain(self) -> None:
        """Take what a slow start left behind: answers to the SYNCs before."""
        with contextlib.suppress(TimeoutError):
            while True:
                self._bus.recv(16)

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


def _connected_pair() -> tuple[socket.socket, socket.socket]:
    pair = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for end in pair:
        end.bind(("127.0.0.1", 0))
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    pair[0].connect(pair[1].getsockname())
    pair[1].connect(pair[0].getsockname())
    return pair[0], pair[1]


def _child(runner: Runner, bus: socket.socket, nodes: int, end: Any) -> None:
    usage = Usage()
    with contextlib.suppress(Stopped):
        runner(bus, nodes, usage)
    end.send(usage.share)


def latencies(runners: list[Runner], nodes: int, syncs: int, period_s: float) -> list[list[float]]:
    """Per runner all latencies in microseconds. The runners take turns, so that a busy machine hits all alike."""
    processes = [Process(runner, nodes) for runner in runners]
    found: list[list[float]] = [[] for _ in runners]
    for _ in range(ROUNDS):
        for k, process in enumerate(processes):
            for number in range(syncs // ROUNDS + 20):
                time.sleep(period_s)
                value = process.sync_us()
                if number >= 20 and value is not None:
                    found[k].append(value)
    for process in processes:
        process.stop()
    return found


def cpu_share(runner: Runner, nodes: int, rate_hz: int, seconds: float) -> tuple[float, float]:
    """CPU time over wall time of the nodes' process at that SYNC rate, and the share of SYNCs answered in time."""
    process = Process(runner, nodes)
    process.mark()
    count, answered = int(seconds * rate_hz), 0
    due_s = time.perf_counter()
    for _ in range(count):
        due_s += 1.0 / rate_hz
        time.sleep(max(0.0, due_s - time.perf_counter()))
        answered += process.sync_us() is not None
    process.mark()
    return process.stop(), answered / count


def percentile(values: list[float], share: float) -> float:
    """The value that this share of the values does not exceed."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def report_latency(nodes: int, syncs: int) -> list[str]:
    """Median, p99, max of each loop, and the ratios of the medians."""
    runners: list[tuple[str, Runner]] = [
        ("device core, constant values", run_core),
        ("raw socket loop, constant frames", run_raw_constant),
        ("canopen LocalNode, constant values", device_local_node.run_constant),
        ("fingertip node", run_tipforce),
        ("raw socket loop, same measurement by hand", run_raw_measuring),
        ("canopen LocalNode, same values set", device_local_node.run_measuring),
    ]
    found = latencies([runner for _, runner in runners], nodes, syncs, 0.002)
    lines = [f"SYNC to last TPDO, {nodes} nodes with TPDO1+TPDO2, {syncs} SYNCs each, microseconds"]
    for number, ((what, _), values) in enumerate(zip(runners, found, strict=True)):
        own = statistics.median(found[number // 3 * 3])  # ours of the same work
        median = statistics.median(values)
        part = len(values) // ROUNDS
        medians = [statistics.median(values[k * part : (k + 1) * part]) for k in range(ROUNDS)]
        lines.append(
            f"  {what:<44}median {median:7.0f} ({min(medians):.0f}-{max(medians):.0f})  p99 "
            f"{percentile(values, 0.99):7.0f}  max {max(values):8.0f}  ours / this {own / median:5.2f}"
        )
    return lines


def report_cpu(nodes: int = 15, rate_hz: int = 500, seconds: float = 6.0) -> list[str]:
    """The load of a whole hand."""
    lines = []
    for what, runner in (("tipforce", run_tipforce), ("raw socket loop, same measurement", run_raw_measuring)):
        share, answered = cpu_share(runner, nodes, rate_hz, seconds)
        lines.append(f"  {what:<44}{100 * share:5.1f} % of a core, {100 * answered:.1f} % of the SYNCs answered")
    return [f"{nodes} nodes at {rate_hz} Hz for {seconds:.0f} s (aim: under 25 % of a core)", *lines]
