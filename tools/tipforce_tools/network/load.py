"""`tipforce load`: measure the load of a bus, or compute that of a planned hand."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from tipforce.device.codes import EXTENDED_FLAG, EXTENDED_MASK, STANDARD_MASK
from tipforce.errors import InputError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.host.frames.frame_array import FrameArray
    from tipforce.host.network.bus_load import Budget


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce load`."""
    parser.epilog = (
        "With --nodes: print the budget of a planned hand, without and with the most stuff bits, and what would fit.\n"
        "Exit code 1 if the worst case exceeds --limit.\n"
        "Without --nodes: listen to a bus; the bits of each frame are counted exactly, with its stuff bits.\n"
        "  tipforce load --nodes 5 --rate 500 --pdos gauges,contact\n"
        "  tipforce load -i socketcan -c can0 -b 1000000 --seconds 5"
    )
    paper = parser.add_argument_group("planned hand")
    paper.add_argument("--nodes", type=_count, metavar="N", help="number of fingers; 1-5 means five")
    paper.add_argument("--rate", type=float, default=500.0, metavar="HZ", help="SYNCs a second (default %(default)g)")
    paper.add_argument(
        "--pdos", default="contact", metavar="NAMES", help="of gauges,contact,force,health (default %(default)s)"
    )
    paper.add_argument("--gauges", type=int, default=3, metavar="N", help="of each finger, 3 (default) to 8")
    paper.add_argument("--heartbeat", type=float, default=1.0, metavar="S", help="period, 0 for none (default 1)")
    paper.add_argument("--limit", type=float, default=80.0, metavar="PERCENT", help="default %(default)g")
    live = parser.add_argument_group("live bus")
    live.add_argument("--seconds", type=float, default=2.0, metavar="S", help="listening time (default %(default)g)")
    common.add_bus_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run; return 0, 1 if the worst case of a planned hand exceeds the limit, 5 if a live bus had no frame."""
    common.set_up_logging(args)
    bit_rate = getattr(args, "bitrate", None)
    if bit_rate is not None and bit_rate < 1:
        raise InputError(f"--bitrate {bit_rate}: allowed are whole numbers from 1, in bit/s")
    return _live(args) if args.nodes is None else _paper(args)


def _paper(args: argparse.Namespace) -> int:
    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, hand_budget

    if not 0 < args.limit <= 100:
        raise InputError(f"--limit {args.limit:g}: allowed is a percentage over 0, up to 100")
    bit_rate = getattr(args, "bitrate", None) or DEFAULT_BIT_RATE
    pdos = pdo_names(args.pdos, args.gauges)
    budget = hand_budget(args.nodes, args.rate, pdos, args.gauges, bit_rate, args.heartbeat)
    if args.json:
        _print_records(budget)
    else:
        print(f"{args.nodes} nodes, SYNC at {args.rate:g} Hz, {bit_rate} bit/s")
        print("\n".join(budget_lines(budget)))
        print(f"fits under {args.limit:g} % in the worst case:")
        print("\n".join(what_fits(args.nodes, args.rate, pdos, args.gauges, bit_rate, args.limit / 100)))
        if budget.most_load > args.limit / 100:
            print(f"it does not fit: {100 * budget.most_load:.1f} % in the worst case, allowed is {args.limit:g} %")
    return 1 if budget.most_load > args.limit / 100 else 0


def _count(text: str) -> int:
    """Parse a number of nodes, or count a set of node-ids, which --nodes of other commands takes."""
    return len(common.node_ids(text)) if "," in text or "-" in text[1:] else common.count(text)


def pdo_names(text: str, gauges: int) -> list[str]:
    """Split ``gauges,contact`` into message names; unknown words stay, for the error that lists the known."""
    from tipforce.dictionary.signals import tpdo_messages

    names = {message.name.lower(): message.name for message in tpdo_messages(gauges)}
    return [names.get(word.strip().lower(), word) for word in text.split(",") if word.strip()]


def budget_lines(budget: Budget) -> list[str]:
    """Return a line per kind of frame, and the sum."""
    lines = [f"  {'frame':12} {'each s':>10} {'bytes':>6} {'no stuffing':>12} {'worst case':>11}"]
    for t in budget.traffic:
        least, most = (100 * bits / budget.bit_rate for bits in (t.least_bits_per_second, t.most_bits_per_second))
        lines.append(f"  {t.name:12} {t.per_second:10g} {t.data_bytes:6} {least:10.1f} % {most:9.1f} %")
    lines.append(f"  {'together':12} {'':10} {'':6} {100 * budget.least_load:10.1f} % {100 * budget.most_load:9.1f} %")
    return lines


def what_fits(nodes: int, rate_hz: float, pdos: list[str], gauges: int, bit_rate: int, limit: float) -> list[str]:
    """Return lines with the rate and the number of nodes that fit, for all PDOs requested and for each of them."""
    from tipforce.host.network.bus_load import hand_budget, highest_rate_hz

    lines = []
    choices = [pdos] + ([[name] for name in pdos] if len(pdos) > 1 else [])
    for choice in choices:
        rate = highest_rate_hz(nodes, choice, gauges, bit_rate, limit)
        most = max(
            (n for n in range(1, 128) if hand_budget(n, rate_hz, choice, gauges, bit_rate).most_load <= limit),
            default=0,
        )
        names = " + ".join(name.lower() for name in choice)
        lines.append(f"  {names:24} {nodes} nodes up to {rate:.0f} Hz; at {rate_hz:g} Hz up to {most} nodes")
    return lines


def _print_records(budget: Budget) -> None:
    for t in budget.traffic:
        common.print_json(
            {"frame": t.name, "per_second": t.per_second, "data_bytes": t.data_bytes,
             "least_load": t.least_bits_per_second / budget.bit_rate,
             "most_load": t.most_bits_per_second / budget.bit_rate}
        )  # fmt: skip
    common.print_json({"frame": "together", "least_load": budget.least_load, "most_load": budget.most_load})


def _live(args: argparse.Namespace) -> int:
    import can

    from tipforce.host.frames.frame_array import FrameBuffer
    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, exact_bits

    if not 0 < args.seconds <= 86400:
        raise InputError(f"--seconds {args.seconds:g}: allowed is a time over 0 s, up to a day")
    bit_rate = getattr(args, "bitrate", None)
    if bit_rate is None:
        bit_rate = DEFAULT_BIT_RATE
        common.note(args, f"assumed bit rate: {bit_rate} bit/s; set another with -b")
    buffer = FrameBuffer()
    with common.open_bus(args) as bus:
        notifier = can.Notifier(bus, [buffer], timeout=0.1)
        started_s = time.monotonic()
        time.sleep(args.seconds)
        elapsed_s = time.monotonic() - started_s
        notifier.stop()
    frames = buffer.take_all()
    bits = exact_bits(frames)
    _say_live(args, frames, float(bits.sum()) / elapsed_s / bit_rate, elapsed_s)
    return 0 if len(frames) else 5


def _say_live(args: argparse.Namespace, frames: FrameArray, load: float, elapsed_s: float) -> None:
    import numpy as np

    from tipforce.host.network.bus_load import exact_bits

    ids, place, counts = np.unique(frames["can_id"], return_inverse=True, return_counts=True)
    bits = np.bincount(place, weights=exact_bits(frames).astype(np.float64), minlength=len(ids))
    if args.json:
        for can_id, count, own in zip(ids.tolist(), counts.tolist(), bits.tolist(), strict=True):
            common.print_json({"can_id": can_id, "per_second": count / elapsed_s, "bits_per_second": own / elapsed_s})
        common.print_json({"load": load, "frames_per_second": len(frames) / elapsed_s, "seconds": elapsed_s})
        return
    print(f"load {100 * load:.1f} %, {len(frames) / elapsed_s:.0f} frames/s over {elapsed_s:.1f} s")
    for k in np.argsort(-bits)[:10].tolist():
        name = f"{int(ids[k]) & EXTENDED_MASK:08X}" if ids[k] & EXTENDED_FLAG else f"{int(ids[k]) & STANDARD_MASK:03X}"
        share = 100 * bits[k] / max(float(bits.sum()), 1.0)
        print(f"  {name:>8} {counts[k] / elapsed_s:10.1f} /s {share:6.1f} % of it")
    if len(ids) > 10:
        print(f"  and {len(ids) - 10} more identifiers")
