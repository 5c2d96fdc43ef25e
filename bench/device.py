"""Measure the device core: cost per request and SYNC, memory, latency beside other loops, CPU share of a hand.

python -m bench.device                 everything, about a minute and a half
python -m bench.device costs           inside one process
python -m bench.device latency cpu     over loopback sockets"""

import contextlib
import gc
import io
import itertools
import math
import multiprocessing
import select
import socket
import statistics
import struct
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from functools import partial
from random import Random
from typing import Any

import canopen
import numpy as np
from bench.fuzz import STRAIN_PER_NEWTON
from bench.fuzz_frames import good_record
from bench.loopback import connected_pair, python_can_bus
from bench.measure import ROOT, Meter, arguments, cpu_us, in_turns, machine

from canopen_device.can_frame import CAN_FRAME
from canopen_device.core import storage
from canopen_device.core.node import Device
from canopen_device.running import loop, ports
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix
from tipforce.sources.simulated import SimulatedSource

EDS = (ROOT / "eds" / "tipforce-3.eds").read_bytes()
REPEATS = 7
SYNC = CAN_FRAME.pack(0x80, 0, b"")
ROUNDS, WARM_UP, SYNCS = 5, 20, 1500  # of the latencies
RAW_FRAME, RAW_PDO = struct.Struct("=IB3x8s"), struct.Struct("<hhhBB")
RAW_STRAIN = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4))  # of three gauges, per newton


def _stored(record: bytes) -> dict[str, bytes]:
    return {"calibration": storage.with_crc(struct.pack("<fI", 1e4, 1) + record)}


def calibrated_node(node_id: int, operational: bool = True) -> Device:
    """A simulated fingertip with a calibration in force and a contact of 1 N, noise on its gauges."""
    source = SimulatedSource(STRAIN_PER_NEWTON, 0.2, seed=node_id)
    source.load = (1.0, 20.0, 10.0)
    record = good_record(Random(1))
    return _booted(fingertip_node(node_id, source, 3, node_id, load=_stored(record).get, eds=EDS), operational)


def _booted(device: Device, operational: bool) -> Device:
    device.step(0)
    if operational:
        device.step(2, [(0x000, b"\x01\x00")])
    device.requests.clear()
    return device


def judged_node(n: int) -> Device:
    """A node with ``n`` gauges whose calibration knows all of 2112h to 2116h."""
    points = ("L", "R", "T", "U", "K_V", "S_V", "K_H", "S_H")[:n]
    calibration = Calibration(
        calibration_matrix(FABRICATED, points), np.zeros(n), 4e-14 * np.eye(n), calibrated_force_newtons=5.0,
        overload_force_newtons=19.0, temperature_max_degC=40.0, model_uncertainty=0.002, gain_temperature_per_K=3e-4,
        redundancy_limit=27.6,
    )  # fmt: skip
    source = SimulatedSource(strain_matrix(FABRICATED, points).tolist(), 0.2, seed=n)
    source.load = (1.0, 100.0, 90.0)
    return _booted(fingertip_node(5, source, n, 5, load=_stored(calibration.record()).get), True)


def steps(devices: list[Device], frames: list[tuple[int, bytes]], count: int, period_us: int) -> Callable[[], int]:
    """``count`` times the same frames to all devices."""
    clock = itertools.count(1_000_000, period_us)

    def work() -> int:
        for _ in range(count):
            now_us = next(clock)
            for device in devices:
                device.step(now_us, frames)
        return count * len(devices)

    return work


def _upload_of_the_eds(in_blocks: bool) -> Callable[[], int]:
    """In segments, or in blocks of 127 segments, CRC included."""
    device, clock = calibrated_node(5), itertools.count(1_000_000, 10)

    def ask(*request: int) -> bytes:
        sent, _ = device.step(next(clock), [(0x605, bytes(request).ljust(8, b"\0"))])
        return sent[-1][1] if sent else b""

    def segments() -> int:
        ask(0x40, 0x21, 0x10)
        toggle = 0x60
        while not ask(toggle)[0] & 1:
            toggle ^= 0x10
        return 1

    def blocks() -> int:
        ask(0xA4, 0x21, 0x10, 0, 127)
        last = ask(0xA3)
        while not last[0] & 0x80:
            last = ask(0xA2, 127, 127)
        ask(0xA2, last[0] & 0x7F, 127)
        ask(0xA1)
        return 1

    return blocks if in_blocks else segments


