"""Arguments of `tipforce plot LOG ... -o FILE`."""

import argparse
import re

from tipforce_tools.cli import common
from tipforce_tools.cli.eds_flag import add_eds_argument

DESCRIPTION = """\
Plot the fingers of a log: P, phi and theta over time with their uncertainty, gauges, and a strip that shows contact
and faults. Several logs form one recording. Each finger has a column of panels.
"""
EPILOG = """\
LOG: any format that `tipforce decode` reads; - is candump text on stdin. Unknown values are gaps. For long logs each
pixel shows the minimum, the mean and the maximum. Lost samples are crosses in the strip. The grey band is two
standard uncertainties to either side: those that the node sends (u_P in TPDO4, or 2107h mapped), or with
--calibration, which computes the contact from the gauges, those of gauge noise and calibration together.
--signals: P, phi, theta, gauges, status (the default), F1, F2, F3, SG1.., temperature, u_P and other signals sent;
with --eds all signals are the default.
exit codes: 0 ok, 2 usage

  tipforce plot run.log -o run.png
  tipforce plot run.log --nodes 1-5 --from 10 --to 12.5 -o touch.pdf --size 24x16cm
  tipforce plot thumb.log --calibration thumb.toml --signals P,theta,status -o thumb.svg
  candump -L -n 5000 can0 | tipforce plot - -o now.png
"""
_INCHES = {"": 1.0, "in": 1.0, "cm": 1 / 2.54, "mm": 1 / 25.4}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce plot` to `parser`."""
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument("logs", nargs="+", metavar="LOG", help="files and globs, or -")
    parser.add_argument("-o", "--output", metavar="FILE", help=".png, .svg or .pdf")
    parser.add_argument("--show", action="store_true", help="also show the plot in a window")
    parser.add_argument("--title", metavar="TEXT", help="default: time of the start")
    parser.add_argument("--size", type=_size, metavar="WxH", help="16x10cm, 160x100mm, 7x4in (default: by the content)")
    parser.add_argument("--dpi", type=_dpi, default=130, metavar="N", help="resolution of a PNG (default %(default)s)")
    group = parser.add_argument_group("choice")
    group.add_argument("--signals", metavar="NAMES", help="as P,theta,gauges,status")
    group.add_argument("--nodes", type=common.node_ids, metavar="IDS", help="as 1,2,5-9")
    group.add_argument("--bus", metavar="NAMES", help="only frames of these interfaces of the log: can0,can1")
    group.add_argument("--from", dest="start", metavar="TIME", help="seconds from the start or of the epoch, ISO time")
    group.add_argument("--to", dest="end", metavar="TIME", help="end, exclusive; same formats")
    group.add_argument(
        "--calibration", action="append", metavar="[NODE=]CAL.toml", help="compute contact from the gauges; repeatable"
    )
    group.add_argument("--gauges", type=int, choices=range(3, 9), metavar="N", help="3 (default) to 8")
    group.add_argument("--dcf", action="append", metavar="FILE", help="configuration of a node; repeatable")
    group.add_argument("--dbc", metavar="FILE", help="use the messages of a DBC instead; tipforce: the shipped one")
    add_eds_argument(group)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Draw the plot. Raises InputError for unusable input and EnvironmentLackError without matplotlib."""
    from tipforce_tools.plot.session import plot

    # Options of `tipforce decode` that a plot does not need.
    args.ask, args.strict, args.follow, args.deltas = None, False, False, False
    return plot(args)


def _size(text: str) -> tuple[float, float]:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)(in|cm|mm|)", text)
    size = tuple(float(match[k]) * _INCHES[match[3]] for k in (1, 2)) if match else (0.0, 0.0)
    if not (min(size) >= 1.0 and max(size) <= 100.0):
        raise argparse.ArgumentTypeError(f"{text!r}: allowed are 16x10cm, 160x100mm or 7x4in; 1 to 100 inches")
    return size[0], size[1]


def _dpi(text: str) -> int:
    number = common.number(text)
    if not 20 <= number <= 1200:
        raise argparse.ArgumentTypeError(f"{text}: allowed are 20 to 1200")
    return int(number)
