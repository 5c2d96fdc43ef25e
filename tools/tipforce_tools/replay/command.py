"""`tipforce replay LOG [vcan1=vcan0 ...]`: arguments, and nothing else."""

import argparse
import math

from tipforce_tools.cli import common

DESCRIPTION = """\
Send the frames of a log with the time between them that the log has. LOG is candump's text (plain, gzip or zstd; -
reads stdin) or any format that python-can reads. Remote, CAN FD and error frames go where the bus carries them;
what is left out is counted on stderr.
"""
EPILOG = """\
WRITE=LOG sends to WRITE what the log has from LOG, as canplayer does; frames of other interfaces are left out. Without
assignments frames go to the interface that the log names, or with -c all to that one. On a bus that is not virtual it
asks first.
exit codes: 0 all sent, 1 a bad line with --strict, 2 usage, or not one frame in it, 130 ended by Ctrl-C or SIGTERM

  tipforce replay run.log                           to the interfaces of the log
  tipforce replay run.log.gz vcan1=vcan0 --speed 10
  tipforce replay --loop inf --max-gap 0.5 run.log vcan0=can0 vcan1=can1
  tipforce replay -i pcan -c PCAN_USBBUS1 -b 1000000 --yes run.blf
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce replay` and python-can's bus flags to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument("log", metavar="LOG", help="a log file, or - for candump's text on stdin")
    parser.add_argument("assignments", nargs="*", type=_assignment, metavar="WRITE=LOG", help="interfaces")
    parser.add_argument("--speed", type=_speed, default=1.0, metavar="X", help="times the log's own (inf: no waiting)")
    parser.add_argument("--loop", type=_loop, default=1, metavar="N", help="how often, or inf (default: 1)")
    parser.add_argument("--max-gap", type=_gap, metavar="S", help="shorten gaps of the log that are longer than S")
    parser.add_argument("--strict", action="store_true", help="end at the first bad line of candump's text")
    common.add_confirm_argument(parser)
    common.add_bus_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Send the frames. 0, 1 for a bad line with --strict, or 130 after a signal.

    Raises InputError for a log that can't be read, a wrong assignment or an answer of no, EnvironmentLackError for a
    bus that can't be opened or fails.
    """
    from tipforce_tools.replay.session import replay

    common.set_up_logging(args)
    return replay(args)


def _assignment(text: str) -> str:
    write, equals, log = text.partition("=")
    if not (write and equals and log):
        raise argparse.ArgumentTypeError(f"{text!r}: expected WRITE=LOG, for instance vcan1=vcan0")
    return text


def _speed(text: str) -> float:
    number = common.number(text)
    if not number > 0:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed are numbers over 0, and inf")
    return number


def _gap(text: str) -> float:
    number = common.number(text)
    if not 0 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed are seconds from 0 on")
    return number


def _loop(text: str) -> int | None:
    if text in {"inf", "i"}:
        return None
    return common.count(text)
