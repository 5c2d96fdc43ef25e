"""Plot the fingers of a log: P, phi and theta over time with their uncertainty, gauges, and a strip that shows contact
and faults. Several logs form one recording. Each finger has a column of panels."""

import argparse
import re

from tipforce_tools.cli import common, log_flags

_INCHES = {"": 1.0, "in": 1.0, "cm": 1 / 2.54, "mm": 1 / 25.4}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """LOG: any format that `tipforce decode` reads; - is candump text on stdin. Unknown values are gaps, lost samples
    are crosses in the strip. The grey band is two standard uncertainties to either side: those that the node sends, or
    with --calibration those of gauge noise and calibration together.
    --signals: P, phi, theta, gauges, status (the default), F1, F2, F3, SG1.., temperature, u_P and other signals sent;
    with --eds all signals are the default.

      tipforce plot run.log --nodes 1-5 --from 10 --to 12.5 -o touch.pdf --size 24x16cm
      tipforce plot thumb.log --calibration thumb.toml --signals P,theta,status -o thumb.svg
    """
    parser.description = __doc__
    parser.add_argument("logs", nargs="+", type=common.LOG, metavar="LOG", help="files and globs, or -")
    parser.add_argument("-o", "--output", metavar="FILE", help=".png, .svg or .pdf")
    parser.add_argument("--size", type=_size, metavar="WxH", help="16x10cm, 160x100mm, 7x4in")
    log_flags.add_choice_arguments(parser, "as P,theta,gauges,status")
    common.add_output_arguments(parser)
    parser.set_defaults(ask=None, strict=False, follow=False, deltas=False)  # options of `tipforce decode` alone


def run(args: argparse.Namespace) -> int:
    """Draw the plot. Raises InputError for unusable input and EnvironmentLackError without matplotlib."""
    from tipforce_tools.plot.figure import plot

    return plot(args)


def _size(text: str) -> tuple[float, float]:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)(in|cm|mm|)", text)
    size = tuple(float(match[k]) * _INCHES[match[3]] for k in (1, 2)) if match else (0.0, 0.0)
    if not (min(size) >= 1.0 and max(size) <= 100.0):
        raise argparse.ArgumentTypeError(f"{text!r}: allowed are 16x10cm, 160x100mm or 7x4in; 1 to 100 inches")
    return size[0], size[1]
