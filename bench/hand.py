"""A whole hand over loopback sockets: what is lost, late or mixed at full rate, how regular the SYNC is, what it costs.

    python -m bench.hand    5 fingers at 1 kHz, 15 at 400 Hz, 600 s each; build/bench/hand-performance.md

The host is a real Hand with the receiver of SocketCAN; see loopback.py for the bus.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench.loopback import LoopbackLink, may_hurry
from bench.measure import Meter, arguments, machine, table, write_page

from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand, Statistics
from tipforce.host.hand.link import Link
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
    link = LoopbackLink(fingers, sync, realtime)
    plan, names = HandPlan(sync_hz=sync_hz), dict.fromkeys(range(1, fingers + 1), "")
    try:
        with tempfile.TemporaryDirectory() as folder, brought_up(Path(folder), names, plan, link=link) as hand:
            hand.events()
            latency_ns, incomplete, meter = list[np.ndarray](), 0, Meter()
            blocks = hand.blocks(60.0)  # a loaded machine starts the process that sends the SYNC late
            hand.start()
            for rows in blocks:
                if not latency_ns:  # the process that sends the SYNC has started
                    meter = Meter()
                latency_ns.append(time.time_ns() - rows.sync_ns)
                incomplete += int(rows.missing.any(axis=1).sum())
                if meter.elapsed_s >= seconds:
                    break
            elapsed_s, cpu_share = meter.elapsed_s, meter.share
            hand.stop()
            statistics, events = hand.statistics(), tuple(str(event) for event in hand.events())
    finally:
        link.close()
    producer = link.producer
    assert producer is not None
    p50, p99, largest = np.percentile(np.concatenate(latency_ns), (50, 99, 100)) / 1e3
    return Outcome(
        fingers, sync_hz, sync, elapsed_s, statistics, incomplete, producer.skipped, (p50, p99, largest),
        cpu_share, link.fingers_cpu_s / elapsed_s, events,
    )  # fmt: skip


def row(outcome: Outcome) -> list[str]:
    """A row of the table of losses."""
    tally = outcome.statistics.tally
    names = "delayed", "repeated", "missing", "late", "mixed", "doubtful"
    p50, p99, largest = outcome.latency_us
    return [
        f"{outcome.fingers} at {outcome.sync_hz:g} Hz", f"{outcome.seconds:.0f}", str(tally.rows),
        str(tally.rows * outcome.fingers), *(str(int(getattr(tally, name).sum())) for name in names),
        str(outcome.incomplete), str(outcome.statistics.dropped), str(outcome.statistics.overrun),
        f"{p50 / 1e3:.2f}", f"{p99 / 1e3:.2f}", f"{largest / 1e3:.1f}",
        f"{100 * outcome.host_cpu:.0f}%", f"{100 * outcome.fingers_cpu:.0f}%",
    ]  # fmt: skip


def jitter_row(outcome: Outcome) -> list[str]:
    """A row of the table of SYNCs."""
    sync = outcome.statistics.sync
    return [
        f"{outcome.fingers} at {outcome.sync_hz:g} Hz", outcome.sync, str(sync.periods), str(outcome.skipped),
        f"{sync.mean_period_us:.2f}", f"{sync.p50_us:g}", f"{sync.p99_us:g}", f"{sync.largest_us:.0f}",
    ]  # fmt: skip


HEADER = ["hand", "seconds", "rows", "values", "delayed", "stale", "missing", "late", "mixed", "doubtful",
          "rows not whole", "dropped", "overrun", "latency p50", "p99", "largest", "CPU host",
          "CPU fingers"]  # fmt: skip
JITTER_HEADER = ["hand", "sent by a", "periods", "skipped", "mean period", "p50", "p99", "largest"]


def main() -> int:
    parser = arguments(__doc__, "--realtime")
    parser.add_argument("--sync", choices=("process", "thread"), default="process", help="what sends the SYNC")
    args = parser.parse_args()
    if args.realtime and not may_hurry():
        parser.error("--realtime: not permitted here; run it as root, or with `ulimit -r 10` allowed")
    on, outcomes = machine("python-can", "canopen"), []
    for fingers, sync_hz in CASES:
        outcomes.append(measure(fingers, sync_hz, SECONDS, args.sync, args.realtime))
        print(*outcomes[-1].events[:10], sep="\n", flush=True)
    options = " --realtime" if args.realtime else ""
    written = f"Written by `python -m bench.hand{options}` on: {on}."
    tables = table(HEADER, map(row, outcomes)), table(JITTER_HEADER, map(jitter_row, outcomes))
    write_page("hand-performance", "\n\n".join([written, *tables]) + "\n")
    return 0 if not any(outcome.statistics.tally.mixed.any() for outcome in outcomes) else 1


if __name__ == "__main__":
    raise SystemExit(main())
