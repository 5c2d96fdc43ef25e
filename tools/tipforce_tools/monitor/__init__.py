"""Show the active nodes, one row each: samples per second, their regularity, the age of the last one, contact, status,
NMT state, the last EMCY and lost samples. A value not received for half a second (or three of its periods) is marked
STALE, and one that the node does not know is marked unknown, with the reason. Without --sync the command sends nothing.
"""

import argparse
import math

from tipforce_tools.cli import bus_flags, common, log_flags
from tipforce_tools.cli.listening import add_sync_argument

_seconds = common.number_that(lambda time_s: 0.01 <= time_s < 1e6, "are 0.01 to 1000000 s")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """CHANNEL[,FILTER...] as for `tipforce dump`. If stdout is not a terminal, a plain table is printed at the end, or
    with --json one line per interval.
    The bus load is a range, without stuff bits to the most stuff bits, at the bit rate of -b (default: 1 Mbit/s).
      tipforce monitor -i pcan -c PCAN_USBBUS1 -b 1000000 --nodes 1-5
      tipforce monitor run.log --speed 1                with recorded timing
      tipforce monitor can0 --once 2 --json | jq '.buses[0].load_percent'
    """
    parser.description = __doc__
    targets = "CHANNEL[,FILTER...] | LOG | -"
    parser.add_argument("targets", nargs="*", type=common.TARGET, metavar=targets, help="buses, filters, or a log")
    parser.add_argument("--nodes", type=common.node_ids, metavar="IDS", help="1,2,5-9 (default: all)")
    parser.add_argument("--gauges", type=int, choices=range(3, 9), default=3, metavar="N", help="3 (default) to 8")
    parser.add_argument("--interval", type=_seconds, metavar="S", help="between tables (0.25 s) or JSON lines (1 s)")
    parser.add_argument("--once", type=_seconds, metavar="S", help="print one table after S seconds, and end")
    common.add_number(parser, "--speed", math.inf, "X", "log: times recorded speed (inf)", common.speed)
    parser.add_argument("--follow", action="store_true", help="log: wait for more lines at the end")
    add_sync_argument(parser)
    log_flags.add_eds_argument(parser)
    bus_flags.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Show the table; return 0, or 130 after a signal. Raises InputError and EnvironmentLackError."""
    from tipforce_tools.monitor.session import monitor

    return monitor(args)
