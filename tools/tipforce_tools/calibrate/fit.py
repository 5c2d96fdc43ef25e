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
    parser.add_argument("--strict", action="store_true", help="write no file and exit 1 if a row of the data is bad")
    common.add_output_arguments(parser)


def add_model_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags that say how the readings are believed to have come about."""
    group = parser.add_argument_group("model")
    group.add_argument(
        "--angle-scatter", type=float, default=0.5, metavar="DEG",
        help="standard deviation of phi and of theta, anew in every row (default %(default)s)",
    )  # fmt: skip
    group.add_argument(
        "--drift", choices=("none", "tare", "linear"),
        help="of the offsets (default: tare where t_s and unloaded readings at two times or more allow it, else none)",
    )  # fmt: skip
    group.add_argument(
        "--loss", choices=("huber", "soft-l1", "none"), default="huber",
        help="rows that disagree weigh less or are left out by name; none: all count (default %(default)s)",
    )  # fmt: skip
    group.add_argument("--noise", type=float, metavar="UE", help="gauge noise in microstrain (default: estimated)")
    group.add_argument("--saturation", type=float, metavar="UE", help="converter limit in microstrain")
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
    """Print the fit and write the file: 0. With --strict and bad rows: no file, 1."""
    from tipforce.host.configuration.calibration_file import fit_record, write_calibration
    from tipforce.host.configuration.measurements import read_measurements
    from tipforce.sensor.calibration.fit import fit_calibration
    from tipforce.sensor.calibration.rounding import rounded
    from tipforce_tools.calibrate import fit_report
    from tipforce_tools.cli.one_finger_csv import check_one_node

    data = read_measurements(args.data, loads=True)
    check_one_node(args.data, data)
    if not len(data.line):
        raise InputError(f"{args.data}: no row can be used; the first: {data.bad[0]}")
    _check_layout(args, data)
    model = model_of(args, data)
    fit = rounded(fit_calibration(readings_of(data), model))
    calibration = calibration_of(args, data, fit)
    notes = fit_report.notes(data, fit, model, args.layout)
    if args.json:
        fit_report.print_json(args.data, data, fit, calibration, notes)
    else:
        fit_report.print_text(args.data, data, fit, model, notes)
    if data.bad:
        common.note(args, f"{args.data}: {len(data.bad)} bad rows were not used")
    if data.bad and args.strict:
        common.note(args, "--strict: no file is written")
        return 1
    if args.output:
        facts = fit_report.facts(args.data, data, fit) | {"angle_scatter_deg": args.angle_scatter}
        write_calibration(args.output, calibration, fit_record(fit, **facts))
        common.note(args, f"{args.output}: written, load sense {'pull' if calibration.pull else 'push'}")
    return 0


def model_of(args: argparse.Namespace, data: Measurements) -> Model:
    """The model that the flags and the data ask for. Raises InputError for values that are not allowed."""
    import numpy as np

    from tipforce.sensor.calibration.fit import Model, beam_prior
    from tipforce.sensor.calibration.regressors import tare_groups
    from tipforce_tools.cli.layout_file import read_layout

    drift = args.drift
    if drift is None:
        everything = np.ones(len(data.line), dtype=np.bool_)
        groups = tare_groups(data.unloaded, everything)
        drift = "tare" if data.t_s is not None and len(groups) >= 2 and not args.no_offset else "none"
    prior = None
    if args.prior:
        if not args.layout:
            raise InputError("--prior beam needs --layout: the theory depends on where the gauges sit")
        prior = beam_prior(*read_layout(args.layout), args.prior_scatter)
    if not 0.0 <= args.angle_scatter <= 20.0:
        raise InputError(f"--angle-scatter {args.angle_scatter:g}: allowed is 0 to 20 degrees")
    for name in ("noise", "saturation"):
        value = getattr(args, name)
        if value is not None and not 0.0 < value < np.inf:
            raise InputError(f"--{name} {value:g}: allowed is above 0, in microstrain")
    scatter = float(np.radians(args.angle_scatter))
    return Model(
        offset=not args.no_offset,
        drift=drift,
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
    return Readings(data.strain, P, data.phi_rad, data.theta_rad, data.t_s, data.weight)


def calibration_of(args: argparse.Namespace, data: Measurements, fit: Fit) -> Calibration:
    """The calibration that goes into the file and to the node."""
    from tipforce.host.configuration.calibration import Calibration
    from tipforce.sensor.structure.layouts import CUSTOM_LAYOUT_CODE, layout_code
    from tipforce_tools.cli.layout_file import read_layout

    code = CUSTOM_LAYOUT_CODE
    if args.layout:
        gauges = read_layout(args.layout)[1]
        points = [gauge for gauge in gauges if isinstance(gauge, str)]
        code = layout_code(points) if len(points) == len(gauges) else CUSTOM_LAYOUT_CODE
    if not 0 <= args.serial < 2**32:
        raise InputError(f"--serial {args.serial}: allowed is 0 to {2**32 - 1}")
    day = args.date or datetime.date.today()
    temperature = 20.0 if data.temperature_degC is None else float(data.temperature_degC.mean())
    return Calibration(
        fit.C, fit.offset_strain, fit.noise_covariance_strain2, args.serial,
        day.year * 10000 + day.month * 100 + day.day, temperature, code, pull=_pulls(args, data),
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


def _date(text: str) -> datetime.date:
    try:
        return datetime.date.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: write it as 2025-12-31") from None
