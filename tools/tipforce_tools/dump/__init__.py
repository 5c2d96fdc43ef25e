"""Print frames byte for byte as candump does; with --decode, add what they mean: NMT, SYNC, EMCY, SDO with the names of
objects, heartbeats, LSS, and the values in the PDOs of fingertips. Also of a log, or stdin with -."""

import argparse

from tipforce_tools.cli import bus_flags, common, log_flags
from tipforce_tools.cli.listening import add_sync_argument


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """CHANNEL[,FILTER...] as for candump, identifiers and masks in hexadecimal:
      ID:MASK   frames with (identifier & MASK) == (ID & MASK); 8 digits mean a 29-bit identifier
      ID~MASK   frames with (identifier & MASK) != (ID & MASK)
      #MASK     error frames of these classes (default: none)
      j         a frame must pass all filters (default: one of them)
    At the end stderr reports frames left out, and with -v the count of each message.
    exit codes: 0 ok, 1 a bad line with --strict, or no frames in the log, 2 usage
    With a log, CHANNEL (or `any`) selects by the interface named in each line.

      tipforce dump -ta vcan0,285:7FF,#FFFFFFFF         one PDO and all error frames
      candump -L vcan0 | tipforce dump --decode --json -
    """
    parser.description = __doc__
    metavar, what = "CHANNEL[,FILTER...] | LOG | -", "buses, or a log of any format"
    parser.add_argument("targets", nargs="*", type=common.TARGET, metavar=metavar, help=what)
    look = parser.add_argument_group("candump's flags")
    stamps = "timestamps: -ta absolute, -td since the line before, -tz from zero, -tA with the date"
    look.add_argument("-t", dest="timestamps", choices=("a", "d", "z", "A"), default="", help=stamps)
    look.add_argument("-L", dest="log", action="store_true", help="log file format")
    look.add_argument("-x", dest="extra", action="store_true", help="show whether a frame was received or sent here")
    look.add_argument("-e", dest="errors", action="store_true", help="explain error frames")
    look.add_argument("-a", dest="ascii", action="store_true", help="also show the data as characters")
    look.add_argument("-D", dest="stay", action="store_true", help="continue when an interface goes down")
    look.add_argument("-n", dest="count", type=common.count, metavar="COUNT", help="end after COUNT frames")
    look.add_argument("-T", dest="timeout_ms", type=common.count, metavar="MS", help="end after MS without a frame")
    parser.add_argument("--decode", action="store_true", help="add the meaning of each frame")
    parser.add_argument("--gauges", type=int, choices=range(3, 9), default=3, metavar="N", help="3 (default) to 8")
    log_flags.add_eds_argument(parser)
    add_sync_argument(parser)
    parser.add_argument("--strict", action="store_true", help="log: exit with 1 at the first bad line")
    bus_flags.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print frames; return 0, or 1 for a bad line with --strict. Raises InputError and EnvironmentLackError."""
    from tipforce_tools.dump.session import dump

    return dump(args)
