"""A whole hand over loopback sockets: what is lost, late or mixed at full rate, how regular the SYNC is, what it costs.

    python -m bench.hand           5 fingers at 1 kHz, 15 at 400 Hz, 600 s each; build/bench/hand-performance.md
    python -m bench.hand --rows    what a row of five fingers costs, beside plain struct code; instructions by valgrind

The host is a real Hand with the receiver of SocketCAN; see loopback.py for the bus."""

import argparse
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import product
from math import inf, nan
from pathlib import Path
from statistics import median
from types import SimpleNamespace
from typing import NamedTuple, cast
from unittest import mock

import numpy as np
from bench.loopback import LoopbackLink, connected_pair, may_hurry
from bench.measure import Meter, arguments, cpu_us, in_turns, machine, table, write_page

from canopen_device.can_frame import CAN_FRAME
from canopen_device.core.codes import SYNC_COB_ID, TPDO_BASES
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.frames.frame_array import FrameArray, frame_array
from tipforce.host.hand import hand as hand_module
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand, Statistics
from tipforce.host.hand.link import Link
from tipforce.host.hand.rows import Collector, rows_one_by_one
from tipforce.host.live.receive import SocketReceiver
from tipforce.samples.record import RowContacts
from tipforce.scene import beam_calibration

SECONDS = 600.0
CASES = ((5, 1000.0), (15, 400.0))
NOISE_MICROSTRAIN = 0.5
CALIBRATION = beam_calibration(pull=True, noise_microstrain=NOISE_MICROSTRAIN)  # of the simulated fingers


@contextmanager
def brought_up(
    folder: Path, names: dict[int, str], plan: HandPlan, bus: dict[str, str] | None = None, link: Link | None = None
) -> Iterator[Hand]:
    """A hand of these fingers (name by node-id), calibrated. Raises RuntimeError when a finger does not come up."""
    write_calibration(folder / "cal.toml", CALIBRATION)
    fingers = tuple(FingerPlan(node_id=n, name=name, serial=n, calibration="cal.toml") for n, name in names.items())
    with Hand(HandFile(finger=fingers, hand=plan, bus=bus or {}, folder=str(folder)), link) as hand:
        failed = [str(report) for report in hand.bring_up() if not report.ok]
        if failed:
            raise RuntimeError("; ".join(failed))
        yield hand


class Outcome(NamedTuple):
    """One run: values, and milliseconds from SYNC to row in the consumer's hands; its events, but those of a start."""

    row: list[str]  # by HEADER
    statistics: Statistics
    latency_ms: tuple[float, float, float]
    events: tuple[str, ...]


HEADER = ["hand", "seconds", "values", "stale", "missing", "late", "mixed", "dropped", "latency p50", "p99", "largest",
          "CPU host"]  # fmt: skip


def measure(fingers: int, sync_hz: float, seconds: float, realtime: bool = False) -> Outcome:
    """Bring up, run, count. Raises RuntimeError when a finger does not come up."""
    link = LoopbackLink(fingers, realtime)
    plan, names = HandPlan(sync_hz=sync_hz), dict.fromkeys(range(1, fingers + 1), "")
    try:
        with tempfile.TemporaryDirectory() as folder, brought_up(Path(folder), names, plan, link=link) as hand:
            hand.events()
            latency_ns, meter = list[np.ndarray](), Meter()
            blocks = hand.blocks(60.0)  # a loaded machine starts the process that sends the SYNC late
            hand.start()
            for rows in blocks:
                if not latency_ns:  # the process that sends the SYNC has started
                    meter = Meter()
                latency_ns.append(time.time_ns() - rows.sync_ns)
                if meter.elapsed_s >= seconds:
                    break
            elapsed_s, cpu_share = meter.elapsed_s, meter.share
            hand.stop()
            statistics, events = hand.statistics(), tuple(str(event) for event in hand.events())
    finally:
        link.close()
    p50, p99, largest = np.percentile(np.concatenate(latency_ns), (50, 99, 100)) / 1e6
    tally = statistics.tally
    row = [
        f"{fingers} at {sync_hz:g} Hz", f"{elapsed_s:.0f}", str(tally.rows * fingers),
        *(str(int(count.sum())) for count in (tally.repeated, tally.missing, tally.late, tally.mixed)),
        str(statistics.dropped), f"{p50:.2f}", f"{p99:.2f}", f"{largest:.1f}", f"{cpu_share:.0%}",
    ]  # fmt: skip
    return Outcome(row, statistics, (p50, p99, largest), events)


FINGERS = ("thumb", "index", "middle", "ring", "little")
_PDO = struct.Struct("<hhhBB")
_RECORD = struct.Struct("<qIB3x8s")


def row_frames(rows: int) -> list[tuple[int, int, bytes]]:
    """Numbered SYNCs, and a Contact PDO of each finger."""
    frames = []
    for row in range(rows):
        number, t_ns = row % 240 + 1, row * 1_000_000
        frames.append((t_ns, SYNC_COB_ID, bytes((number,))))
        for k in range(len(FINGERS)):
            data = _PDO.pack(1000 + row % 500 + k, 4500 - row % 100, 3000, 3, number)
            frames.append((t_ns + 100_000 * (k + 1), TPDO_BASES[1] + 1 + k, data))
    return frames


