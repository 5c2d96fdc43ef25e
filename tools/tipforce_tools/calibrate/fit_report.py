"""What `tipforce calibrate fit` tells about a fit: as text for people, as one JSON line for programs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.dictionary import indices
from tipforce.host.configuration.calibration import RECORD, Calibration, write_calibration
from tipforce.host.configuration.calibration_file import fit_table
from tipforce.host.configuration.measurements import Measurements
from tipforce.sensor.calibration.fit import rejections
from tipforce.sensor.calibration.result import Fit
from tipforce.sensor.contact.redundancy import detectable_strain, parity
from tipforce.sensor.contact.scalar_redundancy import LEAST_SHARE
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.host.configuration.fitting import Fitted

UE = 1e6
FEW_ROWS, UNEVEN = 12, 1.6
"""Rows that show a scatter; the ratio of two that chance does not give."""
LARGEST_LACK = 2.0
"""Fit.lack_of_fit up to which intervals are narrow by less than their coverage shows."""
_FIGURES = (
    "dof", "coverage_factor", "sigma0", "sigma0_loaded", "sigma0_unloaded", "condition_number",
    "row_equilibrated_condition_number", "drift", "loss",
)  # fmt: skip


def facts(path: str, result: Fitted) -> dict[str, object]:
    """What the [fit] table says of the data: counts, and the lines that were left out."""
    data, fit = result.data, result.fit
    left = sorted({row for row, _ in (*fit.saturated, *fit.near_limit)})
    return {
        "data": path,
        "rows": len(data.line),
        "unloaded_rows": int(data.unloaded.sum()),
        "bad_lines": [row.line for row in data.bad],
        "outlier_lines": [int(data.line[row]) for row in fit.outliers],
        "saturated_lines": [int(data.line[row]) for row in left],
    }


def notes(result: Fitted) -> Iterator[str]:
    """What a person should look at before he trusts the fit."""
    request, data, _, fit, model, scores, calibration = result
    yield from (f"column {name} is not used" for name in data.ignored_columns)
    if request.drift is None and len(scores) > 1:
        others = ", ".join(f"{name} {score:.1f}" for name, score in sorted(scores.items(), key=lambda pair: -pair[1]))
        yield f"drift {fit.drift}: predicts left-out rows best (hold-out score: {others})"
    if fit.sigma0_loaded > 1.4 and (model.phi_scatter_rad or model.noise_strain is not None):
        yield (
            f"loaded rows scatter {fit.sigma0_loaded:.2g} times what the model expects: loads or gauges are less "
            "certain than stated (--noise)"
        )
    tares = sum(len(load.rows) for load in fit.loads if not load.P_newtons)
    uneven = fit.sigma0_loaded / (fit.sigma0_unloaded or math.nan)
    enough = min(tares, len(data.line) - tares) >= FEW_ROWS and model.noise_strain is None
    if enough and (uneven > UNEVEN or uneven < 1.0 / UNEVEN):
        yield (
            f"loaded rows scatter {uneven:.2g} times as far as unloaded ones: noise grows with the load (hooks, "
            "gauges), or the zero does not return (creep, hysteresis, drift); the intervals are rough"
        )
    stray = max(fit.groove_scatter, fit.hang_scatter)
    if stray > 2.0:
        yield f"load directions stray {stray:.1f} times as far as --angle-scatter says"
    yield from _of_validity(fit, calibration, request.layout)
    if request.theory is not None:
        opposite = np.flatnonzero((request.theory * fit.A).sum(axis=1) < 0.0)
        text = f"its load response is opposite to beam theory for {request.layout}: is tension positive?"
        yield from (f"SG{gauge + 1}: {text}" for gauge in opposite)
    yield from (
        f"the fit follows the load of {load.P_newtons:g} N at phi {math.degrees(load.phi_rad):g}, theta "
        f"{math.degrees(load.theta_rad):g} whatever it reads (leverage {load.leverage:.2f})"
        for load in fit.loads
        if load.P_newtons > 0.0 and load.leverage > 0.9
    )
    if not data.unloaded.any() and model.offset:
        yield "no unloaded readings: the offsets rest on the loads alone"
    yield (
        "a direction of gravity that is off by the same angle in all x- or all y-loads shows in no residual: "
        "1 degree costs about 1 % of P and 1 degree of phi or theta"
    )


def warnings(result: Fitted) -> Iterator[str]:
    """What speaks against the fit: with --strict no file is written."""
    fit = result.fit
    yield from rejections(fit, result.readings)
    if not fit.converged:
        yield "the fit has not converged: its numbers are those of the last step"
    if math.isnan(fit.sigma0_loaded) and result.model.prior is None:
        yield "no residual of a load is left: nothing checks a load, add others (or the stated noise is too small)"
    for load in fit.loads if not result.model.offset else ():
        u = np.sqrt(np.maximum(load.rms_strain**2 - load.mean_strain**2, 0.0) / max(len(load.rows) - 1, 1))
        if not load.P_newtons and (np.abs(load.mean_strain) > 5.0 * u + 1e-9).any() and len(load.rows) > 2:
            means = ", ".join(f"SG{k + 1} {value:+.3g}" for k, value in enumerate(load.mean_strain * UE))
            yield f"the unloaded rows read {means} microstrain on the mean: they are not tared, fit without --no-offset"
    if fit.lack_of_fit > LARGEST_LACK:
        yield (
            f"rows of one load differ {math.sqrt(fit.lack_of_fit):.2g} times less from each other than "
            "loads from the fit: copies or samples of one hang (give their mean, in weight their number), or weights "
            "or angles are wrong; intervals are too narrow"
        )
    straight = fit.nonlinearity
    if straight is not None and straight.significant:
        terms = _per_gauge(0.1 * straight.per_strain, 0.1 * straight.half_width)
        yield (
            f"the response is not straight: {'odd' if straight.odd else 'even'} quadratic terms in % per 1000 "
            f"microstrain: {terms}; the file states {straight.model_uncertainty:.2g} of the force as model uncertainty"
        )


def _per_gauge(values: FloatArray, halves: FloatArray) -> str:
    pairs = zip(values, halves, strict=True)
    return ", ".join(f"SG{k + 1} {value:+.2g} +- {half:.2g}" for k, (value, half) in enumerate(pairs))


def _of_validity(fit: Fit, calibration: Calibration, layout: str | None) -> Iterator[str]:
    n = fit.C.shape[1]
    if layout is None:
        yield "without --layout the overload force is not known"
    elif not calibration.overload_force_newtons:
        yield "the data have loads beyond what closes the slit of this structure: the overload force is left unknown"
    if not calibration.converter_limit_strain.any():
        yield "the converter's limit is not known (--saturation)"
    warm = fit.temperature
    if warm is None:
        yield "no temperatures: what a warm finger reads is not known"
    elif not np.isfinite((*warm.offset_half_width, warm.gain_half_width)).any():
        yield f"all rows at {warm.lowest_degC:g} degC: what a warm finger reads is not known"
    else:
        fitted = "" if warm.offset_fitted else ", not corrected"
        terms = _per_gauge(warm.offset_strain_per_K * UE, warm.offset_half_width * UE)
        gain = "" if warm.gain_fitted else ", not corrected"
        yield (
            f"{warm.lowest_degC:g} to {warm.highest_degC:g} degC: offsets change by {terms} microstrain/K{fitted}; "
            f"gain by {100 * warm.gain_per_K:+.2g} +- {100 * warm.gain_half_width:.2g} %/K{gain}"
        )
    if n > 3:
        model = parity(fit.C, calibration.covariance_strain2)
        share = model.visible * np.diag(calibration.covariance_strain2)
        smallest = detectable_strain(model, limit=calibration.redundancy_limit) * UE
        yield (
            f"redundancy: limit {calibration.redundancy_limit:.4g} of chi-square, a false alarm in a million samples; "
            "smallest fault that a sample shows: "
            + ", ".join(f"SG{k + 1} {size:.3g}" for k, size in enumerate(smallest))
            + " microstrain"
        )
        blind = ", ".join(f"SG{k + 1} ({100.0 * share[k]:.2g} %)" for k in np.flatnonzero(share < LEAST_SHARE))
        if blind:
            yield (
                f"the residuals show under {100.0 * LEAST_SHARE:.0f} % of the noise of {blind}: a smaller fault there "
                "passes as a force, and the uncertainty does not contain it"
            )


def _print_text(path: str, result: Fitted, notes: list[str]) -> None:
    data, fit, model = result.data, result.fit, result.model
    unloaded = int(data.unloaded.sum())
    print(f"{path}: {len(data.line) - unloaded} loaded and {unloaded} unloaded rows, {fit.A.shape[0]} gauges")
    scatter = math.degrees(model.phi_scatter_rad)
    prior = f", prior: beam theory within {model.prior.relative_scatter:.0%}" if model.prior else ""
    print(f"drift {fit.drift}, loss {fit.loss.replace('_', '-')}, load directions {scatter:g} degree{prior}")
    if scatter:
        print(f"found: grooves stray by {scatter * fit.groove_scatter:.2g} degree, rows of one by "
              f"{scatter * fit.hang_scatter:.2g}")  # fmt: skip
    print(f"degrees of freedom {fit.dof:.4g}, sigma0 {fit.sigma0:.3g} (loaded {fit.sigma0_loaded:.3g}, unloaded "
          f"{fit.sigma0_unloaded:.3g}), condition number {fit.condition_number:.4g} (rows equilibrated "
          f"{fit.row_equilibrated_condition_number:.4g})")  # fmt: skip
    _print_matrix(fit)
    _print_loads(fit)
    for line in (*left_out(data, fit), *(f"bad: {row}" for row in data.bad), *(f"note: {note}" for note in notes)):
        print(line)


def left_out(data: Measurements, fit: Fit) -> Iterator[str]:
    """One line for each row that does not count in full, with its line in the file."""
    kept = " (kept: loss none)" if fit.loss == "none" else ""
    for row in fit.outliers:
        residual = ", ".join(f"SG{k + 1} {value * UE:+.1f}" for k, value in enumerate(fit.residual_strain[row]))
        off = f"{fit.distance[row]:.1f} standard deviations off"
        yield f"outlier{kept}: line {data.line[row]}: {off}, residuals {residual} microstrain"
    for what, places in (("saturated", fit.saturated), ("too near to the limit", fit.near_limit)):
        yield from (f"{what}: line {data.line[row]}: SG{gauge + 1} is left out" for row, gauge in places)


def _record(path: str, result: Fitted, notes: list[str], warnings: list[str]) -> dict[str, object]:
    data, fit, calibration = result.data, result.fit, result.calibration
    return {
        **facts(path, result),
        "matrix_newtons_per_strain": fit.C.tolist(),
        "matrix_interval_95": fit.C_interval.tolist(),
        "matrix_standard_uncertainty": fit.C_uncertainty.tolist(),
        "offset_microstrain": (fit.offset_strain * UE).tolist(),
        "noise_covariance_microstrain2": (fit.noise_covariance_strain2 * UE**2).tolist(),
        "residual_covariance_microstrain2": (fit.residual_covariance_strain2 * UE**2).tolist(),
        "normal_matrix": fit.N.tolist(),
        **{name: getattr(fit, name) for name in _FIGURES},
        "load_sense": "pull" if calibration.pull else "push",
        "crc32": f"0x{calibration.crc32():08X}",
        "loads": [
            {
                "P_N": load.P_newtons,
                "phi_deg": math.degrees(load.phi_rad),
                "theta_deg": math.degrees(load.theta_rad),
                "lines": [int(data.line[row]) for row in load.rows],
                "mean_microstrain": (load.mean_strain * UE).tolist(),
                "rms_microstrain": (load.rms_strain * UE).tolist(),
                "rms_newtons": load.rms_newtons.tolist(),
                "leverage": load.leverage,
            }
            for load in fit.loads
        ],
        "left_out": list(left_out(data, fit)),
        "bad": [{"line": row.line, "reason": row.reason} for row in data.bad],
        "converged": fit.converged,
        "groove_scatter": fit.groove_scatter,
        "hang_scatter": fit.hang_scatter,
        "validity": {
            of.name: getattr(calibration, of.name)
            for of in RECORD
            if of.metadata["place"][0] >= indices.CALIBRATION_VALIDITY and not of.metadata["shape"]
        },
        "warnings": warnings,
        "notes": notes,
    }


def _print_matrix(fit: Fit) -> None:
    n = fit.A.shape[0]
    print("\nC, newtons per unit strain, +- half the 95 % interval")
    print("    " + "".join(f"{f'SG{k + 1}':>30}" for k in range(n)))
    for name, row, halves in zip(("F1", "F2", "F3"), fit.C, fit.coverage_factor * fit.C_uncertainty, strict=True):
        cells = (f"{value:>18.10g} +- {half:<8.2g}" for value, half in zip(row, halves, strict=True))
        print(f"{name}  {''.join(cells)}")
    print("\ngauge   offset, microstrain   noise, microstrain")
    noise = np.sqrt(np.diag(fit.noise_covariance_strain2))
    offset_u = np.sqrt(fit.parameter_covariance[np.arange(n), 3, np.arange(n), 3]) * fit.coverage_factor
    for k in range(n):
        print(f"SG{k + 1}  {fit.offset_strain[k] * UE:13.3f} +- {offset_u[k] * UE:<8.2g}{noise[k] * UE:12.3g}")


def _print_loads(fit: Fit) -> None:
    n = fit.A.shape[0]
    gauges = "".join(f"{f'SG{k + 1}':>8}" for k in range(n))
    print("\nresiduals by load, root mean square (microstrain, then newtons)")
    print(f"     P_N     phi   theta  rows{gauges}{'F1':>9}{'F2':>9}{'F3':>9}  leverage")
    for load in fit.loads:
        angles = f"{math.degrees(load.phi_rad):8.1f}{math.degrees(load.theta_rad):8.1f}"
        place = angles if load.P_newtons else f"{'':16}"
        strain = "".join(f"{value * UE:8.2f}" for value in load.rms_strain)
        force = "".join(f"{value:9.4f}" for value in load.rms_newtons)
        print(f"{load.P_newtons:8.3f}{place}{len(load.rows):6d}{strain}{force}{load.leverage:10.2f}")
    print()


def publish(path: str, result: Fitted, more_notes: Iterable[str] = ()) -> bool:
    """Print the account of a fit; return whether something speaks against it."""
    remarks = [*notes(result), *more_notes]
    doubts = list(warnings(result))
    if common.OUTPUT.json:
        common.print_json(_record(path, result, remarks, doubts))
    else:
        _print_text(path, result, remarks)
    for warning in doubts:
        common.note(f"{path}: {warning}")
    return bool(doubts)


def write(output: str, path: str, result: Fitted) -> None:
    """Write the calibration file ``output`` of the data in ``path``."""
    table = fit_table(result.fit, result.request.angle_scatter, **facts(path, result))
    write_calibration(output, result.calibration, table)
    common.note(f"{output}: written, load sense {'pull' if result.calibration.pull else 'push'}")