def _works() -> Iterator[tuple[str, str, Callable[[], int]]]:
    """(operation, aim, its work)."""
    for what, data in (
        ("SDO upload of 1017h, request and answer", struct.pack("<BHB4x", 0x40, 0x1017, 0)),
        ("SDO upload of 7130h:7 (a live value)", struct.pack("<BHB4x", 0x40, 0x7130, 7)),
    ):
        yield what, "aim 20", steps([calibrated_node(5)], [(0x605, data)], 5000, 10)
    yield f"segmented upload of 1021h, {len(EDS)} bytes, in all", "", _upload_of_the_eds(False)
    yield "block upload of the same, in all", "", _upload_of_the_eds(True)
    sync = [(0x80, b"")]
    for nodes in (1, 15):
        devices = [calibrated_node(k + 1) for k in range(nodes)]
        yield f"SYNC, {nodes} nodes, TPDO1+TPDO2, per node", "aim 40", steps(devices, sync, 6000 // nodes, 2000)
    yield "SYNC, 5 gauges, TPDO1+TPDO2, judged", "", steps([judged_node(5)], sync, 1000, 2000)


def memory_per_node() -> int:
    """Bytes that one more node takes, code and the EDS (which all share) left out."""
    kept = [calibrated_node(k + 1) for k in range(2)]
    gc.collect()
    tracemalloc.start()
    kept += [calibrated_node(k + 3) for k in range(10)]
    gc.collect()
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return held // 10


def report_costs() -> list[str]:
    """The table, a line each."""
    lines = ["cost inside the core, microseconds of CPU time: median of 7 runs, +- largest deviation"]
    works = {what: (aim, partial(cpu_us, work)) for what, aim, work in _works()}
    in_turns({what: work for what, (_, work) in works.items()}, 1)  # warms up
    for what, figures in in_turns({what: work for what, (_, work) in works.items()}, REPEATS).items():
        median = statistics.median(figures)
        spread = max(abs(us - median) for us in figures)
        lines.append(f"  {what:<58}{median:10.1f} +- {spread:<8.1f}{works[what][0]}")
    return [*lines, f"memory per node: {memory_per_node() / 1024:.0f} KiB"]


# --- SYNC to the last TPDO over two connected UDP sockets on 127.0.0.1, each set of nodes in a process of its own ---


def run_tipforce(bus: socket.socket, nodes: int) -> None:
    """The product: fingertip nodes in their loop, with their own port on another socket."""
    ports._bound_socket = lambda interface: bus  # noqa: ARG005
    loop.run([calibrated_node(k + 1, operational=False) for k in range(nodes)], ports.SocketCanPort("loopback"))


def run_raw(bus: socket.socket, nodes: int) -> None:
    """By hand, nothing of the product: gauges with noise, F = C V, P, phi and theta, two PDOs, no CANopen at all."""
    draw, noise = Random(1).gauss, 0.2e-6
    C = [[1.0 / row[column] if column == k else 0.0 for k, row in enumerate(RAW_STRAIN)] for column in range(3)]
    true = [sum(c * f for c, f in zip(row, (0.342, 0.174, 0.940), strict=True)) for row in RAW_STRAIN]
    counter = 0
    while True:  # the shortest loop there is that can also wait for a time
        if not select.select([bus], [], [], 0.2)[0] or RAW_FRAME.unpack(bus.recv(16))[0] != 0x80:
            continue
        counter = counter + 1 & 0xFF
        for node_id in range(1, nodes + 1):
            V = [strain + draw(0.0, noise) for strain in true]
            f1, f2, f3 = [sum([c * v for c, v in zip(row, V, strict=True)]) for row in C]
            P = math.hypot(f1, f3)
            phi = math.atan2(f1, f3)
            theta = phi - math.asin(max(-1.0, min(1.0, f2 / P)))
            status = 3 if P > 0.05 else 2
            gauges = [round(1e7 * v) for v in V]
            bus.send(RAW_FRAME.pack(0x180 + node_id, 8, RAW_PDO.pack(*gauges, status, counter)))
            contact = round(1000 * P), round(math.degrees(phi) * 100), round(math.degrees(theta) * 100)
            bus.send(RAW_FRAME.pack(0x280 + node_id, 8, RAW_PDO.pack(*contact, status, counter)))


def run_local_node(bus: socket.socket, nodes: int) -> None:
    """canopen's LocalNode with our EDS: at each SYNC a node of ours has the values, which two TPDOs send."""
    network = canopen.Network(python_can_bus(bus))
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
    network.connect()
    threading.Event().wait()


Runner = Callable[[socket.socket, int], None]
LOOPS: tuple[tuple[str, Runner], ...] = (
    ("fingertip node", run_tipforce),
    ("independent loop in plain Python", run_raw),
    ("canopen LocalNode, same values set", run_local_node),
)


class Process:
    """One set of nodes in a process of its own, and the master's socket to it."""

    def __init__(self, runner: Runner, nodes: int) -> None:
        theirs, self._bus = connected_pair()
        self._expected = 2 * nodes
        self._process = multiprocessing.Process(target=runner, args=(theirs, nodes), daemon=True)
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
                self.meter = Meter(self._process.pid)
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

    def stop(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join()
        self._bus.close()


def latencies(nodes: int, syncs: int, period_s: float) -> dict[str, list[tuple[list[float], float]]]:
    """(latencies, processor time of the nodes a SYNC) in microseconds of each loop, by turn."""

    def turn(process: Process) -> tuple[list[float], float]:
        values, count = [], syncs // ROUNDS + WARM_UP
        before_s = process.meter.cpu_s
        for _ in range(count):
            time.sleep(period_s)
            values.append(process.sync_us())
        cpu_us = 1e6 * (process.meter.cpu_s - before_s) / count
        return [value for value in values[WARM_UP:] if value is not None], cpu_us

    processes = {what: Process(runner, nodes) for what, runner in LOOPS}
    turns = in_turns({what: partial(turn, process) for what, process in processes.items()}, ROUNDS)
    for process in processes.values():
        process.stop()
    return turns


def report_latency(nodes: int, syncs: int = SYNCS) -> list[str]:
    """Median and processor time of each loop; ours over it: medians of the turns and their range, totals."""
    turns = latencies(nodes, syncs, 0.002)
    lines = [f"SYNC to last TPDO, {nodes} nodes with TPDO1+TPDO2, {syncs} SYNCs each, microseconds"]
    own = turns[LOOPS[0][0]]
    for what, of_loop in turns.items():
        median, cpu_us = statistics.median(us for values, _ in of_loop for us in values), sum(us for _, us in of_loop)
        pairs = zip(own, of_loop, strict=True)
        ratios = [statistics.median(ours) / statistics.median(other) for (ours, _), (other, _) in pairs]
        middle, share = statistics.median(ratios), sum(us for _, us in own) / cpu_us
        lines.append(
            f"  {what:<36}median {median:6.0f}  processor {cpu_us / ROUNDS:6.0f}; "
            f"ours / this {middle:5.2f} ({min(ratios):.2f}-{max(ratios):.2f}), processor {share:5.2f}"
        )
    return lines


def report_cpu(nodes: int = 15, rate_hz: int = 500, seconds: float = 6.0) -> list[str]:
    """The load of a whole hand: CPU time over wall time of the nodes' process, and SYNCs answered in time."""
    lines = [f"{nodes} nodes at {rate_hz} Hz for {seconds:.0f} s (aim: under 25 % of a core)"]
    for what, runner in LOOPS[:2]:
        process = Process(runner, nodes)
        count, answered, due_s = int(seconds * rate_hz), 0, time.perf_counter()
        for _ in range(count):
            due_s += 1.0 / rate_hz
            time.sleep(max(0.0, due_s - time.perf_counter()))
            answered += process.sync_us() is not None
        share = process.meter.share
        process.stop()
        lines.append(
            f"  {what:<44}{100 * share:5.1f} % of a core, {100 * answered / count:.1f} % of the SYNCs answered"
        )
    return lines


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("parts", nargs="*", metavar="|".join(PARTS), help="default: all")
    options = parser.parse_args()
    print(machine("python-can", "canopen"), flush=True)
    for part in options.parts or PARTS:
        for work in PARTS[part]:
            print("\n".join(work()), flush=True)


PARTS: dict[str, tuple[Callable[[], list[str]], ...]] = {
    "costs": (report_costs,),
    "latency": tuple(partial(report_latency, nodes) for nodes in (1, 5, 15)),
    "cpu": (report_cpu,),
}

if __name__ == "__main__":
    main()
