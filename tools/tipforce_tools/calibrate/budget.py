"""`tipforce calibrate budget`: the error budget of P, phi, theta by cause, as a table, JSON lines and a plot."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from tipforce.errors import InputError, placed
from tipforce.output_file import check_output, figure_kind
from tipforce.sensor.contact.scalar import DEGREES
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.host.configuration.calibration import Calibration
    from tipforce_lab.design.error_budget import Budget, Causes, Sensor


_FLAGS: tuple[tuple[str, str, str, str, float], ...] = (
    ("--noise", "UE", "gauge noise, microstrain (default: the file's, or 1)", "noise_strain", 1e-6),
    ("--resolution", "UE", "one step of the converter, microstrain (default 0.1)", "resolution_strain", 1e-6),
    ("--gain", "%", "drift of each sensitivity, percent (default 0.1)", "gain", 1e-2),
    ("--offset", "UE", "drift of each gauge's zero, microstrain (default 1)", "offset_strain", 1e-6),
    ("--temperature", "K", "change since the last tare, kelvin (default 1)", "temperature_K", 1.0),
    ("--hysteresis", "%", "percent of the largest strain (default 0.05)", "hysteresis", 1e-2),
    ("--creep", "%", "growth under a load, percent (default 0.05)", "creep", 1e-2),
    ("--load-angle", "DEG", "scatter of calibration loads, degrees (default 0.5)", "load_angle_rad", math.pi / 180.0),
    ("--gravity", "DEG", "between x- and y-loads, degrees (default 0.5)", "gravity_rad", math.pi / 180.0),
    ("--gauge-shift", "MM", "along the beam, with --uncalibrated (default 0.2)", "gauge_shift_m", 1e-3),
    ("--off-axis", "N", "along the width of the beams (default 0.5)", "off_axis_newtons", 1.0),
)
"""Flag, unit, help, field of ``error_budget.Causes`` and its size of one unit."""
_MOST = 1e9
"""Limit of each cause in the unit of its flag, and of the load in newtons: its squares stay in range."""
_QUANTITIES = (("P", "N", 1.0), ("phi", "deg", DEGREES), ("theta", "deg", DEGREES))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All values are standard uncertainties. The calibration is assumed to be one reading in each of the 19 grooves of
    section 4.1, with as many tares. Without CAL.toml: the paper's case I (or --layout), calibrated in this way; with
    --uncalibrated C comes from Table 1 and the gauge positions matter. A gravity misalignment leaves almost no
    residuals in a calibration; this table shows its effect.
    One load: --phi and --theta. Default: loads over the whole pad, every 5 degrees of theta, up to 45 degrees to
    either side of the surface normal; the table then shows the root mean square and the maximum.
      tipforce calibrate budget --layout II --gravity 1 -o budget.png
    """
    parser.add_argument("file", nargs="?", metavar="CAL.toml")
    parser.add_argument("--layout", metavar="NAME|FILE", help="gauge layout: I, II, III or a layout file")
    parser.add_argument("--uncalibrated", action="store_true", help="C from theory, without a calibration")
    load = common.number_within(1.0 / _MOST, _MOST, f"is {1.0 / _MOST:g} to {_MOST:g} N")
    angle = common.number_within(-360.0, 360.0, "are degrees from -360 to 360")
    common.add_number(parser, "--load", 4.4, "N", "P in newtons (default %(default)s)", load)
    common.add_number(parser, "--phi", None, "DEG", "with --theta: one load instead of the pad", angle)
    parser.add_argument("--theta", type=angle, metavar="DEG")
    parser.add_argument("--sense", choices=("push", "pull"), help="of the loads (default: that of the file, else push)")
    sizes = parser.add_argument_group("causes")
    cause = common.number_within(0.0, _MOST, f"is 0 to {_MOST:g}")
    for flag, unit, text, *_ in _FLAGS:
        common.add_number(sizes, flag, None, unit.replace("%", "PERCENT"), text, cause)
    parser.add_argument("-o", "--output", metavar="FILE", help="a plot, .png or .svg")
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the budget; return 0."""
    if args.uncalibrated and args.file:
        raise InputError("--uncalibrated: not allowed with a calibration file; remove one of them")
    if (args.phi is None) != (args.theta is None):
        raise InputError("--phi and --theta: one load needs both; omit both for loads over the whole pad")
    if args.output:
        check_output(args.output, figure_kind(args.output))
    calibration = None
    if args.file is not None:
        common.InputFile("calibration ").check(args.file)
        from tipforce.host.configuration.calibration import read_calibration

        calibration = read_calibration(args.file)
    import numpy as np

    from tipforce_lab.design.error_budget import Causes, Loads, budget, pad_loads, plot

    sensor = _sensor(args, calibration)
    if args.phi is not None:
        loads = Loads(*(np.array([value]) for value in (args.load, np.radians(args.phi), np.radians(args.theta))))
        if np.cos(np.radians(args.phi - args.theta)) * (1.0 if sensor.pull else -1.0) < -1e-9:
            sense, other = ("pull", "push") if sensor.pull else ("push", "pull")
            common.note(
                f"a {sense} along phi meets the tip opposite to theta: these are its values; or --sense {other}"
            )
    else:
        pad = (0.0, 180.0) if calibration is None else (calibration.theta_min_deg, calibration.theta_max_deg)
        loads = pad_loads(args.load, *pad, pull=sensor.pull)
    if calibration is None and args.noise is None:
        args.noise = 1.0
    given = ((field, getattr(args, flag[2:].replace("-", "_")), unit) for flag, _, _, field, unit in _FLAGS)
    causes = Causes(**{field: value * unit for field, value, unit in given if value is not None})
    error_budget = budget(sensor, loads, causes)
    if args.output:
        plot(error_budget, args.output)
    _print(_records(error_budget), len(loads.P_newtons) == 1)
    _say_limits(error_budget, causes, args.uncalibrated)
    return 0


def _sensor(args: argparse.Namespace, calibration: Calibration | None) -> Sensor:
    import numpy as np

    from tipforce.sensor.contact.redundancy import structure_matrix
    from tipforce.sensor.structure.layouts import CASE_OF_CODE
    from tipforce.sensor.structure.strain import gauge_matrix, place
    from tipforce.sources.layout_file import read_layout
    from tipforce_lab.design.error_budget import Sensor

    name = args.layout
    if name is None:
        name = "I" if calibration is None else CASE_OF_CODE.get(calibration.layout_code)
    geometry, gauges = (None, ()) if name is None else read_layout(name)
    positions = tuple(place(geometry, gauge) for gauge in gauges) if geometry is not None else ()
    if calibration is None:
        assert geometry is not None
        A = gauge_matrix(geometry, gauges)
        if np.linalg.matrix_rank(A) < 3:
            raise InputError(f"--layout {name}: its gauges cannot distinguish the three forces")
        pull = args.sense == "pull"
        C = np.asarray(np.linalg.pinv(A), dtype=np.float64)
        return Sensor(C, A, 1e-12 * np.eye(len(A)), pull, not args.uncalibrated, geometry, positions)
    if positions and len(positions) != calibration.gauges:
        raise InputError(f"--layout {name}: it has {len(positions)} gauges, the calibration {calibration.gauges}")
    pull = calibration.pull if args.sense is None else args.sense == "pull"
    with placed(f"calibration {args.file}"):
        A = structure_matrix(calibration.C, calibration.covariance_strain2)
    return Sensor(calibration.C, A, calibration.covariance_strain2, pull, True, geometry, positions)


def _records(error_budget: Budget) -> list[dict[str, object]]:
    import numpy as np

    records: list[dict[str, object]] = []
    with np.errstate(divide="ignore", invalid="ignore"):
        whole = np.mean(error_budget.total**2, axis=0)
        for cause, uncertainties in {**error_budget.rows, "total": error_budget.total}.items():
            rms = np.sqrt(np.mean(uncertainties**2, axis=0))
            largest, share = uncertainties.max(axis=0), 100.0 * rms**2 / whole
            record: dict[str, object] = {"cause": cause}
            for k, (name, unit, size) in enumerate(_QUANTITIES):
                record |= {f"u_{name}_{unit}": float(rms[k] * size), f"u_{name}_{unit}_max": float(largest[k] * size)}
                record[f"share_{name}_percent"] = float(share[k])
            records.append(record)
    return records


def _print(records: list[dict[str, object]], single: bool) -> None:
    widest = max(len(str(record["cause"])) for record in records)
    most = "" if single else f"{'max':>9}"
    heads = (f"{f'u({name}) {unit}':>14}{most}{'share':>8}" for name, unit, _ in _QUANTITIES)
    if not common.OUTPUT.json:
        print(f"{'cause':<{widest}}" + "".join(heads))
    for record in records:
        line = f"{record['cause']:<{widest}}"
        for name, unit, _ in _QUANTITIES:
            key = f"u_{name}_{unit}"
            most = "" if single else f"{record[f'{key}_max']:>9.3g}"
            line += f"{record[key]:>14.4g}{most}{record[f'share_{name}_percent']:>7.1f}%"
        common.print_record(record, line)


def _say_limits(error_budget: Budget, causes: Causes, uncalibrated: bool) -> None:
    from tipforce_lab.design.error_budget import gravity_residual

    if not uncalibrated:
        common.note("gauge position: no contribution, the calibration removes it (--uncalibrated shows it)")
        shown = 100.0 * gravity_residual(causes.gravity_rad)
        common.note(f"gravity: visible in the calibration's residuals as {shown:.2g} % of the load")
    for cause, reason in error_budget.left_out.items():
        common.note(f"no row for {cause}: {reason}")
    for name, holds in zip(("P", "phi", "theta"), error_budget.holds.T, strict=True):
        if not holds.all():
            common.note(
                f"first order does not hold for {name} at {int((~holds).sum())} of {len(holds)} loads "
                "(small load or near-tangential contact): an interval from this uncertainty is wrong there"
            )
