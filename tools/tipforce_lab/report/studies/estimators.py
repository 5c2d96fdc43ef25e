"""Arithmetic of the estimator: counts to F = C V, then P and theta, in floating point, in integers, on MicroPython."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import EnvironmentLackError
from tipforce_lab.report.studies import estimator_methods as methods
from tipforce_lab.report.studies.estimator_inputs import (
    COUNT_BITS,
    DIGITS,
    RANGE_MICROSTRAIN,
    REFERENCE_ERROR,
    Contacts,
    contacts,
    errors,
    near,
    tangent,
)
from tipforce_lab.report.study import Effort, Need, Point, Series, Study, Timing, timed

FLOAT64, FLOAT32, NAIVE32 = "numpy float64 (the host's)", "numpy float32", "numpy float32, c2 = P2 - F2^2"
NODE, MICROPYTHON = "node, one sample at a time", "node on MicroPython"
WRAPS, INT16, INT32 = "int16 C, 32-bit accumulator", "int16 C, 64-bit accumulator", "int32 C, CORDIC"
INT32_TABLE = "int32 C, arctangent table"
_INSIDE = "REAL32 C"

_REFERENCE = f"the formula in decimal arithmetic with {DIGITS} digits, on the same counts and the same float64 C"
_INTEGERS = "The times of the integer methods are those of numpy on this machine, not of a microcontroller."

Prepare = Callable[[Contacts], methods.Method]


def _in_integers(C: int, readings: int, sums: int, arctangent: methods.Arctangent) -> Prepare:
    """Return the method with these widths in bits."""
    form = methods.Format(C, readings, sums, arctangent)
    return lambda given: methods.in_integers(given, form)


_METHODS: dict[str, dict[str, Prepare]] = {
    FLOAT64: {"float64 C": methods.bulk_float64},
    FLOAT32: {"float32 C": lambda given: methods.single_precision(given, True)},
    NAIVE32: {"float32 C": lambda given: methods.single_precision(given, False)},
    NODE: {
        "INTEGER16 object": lambda given: methods.on_the_node(given, "INTEGER16"),
        "REAL32 object": lambda given: methods.on_the_node(given, "REAL32"),
        "inside, REAL32 C": lambda given: methods.on_the_node(given, "inside"),
    },
    WRAPS: {f"{n}-bit C": _in_integers(n, 16, 32, methods.cordic(16)) for n in (8, 12, 14, 16)},
    INT16: {f"{n}-bit C": _in_integers(n, 16, 64, methods.cordic(16)) for n in (8, 12, 16)},
    INT32: {f"{n} iterations": _in_integers(32, 24, 64, methods.cordic(n)) for n in (8, 12, 16, 20, 28)},
    INT32_TABLE: {f"{n} entries": _in_integers(32, 24, 64, methods.table(n)) for n in (16, 64, 256, 1024)},
}
"""Method -> setting -> its preparation. Not MicroPython, which times itself."""
STEPS = 2 * (sum(map(len, _METHODS.values())) + 1)


class _Result(NamedTuple):
    """One setting of one method."""

    estimate: methods.Estimate
    timing: Timing


_Results = dict[str, dict[str, _Result]]
"""By method and setting."""


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return the studies of P and theta away from tangency, and of theta near it."""
    rng = np.random.default_rng([effort.seed, 1])
    k = effort.pick(400, 4000)
    usual = contacts(rng, k, near, corners=True)
    sliding = contacts(rng, k, tangent)
    left_out: dict[str, str] = {}
    results = _run(usual, effort, left_out, advance)
    results_sliding = _run(sliding, effort, left_out, advance, results)
    angle = _angle_study(usual, results, left_out)
    return [_force_study(usual, results, left_out), angle, _tangent_study(sliding, results_sliding, left_out, angle)]


def _run(
    given: Contacts,
    effort: Effort,
    left_out: dict[str, str],
    advance: Callable[[], None],
    known: _Results | None = None,
) -> _Results:
    """Run all methods on these contacts: timed, or with the times of ``known``, whose work is the same.

    A method that does not run is entered in left_out with the reason, and not tried again.
    """
    results: _Results = {}
    for method, settings in _METHODS.items():
        for setting, prepare in settings.items():
            work = prepare(given)
            timing = known[method][setting].timing if known else timed(work, effort, units=len(given.counts))
            results.setdefault(method, {})[setting] = _Result(work(), timing)
            advance()
    if MICROPYTHON not in left_out:
        try:
            estimate, timing = methods.on_micropython(given, effort)
            timing = known[MICROPYTHON][_INSIDE].timing if known else timing
            results[MICROPYTHON] = {_INSIDE: _Result(estimate, timing)}
        except EnvironmentLackError as lack:
            left_out[MICROPYTHON] = str(lack)
    advance()
    return results


def _series(results: _Results, error: Callable[[methods.Estimate], FloatArray]) -> tuple[Series, ...]:
    series = []
    for method, settings in results.items():
        points = []
        for setting, result in settings.items():
            off = error(result.estimate)
            rms = float(np.sqrt(np.mean(off**2)))
            points.append(Point(setting, float(np.abs(off).max()), result.timing, rms))
        series.append(Series(method, tuple(points)))
    return tuple(series)


def _worst(series: tuple[Series, ...]) -> dict[tuple[str, str], float]:
    return {(method.method, point.setting): point.error for method in series for point in method.points}


