"""`tipforce calibrate fit`: readings under known loads in, a calibration file and an account of it out."""

from __future__ import annotations

import argparse
import datetime

from tipforce.errors import InputError
from tipforce_tools.cli import common


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of fit."""
    parser.epilog = (
        "DATA.csv: SG1..SGn in microstrain, P_N, phi_deg, theta_deg; optional t_s, temperature_degC, weight (readings\n"
        "that the row is the mean of) and mode (push, pull, tare). Rows with P_N = 0 are unloaded readings (tares).\n"
        "  tipforce calibrate fit grooves.csv -o finger.toml --layout I --saturation 1000"
    )
    parser.add_argument("data", metavar="DATA.csv")
    parser.add_argument("-o", "--output", metavar="CAL.toml", help="calibration file to write")
    parser.add_argument("--layout", metavar="I|II|III|FILE", help="where the gauges sit (for the file and the prior)")
    add_model_arguments(parser)
    parser.add_argument("--sense", choices=("push", "pull"), help="load sense of the file (default: that of the data)")
    parser.add_argument("--serial", type=int, default=0, metavar="N", help="serial number of the fingertip")
    parser.add_argument("--date", type=_date, metavar="YYYY-MM-DD", help="default: today")
    parser.add_argument(
        "--strict", action="store_true", help="write no file and exit 1 if a row is bad, or the fit is in doubt"
    )
    common.add_output_arguments(parser)


def add_model_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags that say how the readings are believed to have come about."""
    group = parser.add_argument_group("model")
    group.add_argument(
        "--angle-scatter", type=float, default=0.5, metavar="DEG",
        help="standard deviation of phi and of theta of a groove, the same error in all its rows (default %(default)s)",
    )  # fmt: skip
    group.add_argument(
        "--drift", choices=("none", "tare", "linear"),
        help="of the offsets (default: what predicts rows that the fit leaves out best)",
    )  # fmt: skip
    group.add_argument(
        "--loss", choices=("huber", "soft-l1", "none"), default="huber",
        help="rows that disagree weigh less or are left out by name; none: all count (default %(default)s)",
    )  # fmt: skip
    group.add_argument("--noise", type=float, metavar="UE", help="gauge noise in microstrain (default: estimated)")
    group.add_argument(
        "--saturation", type=_limit, metavar="UE|none",
        help="converter limit in microstrain, kept in the file; none: no reading is at a limit",
    )  # fmt: skip
    group.add_argument(
        "--yield-stress", type=float, metavar="MPA", help="of the material, for the overload force (with --layout)"
    )
    group.add_argument("--no-offset", action="store_true", help="the readings are zero unloaded: fit no offset")
    group.add_argument("--prior", choices=("beam",), help="lean on beam theory where loads are few; needs --layout")
    group.add_argument(
        "--prior-scatter",
        type=float,
        default=0.1,
        metavar="SHARE",
        help="how far theory may be off (default %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Print the fit and write the file: 0. With --strict and bad rows or a doubtful fit: no file, 1."""
    from tipforce.host.configuration.measurements import read_measurements
    from tipforce.output_file import CALIBRATION, check_output
    from tipforce_tools.calibrate.fitting import FitRequest, fitted, publish, write
    from tipforce_tools.cli.one_finger_csv import check_one_node
    from tipforce_tools.cli.request import request_of

    if args.output:
        check_output(args.output, CALIBRATION, [args.data])
    data = read_measurements(args.data, loads=True)
    check_one_node(args.data, data)
    if not len(data.line):
        raise InputError(f"{args.data}: no row can be used; the first: {data.bad[0]}")
    request = request_of(FitRequest, args)
    request.check_gauges(data.strain.shape[1], args.data)
    if not 0 <= args.serial < 2**32:
        raise InputError(f"--serial {args.serial}: allowed is 0 to {2**32 - 1}")
    result = fitted(request, data, lambda text: common.note(args, text))
    doubtful = publish(args, args.data, request, result)
    if data.bad:
        common.note(args, f"{args.data}: {len(data.bad)} bad rows were not used")
    if (data.bad or doubtful) and args.strict:
        common.note(args, "--strict: no file is written")
        return 1
    if args.output:
        write(args, args.data, request, result)
    return 0


def _limit(text: str) -> float:
    if text == "none":
        return float("inf")
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed are microstrain above 0, and none") from None


def _date(text: str) -> datetime.date:
    try:
        return datetime.date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: write it as 2025-12-31") from None
