"""`tipforce calibrate fit`: readings under known loads in, a calibration file and an account of it out."""

from __future__ import annotations

import argparse
import datetime
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.host.configuration.calibration import Calibration
    from tipforce.host.configuration.measurements import Measurements
    from tipforce.sensor.calibration.fit import Fit, Model, Readings


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
    from tipforce.host.configuration.calibration_file import fit_record, write_calibration
    from tipforce.host.configuration.measurements import read_measurements
    from tipforce.output_file import CALIBRATION, check_output
    from tipforce_tools.calibrate import fit_report
    from tipforce_tools.cli.one_finger_csv import check_one_node

    if args.output:
        check_output(args.output, CALIBRATION, [args.data])
    data = read_measurements(args.data, loads=True)
    check_one_node(args.data, data)
    if not len(data.line):
        raise InputError(f"{args.data}: no row can be used; the first: {data.bad[0]}")
    _check_layout(args, data)
    if not 0 <= args.serial < 2**32:
        raise InputError(f"--serial {args.serial}: allowed is 0 to {2**32 - 1}")
    fit, model, scores = fit_of(args, data)
    calibration = calibration_of(args, data, fit)
    notes = fit_report.notes(data, fit, model, args.layout, calibration, scores)
    warnings = fit_report.warnings(readings_of(data), fit)
    if args.json:
        fit_report.print_json(args.data, data, fit, calibration, notes, warnings)
    else:
        fit_report.print_text(args.data, data, fit, model, notes)
    for warning in warnings:
        common.note(args, f"{args.data}: {warning}")
    if data.bad:
        common.note(args, f"{args.data}: {len(data.bad)} bad rows were not used")
    if (data.bad or warnings) and args.strict:
        common.note(args, "--strict: no file is written")
        return 1
    if args.output:
        facts = fit_report.facts(args.data, data, fit) | {"angle_scatter_deg": args.angle_scatter}
        write_calibration(args.output, calibration, fit_record(fit, **facts))
        common.note(args, f"{args.output}: written, load sense {'pull' if calibration.pull else 'push'}")
    return 0


def fit_of(args: argparse.Namespace, data: Measurements) -> tuple[Fit, Model, dict[str, float]]:
    """The fit, rounded, its model, and the hold-out scores of the drifts that were tried (one where --drift is given).

    Raises InputError for flags that are not allowed, for data that look like another unit or a converter's limit, and
    where the rows do not determine a calibration.
    """
    from tipforce.sensor.calibration.drift_choice import best_fit, fit_with_drift
    from tipforce.sensor.calibration.rounding import rounded
    from tipforce_tools.calibrate.fit_checks import check_readings, check_theory

    model, readings = model_of(args), readings_of(data)
    check_readings(args, data, readings, model)
    if args.drift is None:
        fit, model, scores = best_fit(readings, model)
    else:
        fit, model, scores = fit_with_drift(readings, model)
    check_theory(args, fit)
    return rounded(fit), model, scores


def model_of(args: argparse.Namespace) -> Model:
    """The model that the flags ask for. Raises InputError for values that are not allowed."""
    import numpy as np

    from tipforce.sensor.calibration.fit import Model, beam_prior
    from tipforce_tools.cli.layout_file import read_layout

    prior = None
    if args.prior:
        if not args.layout:
            raise InputError("--prior beam needs --layout: the theory depends on where the gauges sit")
        prior = beam_prior(*read_layout(args.layout), args.prior_scatter)
    if not 0.0 <= args.angle_scatter <= 20.0:
        raise InputError(f"--angle-scatter {args.angle_scatter:g}: allowed is 0 to 20 degrees")
    if args.noise is not None and not 0.0 < args.noise < np.inf:
        raise InputError(f"--noise {args.noise:g}: allowed is above 0, in microstrain")
    if args.saturation is not None and not args.saturation > 0.0:
        raise InputError(f"--saturation {args.saturation:g}: allowed is above 0, in microstrain, or none")
    if args.yield_stress is not None and not 0.0 < args.yield_stress < np.inf:
        raise InputError(f"--yield-stress {args.yield_stress:g}: allowed is above 0, in MPa")
    scatter = float(np.radians(args.angle_scatter))
    return Model(
        offset=not args.no_offset,
        drift=args.drift or "none",
        loss=args.loss.replace("-", "_"),
        phi_scatter_rad=scatter,
        theta_scatter_rad=scatter,
        noise_strain=None if args.noise is None else args.noise * 1e-6,
        saturation_strain=None if args.saturation is None else args.saturation * 1e-6,
        prior=prior,
    )


def readings_of(data: Measurements) -> Readings:
    """The rows as the fit takes them; a tare row has no load whatever its angles say."""
    import numpy as np

    from tipforce.sensor.calibration.fit import Readings

    if data.P_newtons is None or data.phi_rad is None or data.theta_rad is None:
        raise InputError("the data have no loads: the columns P_N, phi_deg, theta_deg are needed")
    P = np.where(data.unloaded, 0.0, data.P_newtons)
    return Readings(data.strain, P, data.phi_rad, data.theta_rad, data.t_s, data.weight, data.temperature_degC)


def calibration_of(args: argparse.Namespace, data: Measurements, fit: Fit) -> Calibration:
    """The calibration that goes into the file and to the node, with where it is valid."""
    from tipforce.host.configuration.calibration import Calibration
    from tipforce.sensor.calibration.rounding import to_digits
    from tipforce.sensor.structure.layouts import CUSTOM_LAYOUT_CODE, layout_code
    from tipforce_tools.calibrate.fit_checks import validity_of
    from tipforce_tools.cli.layout_file import read_layout

    code = CUSTOM_LAYOUT_CODE
    if args.layout:
        gauges = read_layout(args.layout)[1]
        points = [gauge for gauge in gauges if isinstance(gauge, str)]
        code = layout_code(points) if len(points) == len(gauges) else CUSTOM_LAYOUT_CODE
    day = args.date or datetime.date.today()
    noise, parameters = map(to_digits, fit.record_covariances)
    return Calibration(
        fit.C, fit.offset_strain, noise, args.serial,
        day.year * 10000 + day.month * 100 + day.day, layout_code=code, pull=_pulls(args, data),
        parameter_covariance=parameters,
        **validity_of(args, fit),
    )  # fmt: skip


def _check_layout(args: argparse.Namespace, data: Measurements) -> None:
    from tipforce_tools.cli.layout_file import read_layout

    count = len(read_layout(args.layout)[1]) if args.layout else data.strain.shape[1]
    if count != data.strain.shape[1]:
        raise InputError(f"--layout {args.layout} has {count} gauges, {args.data} has {data.strain.shape[1]}")


def _pulls(args: argparse.Namespace, data: Measurements) -> bool:
    from tipforce.host.configuration.measurement_rows import MODES

    if args.sense:
        return bool(args.sense == "pull")
    if data.mode is None:
        return True
    pushes, pulls = (bool((data.mode == MODES.index(name)).any()) for name in ("push", "pull"))
    if pushes and pulls:
        common.note(args, "the data have pushes and pulls: the file says push; --sense pull for the other")
    return not pushes


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
