"""`tipforce load`: measure the load of a bus, or compute that of a planned hand."""

from __future__ import annotations

import argparse

from canopen_device.core.codes import EXTENDED_FLAG, EXTENDED_MASK, STANDARD_MASK
from tipforce.errors import InputError
from tipforce_tools.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce load`."""
    parser.epilog = (
        "With --nodes: print the budget of a planned hand, without and with the most stuff bits, and what would fit.\n"
        "Exit code 1 if the worst case exceeds --limit.\n"
        "Without --nodes: listen to a bus; the bits of each frame are counted exactly, with its stuff bits.\n"
        "  tipforce load --nodes 5 --rate 500 --pdos gauges,contact\n"
        "  tipforce load -i socketcan -c can0 -b 1000000 --seconds 5"
    )
    planned = parser.add_argument_group("planned hand")
    planned.add_argument("--nodes", type=_count, metavar="N", help="number of fingers; 1-5 means five")
    planned.add_argument("--rate", type=float, default=500.0, metavar="HZ", help="SYNCs a second (default %(default)g)")
    planned.add_argument(
        "--pdos", default="contact", metavar="NAMES", help="of gauges,contact,force,health (default %(default)s)"
    )
    planned.add_argument("--gauges", type=int, default=3, metavar="N", help="of each finger, 3 (default) to 8")
    planned.add_argument("--heartbeat", type=float, default=1.0, metavar="S", help="period, 0 for none (default 1)")
    percentage = common.number_within(0.0, 100.0, "is a percentage over 0, up to 100", over=True)
    common.add_numbers(planned, ("--limit", 80.0, "PERCENT", "default %(default)g", percentage))
    live = parser.add_argument_group("live bus")
    a_day = common.number_within(0.0, 86400.0, "is a time over 0 s, up to a day", over=True)
    common.add_numbers(live, ("--seconds", 2.0, "S", "listening time (default %(default)g)", a_day))
    common.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run; return 0, 1 if the worst case of a planned hand exceeds the limit, 5 if a live bus had no frame."""
    bit_rate = getattr(args, "bitrate", None)
    if bit_rate is not None and bit_rate < 1:
        raise InputError(f"--bitrate {bit_rate}: allowed are whole numbers from 1, in bit/s")
    return _live(args) if args.nodes is None else _planned(args)


def _planned(args: argparse.Namespace) -> int:
    from tipforce.dictionary.signals import tpdo_messages
    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, budget_lines, hand_budget, what_fits

    bit_rate = getattr(args, "bitrate", None) or DEFAULT_BIT_RATE
    names = {message.name.lower(): message.name for message in tpdo_messages(args.gauges)}
    # Unknown words stay, for the error that lists the known.
    pdos = [names.get(word.strip().lower(), word) for word in args.pdos.split(",") if word.strip()]
    budget = hand_budget(args.nodes, args.rate, pdos, args.gauges, bit_rate, args.heartbeat)
    if args.json:
        for t in budget.traffic:
            common.print_json(
                {"frame": t.name, "per_second": t.per_second, "data_bytes": t.data_bytes,
                 "least_load": t.least_bits_per_second / bit_rate, "most_load": t.most_bits_per_second / bit_rate}
            )  # fmt: skip
        common.print_json({"frame": "together", "least_load": budget.least_load, "most_load": budget.most_load})
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


def _live(args: argparse.Namespace) -> int:
    import numpy as np

    from tipforce.host.network.bus_load import DEFAULT_BIT_RATE, exact_bits
    from tipforce_tools.cli.listening import frames_heard

    bit_rate = getattr(args, "bitrate", None)
    if bit_rate is None:
        bit_rate = DEFAULT_BIT_RATE
        common.note(args, f"assumed bit rate: {bit_rate} bit/s; set another with -b")
    with common.open_bus(args) as bus:
        frames, elapsed_s = frames_heard(bus, args.seconds)
    bits_of_frames = exact_bits(frames).astype(np.float64)
    load = float(bits_of_frames.sum()) / elapsed_s / bit_rate
    ids, place, counts = np.unique(frames["can_id"], return_inverse=True, return_counts=True)
    bits = np.bincount(place, weights=bits_of_frames, minlength=len(ids))
    if args.json:
        for can_id, count, own in zip(ids.tolist(), counts.tolist(), bits.tolist(), strict=True):
            common.print_json({"can_id": can_id, "per_second": count / elapsed_s, "bits_per_second": own / elapsed_s})
        common.print_json({"load": load, "frames_per_second": len(frames) / elapsed_s, "seconds": elapsed_s})
        return 0 if len(frames) else 5
    print(f"load {100 * load:.1f} %, {len(frames) / elapsed_s:.0f} frames/s over {elapsed_s:.1f} s")
    for k in np.argsort(-bits)[:10].tolist():
        name = f"{int(ids[k]) & EXTENDED_MASK:08X}" if ids[k] & EXTENDED_FLAG else f"{int(ids[k]) & STANDARD_MASK:03X}"
        share = 100 * bits[k] / max(float(bits.sum()), 1.0)
        print(f"  {name:>8} {counts[k] / elapsed_s:10.1f} /s {share:6.1f} % of it")
    if len(ids) > 10:
        print(f"  and {len(ids) - 10} more identifiers")
    return 0 if len(frames) else 5
