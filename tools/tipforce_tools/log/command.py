"""Arguments of `tipforce log [vcan0,181:7FF ...] [-o FILE]`."""

import argparse
import re

from tipforce_tools.cli import common

DESCRIPTION = """\
Record frames until Ctrl-C, SIGTERM, -n, -T or --seconds. The file then holds all received frames in every case;
stderr reports the number of frames, and of frames dropped by the kernel.
"""
EPILOG = """\
CHANNEL[,FILTER...] as for `tipforce dump` and candump; without #MASK no error frames. The suffix of FILE sets the
format: .log (candump's, for canplayer, Wireshark, `tipforce replay` and `decode`), .asc .blf .csv .trc .db .mf4 .txt
(python-can's writers), and .log.gz .asc.gz .csv.gz .trc.gz. With a --rotate flag, files are numbered: run-0001.log.
exit codes: 0 ended by -n, -T or --seconds, 130 by Ctrl-C or SIGTERM, 1 the disk is full, 2 usage

  tipforce log vcan0                                candump-2026-05-17_093000.log, as candump -l
  tipforce log -o run.log.gz vcan0,180:780 vcan1
  tipforce log -o run.blf -i pcan -c PCAN_USBBUS1 -b 1000000
  tipforce log -o hand.log --rotate-size 100M --rotate-time 3600 any,0:0,#FFFFFFFF
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce log` and python-can's bus flags to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument("targets", nargs="*", metavar="CHANNEL[,FILTER...]", help="buses with their filters")
    parser.add_argument("-o", "--output", metavar="FILE", help="default: a name as of candump -l, by date and time")
    parser.add_argument("--overwrite", action="store_true", help="overwrite existing files")
    parser.add_argument("-n", dest="count", type=common.count, metavar="COUNT", help="end after COUNT frames")
    parser.add_argument("-T", dest="timeout_ms", type=common.count, metavar="MS", help="end after MS without a frame")
    parser.add_argument("--seconds", type=common.seconds, metavar="S", help="end after S seconds")
    parser.add_argument("-D", dest="stay", action="store_true", help="continue when an interface goes down")
    parser.add_argument("--rotate-size", type=_bytes, metavar="SIZE", help="a new file after SIZE bytes: 500K 100M 1G")
    parser.add_argument("--rotate-time", type=common.seconds, metavar="S", help="a new file after S seconds")
    common.add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Record until an end condition; return 0, or 130 after a signal.

    Raises InputError for an unusable target or file, EnvironmentLackError for a bus that cannot be opened or fails,
    OSError for a full disk; the file holds the frames received until then.
    """
    from tipforce_tools.log.session import record

    return record(args)


def _bytes(text: str) -> int:
    match = re.fullmatch(r"([1-9]\d*)([KMG]?)", text, re.IGNORECASE)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r}: expected bytes, or a number with K, M or G: 100M")
    return int(match[1]) << {"": 0, "K": 10, "M": 20, "G": 30}[match[2].upper()]
