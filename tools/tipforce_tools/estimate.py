"""`tipforce estimate`: contact with standard uncertainties from gauge readings, row by row."""

import argparse
import csv
import math
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from heapq import merge
from operator import itemgetter
from typing import TextIO

from tipforce.errors import InputError
from tipforce.output_file import CSV, JSON_LINES, check_output, new_file
from tipforce_tools.cli import common

COLUMNS = ("line", "P_N", "phi_deg", "theta_deg", "u_P_N", "u_phi_deg", "u_theta_deg", "status")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """GAUGES.csv: SG1..SGn in microstrain; optional t_s, temperature_degC, weight, and mode (push, pull, tare;
    blank: the calibration's load sense). With tare rows (unloaded readings) the offsets are interpolated
    between them, by t_s, or by row if there is no t_s; without tare rows the calibration's offsets apply. A bad
    row gives an empty row whose status states the reason; docs/calibration.md explains each status.
      tipforce estimate finger.toml readings.csv -o contact.csv
    """
    parser.add_argument("calibration", type=common.InputFile("calibration "), metavar="CAL.toml")
    parser.add_argument("gauges", type=common.InputFile(), metavar="GAUGES.csv")
    parser.add_argument("-o", "--output", metavar="OUT", help="CSV file (default: stdout)")
    above_0 = common.number_within(0.0, math.inf, "is above 0, in microstrain", over=True)
    parser.add_argument("--saturation", type=above_0, metavar="UE", help="converter limit in microstrain")
    parser.add_argument("--strict", action="store_true", help="exit with 1 if a row is bad")
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Write one row per input row; return 0, or 1 with --strict and bad rows."""
    from tipforce.host.configuration.calibration import read_calibration
    from tipforce.host.configuration.measurements import read_measurements
    from tipforce.host.decoding.contact_columns import estimates

    calibration = read_calibration(args.calibration, with_fit=True)
    data = read_measurements(args.gauges, loads=False)
    if data.strain.shape[1] != calibration.gauges:
        raise InputError(
            f"{args.gauges} has {data.strain.shape[1]} gauges, the calibration {args.calibration} {calibration.gauges}"
        )
    if args.output not in {None, "-"}:
        check_output(args.output, inputs=(args.calibration, args.gauges))
    if calibration.parameter_covariance is None:
        common.note(f"{args.calibration} has no [fit] table: uncertainties cover gauge noise only")
    if unused := ", ".join(filter(None, data.ignored_columns)):
        common.note(f"{args.gauges}: columns that are not used: {unused}")
    if data.unloaded.any() and data.t_s is None:
        common.note(f"{args.gauges}: no t_s: offsets are interpolated between tares by row")
    if calibration.tare_drift_strain_per_s and data.t_s is None:
        common.note(f"{args.gauges}: no t_s: the tare's age is unknown, and its drift not in the uncertainties")
    rows = estimates(calibration, data, args.saturation)
    bad = ((row.line, [math.nan] * 6, f"bad: {row.reason}") for row in data.bad)
    with ExitStack() as stack:
        stream: TextIO = sys.stdout
        if args.output not in {None, "-"}:
            kind = JSON_LINES if common.OUTPUT.json else CSV
            partial = stack.enter_context(new_file(args.output, kind, (args.calibration, args.gauges)))
            stream = stack.enter_context(partial.open("w", encoding="utf-8", newline="\n"))
        _write(stream, merge(rows, bad, key=itemgetter(0)), common.OUTPUT.json)
    if data.bad:
        shown = "; ".join(str(row) for row in data.bad[:3]) + ("; ..." if len(data.bad) > 3 else "")
        common.note(f"{args.gauges}: {len(data.bad)} of {len(data.bad) + len(data.line)} rows are bad: {shown}")
    return 1 if data.bad and args.strict else 0


def _write(stream: TextIO, rows: Iterator[tuple[int, list[float], str]], as_json: bool) -> None:
    if as_json:
        for line, values, status in rows:
            stream.write(common.json_line(dict(zip(COLUMNS, (line, *values, status), strict=True))) + "\n")
        return
    cells = csv.writer(stream, lineterminator="\n")
    cells.writerow(COLUMNS)
    for line, values, status in rows:
        cells.writerow((line, *("" if math.isnan(x) else f"{x:.9g}" for x in values), status))
