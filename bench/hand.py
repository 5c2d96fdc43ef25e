"""A whole hand over loopback sockets: what is lost, late or mixed at full rate, how regular the SYNC is, what it costs.

    python -m bench.hand                     5 fingers at 1 kHz, 15 at 400 Hz, 600 s each; docs/hand-performance.md
    python -m bench.hand --seconds 20        shorter, prints only

The host is a real Hand with the receiver of SocketCAN; see hand_bus.py for the bus.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench.device import machine
from bench.hand_bus import LoopbackLink, may_hurry
from bench.soak_fingers import calibration

from tipforce.host.configuration.calibration_file import write_calibration
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand, Statistics

PAGE = Path(__file__).parents[1] / "docs" / "hand-performance.md"
FULL_SECONDS = 600.0
CASES = ((5, 1000.0), (15, 400.0))


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run."""

    fingers: int
    sync_hz: float
    sync: str
    seconds: float
    statistics: Statistics
    incomplete: int
    """Rows with at least one finger missing."""
    skipped: int
    """SYNCs that their producer left out, because it ran late."""
    latency_us: tuple[float, float, float]
    """SYNC to row in the consumer's hands: p50, p99, largest."""
    host_cpu: float
    """Share of a core."""
    fingers_cpu: float
    events: tuple[str, ...]
    """Other than those of a start."""


def measure(fingers: int, sync_hz: float, seconds: float, sync: str = "process", realtime: bool = False) -> Outcome:
    """Bring up, run, count. Raises RuntimeError when a finger does not come up."""
    with tempfile.TemporaryDirectory() as folder:
        write_calibration(Path(folder, "cal.toml"), calibration())
        plans = tuple(FingerPlan(node_id=n, serial=n, calibration="cal.toml") for n in range(1, fingers + 1))
        file = HandFile(finger=plans, hand=HandPlan(sync_hz=sync_hz), folder=folder)
        link = LoopbackLink(fingers, sync, realtime)
        try:
            with Hand(file, link) as hand:
                failed = [str(report) for report in hand.bring_up() if not report.ok]
                if failed:
                    raise RuntimeError("; ".join(failed))
                hand.events()
                found = _run(hand, seconds)
                hand.stop()
                statistics, events = hand.statistics(), tuple(str(event) for event in hand.events())
        finally:
            link.close()
    producer = link.producer
    assert producer is not None
    latency_ns, incomplete, elapsed_s, cpu_s = found
    p50, p99, largest = np.percentile(latency_ns, (50, 99, 100)) / 1e3
    return Outcome(
        fingers, sync_hz, sync, elapsed_s, statistics, incomplete, producer.skipped, (p50, p99, largest),
        cpu_s / elapsed_s, link.fingers_cpu_s / elapsed_s, events,
    )  # fmt: skip


def _run(hand: Hand, seconds: float) -> tuple[np.ndarray, int, float, float]:
    """Latencies of the rows (ns), rows that lack a finger, and what it took: seconds, and of CPU time."""
    latency_ns: list[np.ndarray] = []
    incomplete = 0
    iterator = hand.blocks(60.0)  # a loaded machine starts the process that sends the SYNC late
    started_s, cpu_s = 0.0, 0.0
    hand.start()
    for rows in iterator:
        if not latency_ns:  # the process that sends the SYNC has started
            started_s, cpu_s = time.monotonic(), time.process_time()
        latency_ns.append(time.time_ns() - rows.sync_ns)
        incomplete += int(rows.missing.any(axis=1).sum())
        if time.monotonic() - started_s >= seconds:
            break
    return np.concatenate(latency_ns), incomplete, time.monotonic() - started_s, time.process_time() - cpu_s


def report(found: Outcome) -> str:
    """A row of the table of losses."""
    tally = found.statistics.tally
    names = "delayed", "repeated", "missing", "late", "mixed", "doubtful"
    counts = " | ".join(str(int(getattr(tally, name).sum())) for name in names)
    p50, p99, largest = found.latency_us
    values = tally.rows * found.fingers
    return (
        f"| {found.fingers} at {found.sync_hz:g} Hz | {found.seconds:.0f} | {tally.rows} | {values} "
        f"| {counts} | {found.incomplete} | {found.statistics.dropped} | {found.statistics.overrun} "
        f"| {p50 / 1e3:.2f} | {p99 / 1e3:.2f} | {largest / 1e3:.1f} "
        f"| {100 * found.host_cpu:.0f}% | {100 * found.fingers_cpu:.0f}% |"
    )