def _inputs(given: Contacts, what: str) -> str:
    return (
        f"{len(given.counts)} random pushes {what}, as counts of a {COUNT_BITS}-bit converter with a range of "
        f"{RANGE_MICROSTRAIN:g} microstrain; case III of the paper, full scale {given.full_scale_newtons:.2f} N"
    )


def _study(
    about: tuple[str, str, str],
    need: Need,
    inputs: str,
    series: tuple[Series, ...],
    left_out: dict[str, str],
    remarks: tuple[str, ...],
) -> Study:
    """``about``: the end of the key, of the title, and the unit of the error."""
    key, title, error_unit = about
    return Study(
        key=f"estimator-{key}",
        title=f"Estimator arithmetic: {title}",
        error_unit=error_unit,
        work_unit="s per sample",
        reference=f"{_REFERENCE}; {inputs}",
        reference_error=REFERENCE_ERROR,
        series=series,
        left_out=left_out,
        remarks=remarks,
        needs=(need,),
    )  # fmt: skip


def _force_study(given: Contacts, results: _Results, left_out: dict[str, str]) -> Study:
    def error(estimate: methods.Estimate) -> FloatArray:
        return errors(estimate[0], given.P_newtons) / given.full_scale_newtons

    # P does not depend on the arctangent: one setting of the integers is enough.
    kept = {method: settings for method, settings in results.items() if method != INT32_TABLE}
    finest = "28 iterations"
    series = _series({**kept, INT32: {finest: kept[INT32][finest]}}, error)
    worst = _worst(series)
    half_lsb = 2.0**-COUNT_BITS
    single = worst[FLOAT32, "float32 C"]
    remarks = [
        f"Single precision is off by {single:.1e} of full scale at most, {single / half_lsb:.1f} times half a step of "
        f"a {COUNT_BITS}-bit converter ({half_lsb:.1e}).",
        f"16-bit coefficients: with a 32-bit accumulator the worst sample is off by "
        f"{worst[WRAPS, '16-bit C'] * given.full_scale_newtons:.3g} N, with a 64-bit one by "
        f"{worst[INT16, '16-bit C'] * given.full_scale_newtons:.2g} N.",
        f"The node's INTEGER16 object rounds P to 1 mN: {worst[NODE, 'INTEGER16 object']:.1e} of full scale.",
        _INTEGERS,
    ]
    about = ("force", "the force P", "largest error of P / full scale")
    need = Need("force P from strain, to 1e-6 of full scale", 1e-6, unfit=(NAIVE32,))
    return _study(
        about, need, _inputs(given, "and the corners of the converter range"), series, left_out, tuple(remarks)
    )


def _angle_error(given: Contacts) -> Callable[[methods.Estimate], FloatArray]:
    return lambda estimate: errors(estimate[1], given.theta_deg, 360.0)


def _angle_study(given: Contacts, results: _Results, left_out: dict[str, str]) -> Study:
    series = _series(results, _angle_error(given))
    worst = _worst(series)
    remarks = (
        f"From 8 to 20 CORDIC iterations the error falls from {worst[INT32, '8 iterations']:.1e} to "
        f"{worst[INT32, '20 iterations']:.1e} degrees; 28 iterations give {worst[INT32, '28 iterations']:.1e}.",
        f"An arctangent table of 256 entries with linear interpolation gives "
        f"{worst[INT32_TABLE, '256 entries']:.1e} degrees.",
        f"16-bit readings, not the arctangent, hold int16 at {worst[INT16, '16-bit C']:.2g} degrees, for the smallest "
        "loads.",
        *_same_on_micropython(results),
        _INTEGERS,
    )
    about = ("angle", "the contact angle theta", "largest error of theta (degrees)")
    need = Need("contact angle from strain, to 0.01 degree", 0.01, "degree", (NAIVE32,))
    return _study(about, need, _inputs(given, "at least 0.1 in |cos(delta)| from tangency"), series, left_out, remarks)


def _same_on_micropython(results: _Results) -> list[str]:
    if MICROPYTHON not in results:
        return []
    there, here = results[MICROPYTHON][_INSIDE].estimate, results[NODE]["inside, REAL32 C"].estimate
    apart = max(float(np.abs(b - a).max()) for a, b in zip(there, here, strict=True))
    return [f"The node's code gives the same under MicroPython and CPython, to {apart:.1g} N and degrees."]


def _tangent_study(given: Contacts, results: _Results, left_out: dict[str, str], away: Study) -> Study:
    series = _series(results, _angle_error(given))
    worst, worst_away = _worst(series), _worst(away.series)
    single, double, naive = (FLOAT32, "float32 C"), (FLOAT64, "float64 C"), (NAIVE32, "float32 C")
    remarks = (
        f"The error is {worst[double] / worst_away[double]:.0f} times (float64) and "
        f"{worst[single] / worst_away[single]:.0f} times (float32) what it is away from tangency, and still only "
        f"{worst[double]:.0e} and {worst[single]:.0e} degrees.",
        f"With P^2 - F2^2 in place of its factors the largest error is {worst[naive] / worst[single]:.1f} times as "
        "large: the rounding of F = C V decides here, not that of the difference.",
        _INTEGERS,
    )
    about = ("tangent", "theta of contacts that nearly slide", "largest error of theta (degrees)")
    need = Need("contact angle near tangency, to 0.1 degree", 0.1, "degree", (NAIVE32,))
    return _study(about, need, _inputs(given, "with |cos(delta)| from 0.001 to 0.1"), series, left_out, remarks)
