"""Measure the live receive path beside canopen's PDO path and python-can, over loopback sockets.

    python -m bench.live                     about five minutes, and writes docs/live-performance.md
    python -m bench.live --seconds 5         shorter runs at a steady rate, prints only

Frames are ``struct can_frame`` in datagrams between connected UDP sockets on 127.0.0.1; what reads them is the code
that reads SocketCAN, options and time stamps included. Costs are CPU time and come from one run in which the ways take
turns.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from functools import partial
from pathlib import Path

from bench import live_costs, live_load
from bench.device import machine
from bench.live_load import Load

PAGE = Path(__file__).parents[1] / "docs" / "live-performance.md"
FULL_SECONDS = 20.0
RATES_HZ = (5000, 30_000)
LOGGER_HZ = 10_000

HEAD = """\
# The live receive path: cost, losses, lag

Written by `python -m bench.live` on: {machine}.

Frames are `struct can_frame` in datagrams between connected UDP sockets on 127.0.0.1, read by the code that reads
SocketCAN (`host/live/`), with the kernel's time stamps. That the same code loses nothing and
keeps the order on a real vcan is tested in `tests/vcan`. Another machine gives other times; the ways compare as here.
"""
COSTS = """
## Cost per frame
CPU time of the process per Contact PDO, {rounds} rounds of {frames} frames in which the ways take turns. "Decode" means
all signals of the PDO as numpy columns. python-can and canopen are called without a Notifier thread, their best case.

"""
LOADS = """
## {rate:,} frames a second
{seconds:g} s each, received and decoded as they come; the sender is a process of its own. Lag: from the kernel's stamp
to decoded values, of every frame, in milliseconds. Other work on the machine comes in bursts, so the table also has
the 99th percentile of the median second, and in brackets of the best and the worst second. The busy thread is a Python
loop in the receiving process that never pauses; its CPU time is in the share of a core, too. While a receiver is open,
Python's switch interval is 0.5 ms; 5 ms is Python's own.

| run | sent | received | dropped | in order | lag median | p99 | p99 by seconds | largest | CPU | frames a batch |
|---|---|---|---|---|---|---|---|---|---|---|
"""
LOGGERS = """
## Recording
{rate:,} frames a second for {seconds:g} s to a file in candump's log format, one logger after the other, as share of
one core.

| logger | CPU of a core | frames recorded |
|---|---|---|
"""


def load_row(name: str, load: Load) -> str:
    """A line of the table of steady runs."""
    order = "yes" if load.in_order and load.stamps_rise else "NO"
    each = load.lag_p99_seconds_ms
    typical = f"{statistics.median(each):.1f} ({min(each):.1f} to {max(each):.1f})"
    lags = f"{load.lag_median_ms:.2f} | {load.lag_p99_ms:.1f} | {typical} | {load.lag_max_ms:.1f}"
    counts = f"{load.sent} | {load.received} | {load.dropped} | {order}"
    return f"| {name} | {counts} | {lags} | {load.cpu_share:.0%} | {load.frames_a_batch:.0f} |"


def report(rounds: int, seconds: float) -> str:
    """The page: everything measured once."""
    parts = [HEAD.format(machine=machine()), COSTS.format(rounds=rounds, frames=live_costs.FRAMES)]
    parts.append("\n".join(live_costs.table(live_costs.measure(rounds))) + "\n")
    for rate_hz in RATES_HZ:
        parts.append(LOADS.format(rate=rate_hz, seconds=seconds))
        ours, by_hand = partial(live_load.run_load, rate_hz, seconds), partial(live_load.run_struct, rate_hz, seconds)
        for name, run in (
            ("alone", ours),
            ("one busy Python thread", partial(ours, busy=True)),
            ("the same, switch interval 5 ms", partial(ours, busy=True, switch_s=0.005)),
            ("python-can with struct, alone", by_hand),
            ("python-can with struct, one busy Python thread", partial(by_hand, busy=True)),
        ):
            parts.append(load_row(name, run()) + "\n")
    logger_s = min(seconds, 20.0)
    parts.append(LOGGERS.format(rate=LOGGER_HZ, seconds=logger_s))
    for name, (share, frames) in live_load.log_shares(LOGGER_HZ, logger_s).items():
        parts.append(f"| {name} | {share:.1%} | {frames} |\n")
    return "".join(parts)


def main() -> int:
    """Run as a command."""
    parser = argparse.ArgumentParser(description="Measure the live receive path.")
    parser.add_argument("--seconds", type=float, default=FULL_SECONDS, help="of each steady run (default: %(default)g)")
    parser.add_argument("--rounds", type=int, default=40, help="of the costs (default: %(default)s)")
    args = parser.parse_args()
    text = report(args.rounds, args.seconds)
    print(text, end="")
    if args.seconds >= FULL_SECONDS:
        PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