def report_jitter(found: Outcome) -> str:
    """A row of the table of SYNCs."""
    sync = found.statistics.sync
    return (
        f"| {found.fingers} at {found.sync_hz:g} Hz | {found.sync} | {sync.periods} | {found.skipped} "
        f"| {sync.mean_period_us:.2f} | {sync.p50_us:g} | {sync.p99_us:g} | {sync.largest_us:.0f} |"
    )


HEAD = """\
# A whole hand: losses, jitter, latency

Written by `python -m bench.hand{options}` on: {machine}.

Frames are `struct can_frame` in datagrams over UDP sockets on 127.0.0.1. The fingers run in one process (Python, by
`running/loop.py`), the SYNC in another, in place of the kernel's broadcast manager{realtime}.
The host is a `Hand` with the receiver of SocketCAN (`host/live/receive.py`), a consumer in another thread, and its own
connection for SDO and heartbeats.
`tests/vcan/test_hand_session.py` tests the same code on a real SocketCAN bus. Most delays here come from the machine:
three processes share its cores with other work, and a finger that is not scheduled responds late.

## Rows

Values are rows times fingers. Delayed: received after the next SYNC, assigned to their own row by the sample counter.
Stale: the finger had no new conversion (one each 500 us; after a delay it responds to several SYNCs at once), so P is
flagged as unknown. Missing: absent values. Late: samples that came after their row was delivered (each leaves its value
missing). Mixed: PDOs of two samples in one row. Doubtful: not shown, because the counter says that it
may be old. Dropped frames: by the kernel or a buffer. Overrun: rows that the consumer did not take. Latency: from the
SYNC (the kernel's time stamp) to the delivery of the row to the consumer, milliseconds.

| hand | seconds | rows | values | delayed | stale | missing | late | mixed | doubtful | rows not whole | dropped \
| overrun | latency p50 | p99 | largest | CPU host | CPU fingers |
|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|
"""
JITTER = """
## SYNC

Deviation of each received period from the nominal one, microseconds. Skipped: not sent, because the sender was more
than half a period late.

| hand | sent by a | periods | skipped | mean period | p50 | p99 | largest |
|---|---|---|---|---|---|---|---|
"""


def page(outcomes: list[Outcome], options: str, realtime: bool) -> str:
    """The document."""
    how = ", both with SCHED_FIFO in place of hardware" if realtime else ""
    lines = [HEAD.format(machine=machine(), options=options, realtime=how) + "\n".join(map(report, outcomes))]
    lines.append(JITTER + "\n".join(map(report_jitter, outcomes)) + "\n")
    return "\n".join(lines)


def main() -> int:
    """Run as a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=FULL_SECONDS, help="of each run (default %(default)g)")
    parser.add_argument("--sync", choices=("process", "thread"), default="process", help="what sends the SYNC")
    parser.add_argument("--realtime", action="store_true", help="fingers and SYNC with SCHED_FIFO; needs the right to")
    parser.add_argument("--case", type=int, choices=range(len(CASES)), help="only this one")
    args = parser.parse_args()
    if args.realtime and not may_hurry():
        parser.error("--realtime: not permitted here; run it as root, or with `ulimit -r 10` allowed")
    cases = CASES if args.case is None else (CASES[args.case],)
    outcomes = []
    for fingers, sync_hz in cases:
        outcomes.append(measure(fingers, sync_hz, args.seconds, args.sync, args.realtime))
        print(f"{report(outcomes[-1])}\n{report_jitter(outcomes[-1])}", *outcomes[-1].events[:10], sep="\n", flush=True)
    if args.seconds >= FULL_SECONDS and args.case is None:
        PAGE.write_text(page(outcomes, " --realtime" if args.realtime else "", args.realtime), encoding="utf-8")
    return 0 if not any(found.statistics.tally.mixed.any() for found in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
