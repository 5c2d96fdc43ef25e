"""A node for a day: `python -m bench.endurance`. Memory must not grow, and no counter may drift.

The node's own loop runs on a clock that is moved and not waited for, on an Industrial I/O source whose devices are
played. Once an hour one is pulled out for a second, a gauge saturates, the bus loses a SYNC, the calibration is stored.
"""

import gc
import logging
import sys
import tempfile
import time
from array import array
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from bench.measure import arguments, resident_bytes, table

from canopen_device.running import loop
from canopen_device.running.store import FileStore
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.iio import IioSource
from tipforce.sources.iio_sysfs import PolledDevice

NODE_ID = 5
SYNC_US, HEARTBEAT_US, HOUR_US = 100_000, 1_000_000, 3_600_000_000
ZERO, ENDS = 2048, (0, 4095)
OUTAGE_US, HOURS = 1_000_000, 24


class Hour(NamedTuple):
    """What was found after an hour."""

    blocks: int  # memory blocks that Python holds
    resident_kb: int
    syncs: int
    heartbeats: int
    samples: int  # counter steps that the PDOs showed, wraps added up
    emcys: int
    log_lines: int
    late_us: int  # the largest difference between a PDO and its SYNC, of a heartbeat and its second


class Gauge(PolledDevice):
    """One device of the source, with one channel; ``trouble`` is "", "gone" or "end"."""

    def __init__(self, name: str, seed: int) -> None:
        self.name = name
        self.trouble = ""
        self._state = seed

    def read(self, _now_us: int) -> tuple[int, ...] | None:
        if self.trouble == "gone":
            raise OSError(19, "No such device")
        self._state = self._state * 1103515245 + 12345 & 0x7FFFFFFF
        return (ENDS[1] if self.trouble == "end" else ZERO + (self._state >> 16) % 9 - 4,)

    def reopen(self) -> None:
        if self.trouble == "gone":
            raise OSError(19, "No such device")

    def temperature(self) -> int:
        return 2300

    def close(self) -> None:
        pass


class Bus:
    """The port of the loop: moves the clock to what comes next, and keeps count of what the node sends."""

    def __init__(self, gauges: list[Gauge]) -> None:
        self.now_us = 1_000_000
        self.next_sync_us = self.now_us + SYNC_US
        self.syncs = self.heartbeats = self.samples = self.emcys = self.late_us = 0
        self.until_us = 0
        self._gauges = gauges
        self._counter = 0
        self._first_heartbeat_us = -1
        self._pending: list[loop.Frame] = [(0x000, bytes((1, NODE_ID)))]

    def clock(self) -> int:
        return self.now_us

    def over(self) -> bool:
        return self.now_us >= self.until_us

    def receive(self, timeout_s: float) -> loop.Frame | None:
        if self._pending:
            return self._pending.pop(0)
        due_us = self.now_us + round(1e6 * timeout_s)
        if due_us < self.next_sync_us:
            self.now_us = max(due_us, self.now_us + 1)
            return None
        self.now_us = self.next_sync_us
        self.next_sync_us += SYNC_US
        into_us = self.now_us % HOUR_US
        self._gauges[1].trouble = "gone" if into_us // OUTAGE_US == 600 else ""
        self._gauges[2].trouble = "end" if into_us // SYNC_US == 12_000 else ""
        if into_us // SYNC_US == 18_000:
            self._pending.append((0x600 + NODE_ID, b"\x23\x10\x10\x01save"))
        if into_us // SYNC_US == 24_000:
            return None  # this SYNC is lost
        self.syncs += 1
        return 0x080, b""

    def send(self, frames: Iterable[loop.Frame]) -> None:
        for can_id, data in frames:
            if can_id == 0x180 + NODE_ID:
                self.samples += data[7] - self._counter & 0xFF
                self._counter = data[7]
                self.late_us = max(self.late_us, abs(self.now_us - (self.next_sync_us - SYNC_US)))
            elif can_id == 0x700 + NODE_ID and data != b"\0":
                if self._first_heartbeat_us < 0:
                    self._first_heartbeat_us = self.now_us
                late_us = (self.now_us - self._first_heartbeat_us) - self.heartbeats * HEARTBEAT_US
                self.late_us = max(self.late_us, abs(late_us))
                self.heartbeats += 1
            elif can_id == 0x080 + NODE_ID:
                self.emcys += 1

    def request(self, what: str, value: int, delay_ms: int) -> None:
        pass


class _Count(logging.Handler):
    lines = 0

    def emit(self, _record: logging.LogRecord) -> None:
        self.lines += 1


def run(hours: int, hour_us: int = HOUR_US, seed: int = 1) -> list[Hour]:
    """The state after each of ``hours`` hours of ``hour_us``."""
    gauges = [Gauge(f"iio:device{k}", seed + k) for k in range(3)]
    bus = Bus(gauges)
    width = len(Hour._fields)
    figures = array("q", bytes(8 * width * hours))  # what is measured is not to grow by being noted
    log, logger = _Count(), logging.getLogger("tipforce")
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.multiple(logger, propagate=False, handlers=[log]),
        mock.patch.object(loop, "now_us", bus.clock),
    ):
        source = IioSource(gauges, 3, (16, 2.0, ((2048.0, 4048.0),) * 3), ENDS, clock=bus.clock)
        store = FileStore(Path(folder) / "node.json")
        device = fingertip_node(NODE_ID, source, save=store.save, load=store.load)
        for number in range(hours):
            bus.until_us += hour_us if bus.until_us else bus.now_us + hour_us
            loop.run([device], bus, bus.over)
            gc.collect()
            figures[number * width : (number + 1) * width] = array("q", (
                sys.getallocatedblocks(), resident_bytes() // 1000, bus.syncs, bus.heartbeats, bus.samples, bus.emcys,
                log.lines, bus.late_us,
            ))  # fmt: skip
    return [Hour(*figures[start : start + width]) for start in range(0, len(figures), width)]


def main() -> int:
    """Run and print; 1 where memory grew or a frame was late."""
    arguments(__doc__).parse_args()
    began_s, hours = time.perf_counter(), run(HOURS)
    header = ["hour", *(name.replace("_", " ") for name in Hour._fields)]
    print(table(header, [[str(number), *map(str, hour)] for number, hour in enumerate(hours, 1)], markdown=False))
    first, last = hours[min(1, len(hours) - 1)], hours[-1]
    print(f"blocks since the second hour: {last.blocks - first.blocks:+}; {time.perf_counter() - began_s:.0f} s")
    return 0 if abs(last.blocks - first.blocks) < 200 and last.late_us == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
