"""What the device core costs inside one process: per SDO request, per transfer, per SYNC, and in memory."""

from __future__ import annotations

import binascii
import gc
import statistics
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from bench.fuzz import STRAIN_PER_NEWTON
from bench.fuzz_frames import good_record

from tipforce.device.node import Device
from tipforce.fingertip.application import Fingertip
from tipforce.fingertip.node import fingertip_node
from tipforce.host.configuration.calibration import Calibration
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import calibration_matrix, strain_matrix
from tipforce.sources.simulated import SimulatedSource

EDS = (Path(__file__).parents[1] / "eds" / "tipforce-3.eds").read_bytes()
REPEATS = 7
SYNC_PERIOD_US = 2000
TPDO1, TPDO2 = 1, 2


def calibrated_node(node_id: int, tpdos: tuple[int, ...] = (TPDO1, TPDO2), operational: bool = True) -> Device:
    """A simulated fingertip with a calibration in force and a contact of 1 N, noise on its gauges."""
    content = struct.pack("<fI", 1e4, 1) + good_record(Random(1))
    stored = {"calibration": struct.pack("<I", binascii.crc32(content)) + content}
    source = SimulatedSource(STRAIN_PER_NEWTON, 0.2, seed=node_id)
    source.load = (1.0, 20.0, 10.0)
    device = fingertip_node(node_id, source, 3, node_id, load=stored.get, eds=EDS)
    device.step(0)
    for number in (TPDO1, TPDO2):
        if number not in tpdos:
            cob_id = device.od.integer(0x1800 + number - 1, 1) | 0x80000000
            request = struct.pack("<BHBI", 0x23, 0x1800 + number - 1, 1, cob_id)
            device.step(1, [(0x600 + node_id, request)])
    if operational:
        device.step(2, [(0x000, b"\x01\x00")])
    device.requests.clear()
    return device


def timed(call: Callable[[], int]) -> tuple[float, float]:
    """(median, largest deviation from it) over the repeats of microseconds per unit; ``call`` returns its units."""
    found = []
    for _ in range(REPEATS):
        started_s = time.process_time()  # other work on the machine does not count
        units = call()
        found.append(1e6 * (time.process_time() - started_s) / units)
    median = statistics.median(found)
    return median, max(abs(value - median) for value in found)


class Clock:
    """Time for a device, later at each call."""

    def __init__(self, period_us: int) -> None:
        self.now_us = 1_000_000
        self._period_us = period_us

    def next(self) -> int:
        """One period later."""
        self.now_us += self._period_us
        return self.now_us


def sdo_requests(data: bytes) -> tuple[float, float]:
    """One expedited request and its answer."""
    device, clock, frames = calibrated_node(5), Clock(10), [(0x605, data)]

    def run() -> int:
        for _ in range(5000):
            device.step(clock.next(), frames)
        return 5000

    return timed(run)


def segmented_upload_of_the_eds() -> tuple[float, float]:
    """All requests of one segmented upload of 1021h."""
    device, clock = calibrated_node(5), Clock(10)

    def run() -> int:
        device.step(clock.next(), [(0x605, struct.pack("<BHB4x", 0x40, 0x1021, 0))])
        toggle, last = 0x60, 0
        while not last:
            sent, _ = device.step(clock.next(), [(0x605, bytes((toggle, 0, 0, 0, 0, 0, 0, 0)))])
            last = sent[-1][1][0] & 1
            toggle ^= 0x10
        return 1

    return timed(run)


def block_upload_of_the_eds() -> tuple[float, float]:
    """All requests of one block upload of 1021h, 127 segments a block, CRC included."""
    device, clock = calibrated_node(5), Clock(10)
    acknowledge = [(0x605, bytes((0xA2, 127, 127, 0, 0, 0, 0, 0)))]

    def run() -> int:
        device.step(clock.next(), [(0x605, struct.pack("<BHBB3x", 0xA4, 0x1021, 0, 127))])
        sent, _ = device.step(clock.next(), [(0x605, b"\xa3" + bytes(7))])
        while not sent[-1][1][0] & 0x80:
            sent, _ = device.step(clock.next(), acknowledge)
        device.step(clock.next(), [(0x605, bytes((0xA2, len(sent), 127, 0, 0, 0, 0, 0)))])
        device.step(clock.next(), [(0x605, b"\xa1" + bytes(7))])
        return 1

    return timed(run)


