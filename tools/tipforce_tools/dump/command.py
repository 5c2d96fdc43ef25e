"""`tipforce dump [vcan0,181:7FF ...] [FILE|-]`: arguments, and nothing else."""

import argparse

from tipforce_tools.cli import common

DESCRIPTION = """\
Print frames as candump does, to the byte; with --decode, say what the PDOs of fingertips mean. Frames come from buses,
or from candump's own text: a log file, or stdin with -.
"""
EPILOG = """\
CHANNEL[,FILTER...] as candump has it, identifiers and masks in hexadecimal:
  ID:MASK   frames with (identifier & MASK) == (ID & MASK); 8 digits mean a 29-bit identifier
  ID~MASK   frames with (identifier & MASK) != (ID & MASK)
  #MASK     error frames of these classes (otherwise a bus shows none)
  j         a frame must pass all of the filters, not just one
Not candump's: -c is the channel (no colour), recording is `tipforce log`.
At the end stderr tells what was left out (not with -q), and with -v what each message counted.
exit codes: 0 ok, 1 a bad line with --strict, 2 usage, or not one frame in the text
With text, CHANNEL (or `any`) selects by the interface named in each line. Without -i and python-can's configuration,
a CHANNEL is a SocketCAN interface.

  tipforce dump --decode vcan0                      what the fingers feel, line by line
  tipforce dump -ta vcan0,285:7FF,#FFFFFFFF         one PDO and all error frames
  candump -L vcan0 | tipforce dump --decode --json -
  tipforce dump --decode run.log | head
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce dump` and python-can's bus flags to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument(
        "targets",
        nargs="*",
        metavar="CHANNEL[,FILTER...] | FILE | -",
        help="buses with their filters, all together, and for text its source",
    )
    look = parser.add_argument_group("candump's flags")
    look.add_argument(
        "-t",
        dest="timestamps",
        choices=("a", "d", "z", "A"),
        default="",
        help="timestamps: -ta absolute, -td since the line before, -tz from zero, -tA with the date",
    )
    look.add_argument("-L", dest="log", action="store_true", help="log file format")
    look.add_argument("-x", dest="extra", action="store_true", help="say whether a frame was received or sent here")
    look.add_argument("-e", dest="errors", action="store_true", help="say what error frames mean")
    look.add_argument("-a", dest="ascii", action="store_true", help="show the data as characters, too")
    look.add_argument("-D", dest="stay", action="store_true", help="go on when an interface goes down")
    look.add_argument("-n", dest="count", type=common.count, metavar="COUNT", help="end after COUNT frames")
    look.add_argument("-T", dest="timeout_ms", type=common.count, metavar="MS", help="end after MS without a frame")
    parser.add_argument("--decode", action="store_true", help="add what the PDOs of fingertips say")
    parser.add_argument("--gauges", type=int, choices=range(3, 9), default=3, metavar="N", help="3 (default) to 8")
    parser.add_argument("--strict", action="store_true", help="text: exit 1 at the first bad line")
    common.add_bus_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print frames until there are no more. 0, or 1 for a bad line with --strict.

    Raises InputError for a target that is not usable and EnvironmentLackError for a bus that can't be opened.
    """
    from tipforce_tools.cli.main import terminate_as_interrupt
    from tipforce_tools.dump.session import dump

    terminate_as_interrupt()
    common.set_up_logging(args)
    return dump(args)
