"""Measure the device core: cost per request and SYNC, memory, latency beside other loops, CPU share of a hand.

    python -m bench.device                 everything, about a minute and a half
    python -m bench.device costs           inside one process
    python -m bench.device latency cpu     over loopback sockets

docs/device-performance.md holds the figures and what they mean.
"""

from __future__ import annotations

import gc
import itertools
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

import numpy as np
from bench.fuzz import STRAIN_PER_NEWTON
from bench.fuzz_frames import good_record
from bench.measure import ROOT, arguments, cpu_us, machine, median_and_spread

from canopen_device.core import storage
from canopen_device.core.node import Device
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import calibration_matrix, strain_matrix
from tipforce.sources.simulated import SimulatedSource

EDS = (ROOT / "eds" / "tipforce-3.eds").read_bytes()
REPEATS = 7
SYNC_PERIOD_US = 2000
TPDO1, TPDO2 = 1, 2
PARTS = ("costs", "latency", "cpu")


def _stored(record: bytes) -> dict[str, bytes]:
    return {"calibration": storage.with_crc(struct.pack("<fI", 1e4, 1) + record)}


def calibrated_node(node_id: int, tpdos: tuple[int, ...] = (TPDO1, TPDO2), operational: bool = True) -> Device:
    """A simulated fingertip with a calibration in force and a contact of 1 N, noise on its gauges."""
    source = SimulatedSource(STRAIN_PER_NEWTON, 0.2, seed=node_id)
    source.load = (1.0, 20.0, 10.0)
    device = fingertip_node(node_id, source, 3, node_id, load=_stored(good_record(Random(1))).get, eds=EDS)
    device.step(0)
    for number in (TPDO1, TPDO2):
        if number not in tpdos:
            cob_id = device.od.integer(0x1800 + number - 1, 1) | 0x80000000
            device.step(1, [(0x600 + node_id, struct.pack("<BHBI", 0x23, 0x1800 + number - 1, 1, cob_id))])
    if operational:
        device.step(2, [(0x000, b"\x01\x00")])
    device.requests.clear()
    return device


def judged_node(n: int, judged: bool) -> Device:
    """A node with ``n`` gauges whose calibration knows all of 2112h to 2116h, or nothing."""
    points = ("L", "R", "T", "U", "K_V", "S_V", "K_H", "S_H")[:n]
    known: dict[str, Any] = {
        "calibrated_force_newtons": 5.0, "overload_force_newtons": 19.0, "temperature_max_degC": 40.0,
        "model_uncertainty": 0.002, "gain_temperature_per_K": 3e-4, "redundancy_limit": 27.6,
    }  # fmt: skip
    calibration = Calibration(
        calibration_matrix(FABRICATED, points), np.zeros(n), 4e-14 * np.eye(n), **(known if judged else {})
    )
    source = SimulatedSource(strain_matrix(FABRICATED, points).tolist(), 0.2, seed=n)
    source.load = (1.0, 100.0, 90.0)
    device = fingertip_node(5, source, n, 5, load=_stored(calibration.record()).get)
    device.step(0)
    device.step(2, [(0x000, b"\x01\x00")])
    return device


def steps(devices: list[Device], frames: list[tuple[int, bytes]], count: int, period_us: int) -> Callable[[], int]:
    """``count`` times the same frames to all devices."""
    clock = times_us(period_us)

    def work() -> int:
        for _ in range(count):
            now_us = next(clock)
            for device in devices:
                device.step(now_us, frames)
        return count * len(devices)

    return work


def times_us(period_us: int) -> Iterator[int]:
    """Time for a device, later at each step."""
    return itertools.count(1_000_000 + period_us, period_us)


def _asking() -> Callable[..., bytes]:
    """Send a node an SDO request (missing bytes are 0); return its last response."""
    device, clock = calibrated_node(5), times_us(10)

    def ask(*request: int) -> bytes:
        sent, _ = device.step(next(clock), [(0x605, bytes(request).ljust(8, b"\0"))])
        return sent[-1][1] if sent else b""

    return ask


def _segmented_upload_of_the_eds() -> Callable[[], int]:
    ask = _asking()

    def work() -> int:
        ask(0x40, 0x21, 0x10)
        toggle = 0x60
        while not ask(toggle)[0] & 1:
            toggle ^= 0x10
        return 1

    return work


def _block_upload_of_the_eds() -> Callable[[], int]:
    """127 segments a block, CRC included."""
    ask = _asking()

    def work() -> int:
        ask(0xA4, 0x21, 0x10, 0, 127)
        last = ask(0xA3)
        while not last[0] & 0x80:
            last = ask(0xA2, 127, 127)
        ask(0xA2, last[0] & 0x7F, 127)
        ask(0xA1)
        return 1

    return work


def _readings() -> Callable[[], int]:
    """Readings of the simulated source, which are part of a SYNC here and hardware's work elsewhere."""
    application: Any = calibrated_node(5).application
    clock = times_us(SYNC_PERIOD_US)

    def work() -> int:
        for _ in range(5000):
            application.source.read(next(clock))
        return 5000

    return work


def _works() -> Iterator[tuple[str, str, Callable[[], int]]]:
    """(operation, aim, its work)."""
    for what, data in (
        ("SDO upload of 1017h, request and answer", struct.pack("<BHB4x", 0x40, 0x1017, 0)),
        ("SDO download of 1020h:1", struct.pack("<BHBI", 0x23, 0x1020, 1, 7)),
        ("SDO upload of 7130h:7 (a live value)", struct.pack("<BHB4x", 0x40, 0x7130, 7)),
    ):
        yield what, "aim 20", steps([calibrated_node(5)], [(0x605, data)], 5000, 10)
    yield f"segmented upload of 1021h, {len(EDS)} bytes, in all", "", _segmented_upload_of_the_eds()
    yield "block upload of the same, in all", "", _block_upload_of_the_eds()
    yield "one reading of the simulated gauges (part of each SYNC)", "", _readings()
    sync = [(0x80, b"")]
    for tpdos, what in (((TPDO1, TPDO2), "TPDO1+TPDO2"), ((TPDO2,), "TPDO2 alone")):
        for nodes in (1, 5, 15):
            devices = [calibrated_node(k + 1, tpdos) for k in range(nodes)]
            yield f"SYNC, {nodes} nodes, {what}, per node", "aim 40", steps(devices, sync, 6000 // nodes, 2000)
    yield "SYNC, 5 gauges, TPDO1+TPDO2, judged", "", steps([judged_node(5, True)], sync, 1000, 2000)
    what = "the same, a calibration that knows nothing to judge by"
    yield what, "", steps([judged_node(5, False)], sync, 1000, 2000)


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
    for what, aim, work in _works():
        work()
        median, spread = median_and_spread([cpu_us(work) for _ in range(REPEATS)])
        lines.append(f"  {what:<58}{median:10.1f} +- {spread:<8.1f}{aim}")
    return [*lines, f"memory per node: {memory_per_node() / 1024:.0f} KiB"]


def main() -> None:
    """Run as a command."""
    parser = arguments(__doc__)
    parser.add_argument("parts", nargs="*", metavar="|".join(PARTS), help="default: all")
    options = parser.parse_args()
    print(machine("python-can", "canopen"), flush=True)
    for part in options.parts or PARTS:
        if part == "costs":
            print("\n".join(report_costs()), flush=True)
            continue
        from bench import device_latency

        if part == "latency":
            for nodes in (1, 5, 15):
                print("\n".join(device_latency.report_latency(nodes)), flush=True)
        else:
            print("\n".join(device_latency.report_cpu()), flush=True)


if __name__ == "__main__":
    main()