def syncs(nodes: int, tpdos: tuple[int, ...]) -> tuple[float, float]:
    """One SYNC at every one of ``nodes`` nodes, all their TPDOs packed."""
    devices, clock, frames = [calibrated_node(k + 1, tpdos) for k in range(nodes)], Clock(SYNC_PERIOD_US), [(0x80, b"")]
    count = 6000 // nodes

    def run() -> int:
        for _ in range(count):
            now_us = clock.next()
            for device in devices:
                device.step(now_us, frames)
        return count

    run()
    return timed(run)


def gauge_source() -> tuple[float, float]:
    """One reading of the simulated source, which is part of a SYNC here and hardware's work elsewhere."""
    application = calibrated_node(5).application
    assert isinstance(application, Fingertip)
    source, clock = application.source, Clock(SYNC_PERIOD_US)

    def run() -> int:
        for _ in range(5000):
            source.read(clock.next())
        return 5000

    return timed(run)


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


def judged_syncs(n: int, judged: bool) -> tuple[float, float]:
    """A SYNC of a node with ``n`` gauges whose calibration knows all of 2112h to 2116h, or nothing."""
    points = ("L", "R", "T", "U", "K_V", "S_V", "K_H", "S_H")[:n]
    rows = strain_matrix(FABRICATED, points)
    known: dict[str, Any] = {
        "calibrated_force_newtons": 5.0, "overload_force_newtons": 19.0, "temperature_max_degC": 40.0,
        "model_uncertainty": 0.002, "gain_temperature_per_K": 3e-4, "redundancy_limit": 27.6,
    }  # fmt: skip
    calibration = Calibration(
        calibration_matrix(FABRICATED, points), np.zeros(n), 4e-14 * np.eye(n), **(known if judged else {})
    )
    content = struct.pack("<fI", 1e4, 1) + calibration.record()
    stored = {"calibration": struct.pack("<I", binascii.crc32(content)) + content}
    source = SimulatedSource(rows.tolist(), 0.2, seed=n)
    source.load = (1.0, 100.0, 90.0)
    device = fingertip_node(5, source, n, 5, load=stored.get)
    device.step(0)
    device.step(2, [(0x000, b"\x01\x00")])
    clock = Clock(SYNC_PERIOD_US)

    def run() -> int:
        for _ in range(1000):
            device.step(clock.next(), [(0x080, b"")])
        return 1000

    return timed(run)


def report_costs() -> list[str]:
    """The table, a line each."""
    lines = ["cost inside the core, microseconds of CPU time: median of 7 runs, +- largest deviation"]

    def line(what: str, found: tuple[float, float], aim: str = "") -> None:
        lines.append(f"  {what:<58}{found[0]:10.1f} +- {found[1]:<8.1f}{aim}")

    line("SDO upload of 1017h, request and answer", sdo_requests(struct.pack("<BHB4x", 0x40, 0x1017, 0)), "aim 20")
    line("SDO download of 1020h:1", sdo_requests(struct.pack("<BHBI", 0x23, 0x1020, 1, 7)), "aim 20")
    line("SDO upload of 7130h:7 (a live value)", sdo_requests(struct.pack("<BHB4x", 0x40, 0x7130, 7)), "aim 20")
    line(f"segmented upload of 1021h, {len(EDS)} bytes, in all", segmented_upload_of_the_eds())
    line("block upload of the same, in all", block_upload_of_the_eds())
    line("one reading of the simulated gauges (part of each SYNC)", gauge_source())
    for tpdos, what in (((TPDO1, TPDO2), "TPDO1+TPDO2"), ((TPDO2,), "TPDO2 alone")):
        for nodes in (1, 5, 15):
            median, spread = syncs(nodes, tpdos)
            line(f"SYNC, {nodes} nodes, {what}, per node", (median / nodes, spread / nodes), "aim 40")
    line("SYNC, 5 gauges, TPDO1+TPDO2, judged", judged_syncs(5, True))
    line("the same, a calibration that knows nothing to judge by", judged_syncs(5, False))
    lines.append(f"memory per node: {memory_per_node() / 1024:.0f} KiB")
    return lines
