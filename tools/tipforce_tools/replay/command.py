"""Arguments of `tipforce replay LOG [vcan1=vcan0 ...]`."""

import argparse
import math

from tipforce_tools.cli import common

DESCRIPTION = """\
Send the frames of a log with their recorded timing. LOG is candump text (plain, gzip or zstd; - reads stdin) or any
format that python-can reads. Remote, CAN FD and error frames are sent if the bus supports them; frames left out are
counted on stderr.
"""
EPILOG = """\
WRITE=LOG sends to WRITE the frames recorded from LOG, as canplayer does; frames of other interfaces are left out.
Without assignments frames go to the interface named in the log, or with -c all to that one. The command asks before
it sends on a bus that is not virtual.
exit codes: 0 all sent, 1 a bad line with --strict, 2 usage, or no frames in the log, 130 Ctrl-C or SIGTERM

  tipforce replay run.log                           to the interfaces of the log
  tipforce replay run.log.gz vcan1=vcan0 --speed 10
  tipforce replay --loop inf --max-gap 0.5 run.log vcan0=can0 vcan1=can1
  tipforce replay -i pcan -c PCAN_USBBUS1 -b 1000000 --yes run.blf
"""

_speed = common.number_that(lambda speed: speed > 0, "are numbers over 0, and inf")
_gap = common.number_that(lambda gap_s: 0 <= gap_s < math.inf, "are 0 or more seconds")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce replay` and python-can's bus flags to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument("log", metavar="LOG", help="a log file, or - for candump text on stdin")
    parser.add_argument("assignments", nargs="*", type=_assignment, metavar="WRITE=LOG", help="interfaces")
    parser.add_argument("--speed", type=_speed, default=1.0, metavar="X", help="times recorded speed (inf: no waiting)")
    parser.add_argument("--loop", type=_loop, default=1, metavar="N", help="number of passes, or inf (default: 1)")
    parser.add_argument("--max-gap", type=_gap, metavar="S", help="shorten gaps of the log that are longer than S")
    parser.add_argument("--strict", action="store_true", help="end at the first bad line of candump text")
    common.add_confirm_argument(parser)
    common.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Send the frames; return 0, 1 for a bad line with --strict, or 130 after a signal.

    Raises InputError for a log that cannot be read, a wrong assignment or the answer "no", EnvironmentLackError for a
    bus that cannot be opened or fails.
    """
    from tipforce_tools.replay.session import replay

    return replay(args)


def _assignment(text: str) -> str:
    write, equals, log = text.partition("=")
    if not (write and equals and log):
        raise argparse.ArgumentTypeError(f"{text!r}: expected WRITE=LOG, for instance vcan1=vcan0")
    return text


def _loop(text: str) -> int | None:
    return None if text in {"inf", "i"} else common.count(text)