def plain_rows(calls: list[FrameArray]) -> int:
    """What a user writes with struct for the same: P, phi and theta of all fingers by name, from whole rows."""
    names = {TPDO_BASES[1] + 1 + k: name for k, name in enumerate(FINGERS)}
    row: dict[str, tuple[float, float, float, int]] = {}
    number, count, newtons = -1, 0, 0.0
    for frames in calls:
        for _, can_id, length, data in _RECORD.iter_unpack(frames.tobytes()):
            if can_id == SYNC_COB_ID:
                number, row = data[0], {}
            elif can_id in names and length == 8:
                P, phi, theta, status, counter = _PDO.unpack(data)
                if counter == number:
                    row[names[can_id]] = (
                        P / 1000 if P != -0x8000 else nan, phi / 100 if phi != -0x8000 else nan,
                        theta / 100 if theta != -0x8000 else nan, status,
                    )  # fmt: skip
                    if len(row) == len(FINGERS):
                        newtons, count = newtons + row["thumb"][0], count + 1
    return count


def product_rows(calls: list[FrameArray]) -> int:
    """Frames to rows to ``row["thumb"].P_newtons``."""
    collector = Collector(range(1, len(FINGERS) + 1), own_sync=True)
    contacts = RowContacts(collector.node_ids, FINGERS, [CALIBRATION] * len(FINGERS))
    count, newtons, now_s = 0, 0.0, 0.0
    for frames in calls:
        now_s += 1e-4
        rows = collector.add(frames, now_s)
        if rows.raw:
            for row in rows_one_by_one(rows, contacts):
                newtons, count = newtons + row["thumb"].P_newtons, count + 1
    return count


class SocketPair:
    """A link whose frames come from a socket; each ``feed`` sends those of a row."""

    owned, dropped = True, 0

    def __init__(self, rows: int) -> None:
        receiver, self._sender = connected_pair()
        self._receiver = SocketReceiver(receiver, "loopback", tick_s=0.0)
        self._frames = [CAN_FRAME.pack(can_id, len(data), data) for _, can_id, data in row_frames(rows)]

    def feed(self, row: int) -> None:
        """Send the frames of a row."""
        for frame in self._frames[6 * row : 6 * row + 6]:
            self._sender.send(frame)

    def receive(self, timeout_s: float) -> FrameArray:
        return self._receiver.receive(timeout_s)


def running_rows(rows: int, receives: bool = True) -> int:
    """The same by a running Hand, from the socket to ``row["thumb"].P_newtons``; else the frames are only sent."""
    link = SocketPair(rows)
    plans = tuple(FingerPlan(node_id=k + 1, name=name) for k, name in enumerate(FINGERS))
    hand = Hand(HandFile(finger=plans, hand=HandPlan(sync_hz=1000.0), bus={}, folder="."), cast("Link", link))
    contacts = RowContacts(hand.node_ids, FINGERS, [CALIBRATION] * len(FINGERS))
    made = hand._delivery.rows(partial(rows_one_by_one, contacts=contacts), 0.0)
    hand._probe_s, newtons, count = inf, 0.0, 0  # no finger is lost
    # A row a millisecond, also in valgrind.
    clock = SimpleNamespace(monotonic=lambda: 1e-3 * count, time_ns=time.time_ns)
    with mock.patch.object(hand_module, "time", clock):
        for row in range(rows):
            link.feed(row)
            if receives:
                hand._step(0.0)
                if row:  # the first SYNC has no number before it
                    newtons, count = newtons + next(made)["thumb"].P_newtons, count + 1
    return count


def row_costs() -> str:
    """Microseconds of processor time a row with six frames a call, by plain struct code and by tipforce, in turns."""
    frames = row_frames(1000)
    calls = [frame_array(frames[at : at + 6]) for at in range(0, len(frames), 6)]
    ways = {"plain struct": plain_rows, "tipforce": product_rows}
    figures = in_turns({name: partial(cpu_us, partial(way, calls)) for name, way in ways.items()}, 15)
    plain, ours = (median(us) for us in figures.values())
    return f"plain struct {plain:.2f} us a row, tipforce {ours:.2f}: {ours / plain:.2f} times"


def instructions() -> float:
    """Instructions a row, by valgrind, of the running hand without those of sending."""
    counts = {}
    for rows, way in product((200, 4200), ("", "-sent")):
        words = [sys.executable, "-m", "bench.hand", f"--step{way}", str(rows)]
        valgrind = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", *words]
        same = {**os.environ, "PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1"}  # its threads count while they wait
        said = subprocess.run(valgrind, check=True, capture_output=True, text=True, env=same).stderr
        counts[rows, way] = int(said.partition("Collected :")[2].split()[0])
    both, sent = (counts[4200, way] - counts[200, way] for way in ("", "-sent"))
    return (both - sent) / 4000  # so many that a collection of garbage more or less does not count


def main() -> int:
    parser = arguments(__doc__, "--realtime")
    parser.add_argument("--rows", action="store_true", help="only what a row costs")
    parser.add_argument("--step", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--step-sent", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.step or args.step_sent:
        running_rows(args.step or args.step_sent, bool(args.step))
        return 0
    if args.rows:
        print(row_costs())
        if shutil.which("valgrind"):
            print(f"{instructions():,.0f} instructions a row, from the socket to row['thumb'].P_newtons")
        return 0
    if args.realtime and not may_hurry():
        parser.error("--realtime: not permitted here; run it as root, or with `ulimit -r 10` allowed")
    on, outcomes = machine("python-can", "canopen"), []
    for fingers, sync_hz in CASES:
        outcomes.append(measure(fingers, sync_hz, SECONDS, args.realtime))
        print(*outcomes[-1].events[:10], sep="\n", flush=True)
    options = " --realtime" if args.realtime else ""
    written = f"Written by `python -m bench.hand{options}` on: {on}."
    write_page("hand-performance", f"{written}\n\n{table(HEADER, [outcome.row for outcome in outcomes])}\n")
    return 0 if not any(outcome.statistics.tally.mixed.any() for outcome in outcomes) else 1


if __name__ == "__main__":
    raise SystemExit(main())
