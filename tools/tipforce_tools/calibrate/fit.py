"""`tipforce calibrate fit`: readings under known loads to a calibration file; `apply|verify`: that file and a node."""

from __future__ import annotations

import argparse
import datetime
import math
from typing import TYPE_CHECKING, Any

from tipforce.errors import InputError
from tipforce_tools.cli import bus_flags, common

if TYPE_CHECKING:
    from tipforce.host.configuration.calibration import Calibration
    from tipforce.host.network.finger import Finger


def add_fit_arguments(parser: argparse.ArgumentParser) -> None:
    """DATA.csv: SG1..SGn in microstrain, P_N, phi_deg, theta_deg; optional t_s, temperature_degC, weight (readings
    that the row is the mean of) and mode (push, pull, tare). Rows with P_N = 0 are unloaded readings (tares).
      tipforce calibrate fit grooves.csv -o finger.toml --layout I --saturation 1000
    """
    parser.add_argument("data", type=common.InputFile(), metavar="DATA.csv")
    parser.add_argument("-o", "--output", metavar="CAL.toml", help="calibration file to write")
    parser.add_argument("--layout", metavar="I|II|III|FILE", help="where the gauges sit (for the file and the prior)")
    add_model_arguments(parser)
    parser.add_argument("--sense", choices=("push", "pull"), help="load sense of the file (default: that of the data)")
    parser.add_argument("--serial", type=common.unsigned32, default=0, metavar="N", help="serial number of the finger")
    parser.add_argument("--date", type=_date, metavar="YYYY-MM-DD", help="default: today")
    parser.add_argument(
        "--strict", action="store_true", help="write no file and exit 1 if a row is bad, or the fit is in doubt"
    )
    common.add_output_arguments(parser)


def requested(args: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of a ``FitRequest`` that the command line has."""
    from dataclasses import fields

    from tipforce.host.configuration.fitting import FitRequest

    given = {field.name: getattr(args, field.name) for field in fields(FitRequest) if hasattr(args, field.name)}
    return given | {"loss": args.loss.replace("-", "_")}


def add_model_arguments(
    parser: argparse.ArgumentParser, scatter: float | None = 0.5, default: str = "%(default)s"
) -> None:
    """Flags that say how the readings are believed to have come about; ``default``: what the help says of scatter."""
    group = parser.add_argument_group("model")
    about = f"standard deviation of a groove's phi and theta (default {default})"
    degrees = common.number_within(0.0, 20.0, "is 0 to 20 degrees")
    common.add_number(group, "--angle-scatter", scatter, "DEG", about, degrees)
    group.add_argument("--drift", choices=("none", "tare", "linear"), help="of the offsets (default: best predictor)")
    group.add_argument(
        "--loss", choices=("huber", "soft-l1", "none"), default="huber",
        help="of rows that disagree (default %(default)s)",
    )  # fmt: skip
    common.add_number(group, "--noise", None, "UE", "gauge noise in microstrain (default: estimated)", common.above_0)
    group.add_argument("--saturation", type=_limit, metavar="UE|none", help="converter limit, microstrain")
    common.add_number(group, "--yield-stress", None, "MPA", "for the overload force (with --layout)", common.above_0)
    group.add_argument("--no-offset", action="store_true", help="readings are zero unloaded: fit no offset")
    group.add_argument("--prior", choices=("beam",), help="lean on beam theory; needs --layout")
    common.add_number(group, "--prior-scatter", 0.1, "SHARE", "how far theory may be off (default %(default)s)", float)


def run_fit(args: argparse.Namespace) -> int:
    """Print the fit and write the file: 0. With --strict and bad rows or a doubtful fit: no file, 1."""
    from tipforce.host.configuration.fitting import FitRequest, fitted
    from tipforce.host.configuration.measurements import read_measurements
    from tipforce.output_file import CALIBRATION, check_output
    from tipforce_tools.calibrate.fit_report import publish, write

    if args.output:
        check_output(args.output, CALIBRATION, [args.data])
    data = read_measurements(args.data, loads=True)
    if not len(data.line):
        raise InputError(f"{args.data}: no row can be used; the first: {data.bad[0]}")
    if data.bad:  # before the fit, which may find too few others
        common.note(f"{args.data}: {len(data.bad)} bad rows were not used, the first: {data.bad[0]}")
    request = FitRequest(**requested(args))
    request.check_gauges(data.strain.shape[1], args.data)
    result = fitted(request, data, common.note)
    doubtful = publish(args.data, result)
    if (data.bad or doubtful) and args.strict:
        common.note("--strict: no file is written")
        return 1
    if args.output:
        write(args.output, args.data, result)
    return 0


def _limit(text: str) -> float:
    above_0 = common.number_within(0.0, math.inf, "is above 0, in microstrain, or none", over=True)
    return math.inf if text == "none" else above_0(text)


def _date(text: str) -> datetime.date:
    try:
        return datetime.date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: write it as 2025-12-31") from None


def add_apply_arguments(parser: argparse.ArgumentParser) -> None:
    """The node checks the record by CRC-32. It is committed, read back, compared byte for byte, and stored. If the
    node refuses (exit code 12), the previous calibration stays active.
      tipforce calibrate apply finger.toml --node 5 -i socketcan -c can0
    """
    parser.add_argument("--no-store", action="store_true", help="apply only until the next reset")
    common.add_confirm_argument(parser)
    add_verify_arguments(parser)


def add_verify_arguments(parser: argparse.ArgumentParser) -> None:
    """Exit code 1 if the node's active calibration differs from the file: a line for each difference."""
    parser.add_argument("file", type=common.InputFile("calibration "), metavar="CAL.toml")
    parser.add_argument("--node", "--node-id", type=common.node_id, required=True, metavar="ID", help="1 to 127")
    bus_flags.add_bus_arguments(parser, sdo=True)


def run_apply(args: argparse.Namespace) -> int:
    """Apply: return 0. Raises RefusedError."""
    from tipforce.host.configuration.calibration import read_calibration

    calibration, name = read_calibration(args.file), common.shown_node(args.node)
    if not args.no_store:
        bus_flags.confirm(args, f"{name}: this replaces its stored calibration")
    with bus_flags.open_connection(args) as connection:
        transfer(connection.finger(args.node), calibration, not args.no_store, "applied")
    return 0


def transfer(finger: Finger, calibration: Calibration, store: bool, done: str) -> None:
    """Apply a calibration with a note of each step, and print what the node then has. Raises RefusedError."""
    name, crc32 = common.shown_node(finger.node_id), f"0x{calibration.crc32():08X}"
    generation = finger.apply_calibration(calibration, store, lambda step: common.note(f"{name}: {step}"))
    record = {"node": finger.node_id, "generation": generation, "crc32": crc32}
    common.print_record(record, f"{done}, generation {generation}, CRC-32 {crc32}")


def run_verify(args: argparse.Namespace) -> int:
    """Compare: return 0 if equal, 1 if different."""
    from tipforce.host.configuration.calibration import read_calibration

    calibration = read_calibration(args.file)
    with bus_flags.open_connection(args) as connection:
        differences = connection.finger(args.node).verify_calibration(calibration)
    compared = {"node": args.node, "equal": not differences, "differences": differences}
    common.print_record(compared, "\n".join(differences) or "equal byte for byte")
    return 1 if differences else 0
