"""Arithmetic of the estimator, counts to P and theta, against the exact result of counts of a 24-bit converter."""

from collections.abc import Callable
from decimal import Decimal, localcontext
from functools import partial

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import EnvironmentLackError
from tipforce.sensor import FABRICATED, calibration_matrix, force_vector, strain_matrix
from tipforce_lab.report.studies import estimator_methods as methods
from tipforce_lab.report.studies.estimator_methods import COUNT_BITS, LSB_MICROSTRAIN, RANGE_MICROSTRAIN, Contacts
from tipforce_lab.report.study import Effort, Need, Point, Series, Study, Timing, series_of, timed

CASE = "III"
_FILLED = 0.98  # of the converter's range, at most
DIGITS = 50
REFERENCE_ERROR = 1e-42
"""Error of the reference, in newtons and in degrees: the root near tangency and the degrees lose some of 50 digits."""

FLOAT64, FLOAT32, NAIVE32 = "numpy float64 (the host's)", "numpy float32", "numpy float32, c2 = P2 - F2^2"
NODE, MICROPYTHON = "node, one sample at a time", "node on MicroPython"
WRAPS, INT16, INT32 = "int16 C, 32-bit accumulator", "int16 C, 64-bit accumulator", "int32 C, CORDIC"
INT32_TABLE = "int32 C, arctangent table"
_INSIDE = "REAL32 C"

_WIDE = partial(methods.in_integers, 32, 24, 64)
_METHODS: dict[str, dict[str, Callable[[Contacts], methods.Method]]] = {
    FLOAT64: {"float64 C": methods.bulk_float64},
    FLOAT32: {"float32 C": partial(methods.single_precision, True)},
    NAIVE32: {"float32 C": partial(methods.single_precision, False)},
    NODE: {
        "INTEGER16 object": partial(methods.on_the_node, "INTEGER16"),
        "REAL32 object": partial(methods.on_the_node, "REAL32"),
        "inside, REAL32 C": partial(methods.on_the_node, "inside"),
    },
    WRAPS: {f"{n}-bit C": partial(methods.in_integers, n, 16, 32, methods.cordic(16)) for n in (8, 12, 14, 16)},
    INT16: {f"{n}-bit C": partial(methods.in_integers, n, 16, 64, methods.cordic(16)) for n in (8, 12, 16)},
    INT32: {f"{n} iterations": partial(_WIDE, methods.cordic(n)) for n in (8, 12, 16, 20, 28)},
    INT32_TABLE: {f"{n} entries": partial(_WIDE, methods.table(n)) for n in (16, 64, 256, 1024)},
}
"""Method -> setting -> its preparation. Not MicroPython, which times itself."""
STEPS = 2 * (sum(map(len, _METHODS.values())) + 1)


_Setting = tuple[str, str]
"""Method and setting."""
_Results = dict[_Setting, tuple[methods.Estimate, Timing]]


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return the studies of P and theta away from tangency, and of theta near it."""
    rng = np.random.default_rng([effort.seed, 1])
    k = effort.pick(400, 4000)
    usual = contacts(rng, k, corners=True)
    sliding = contacts(rng, k, sliding=True)
    left_out: dict[str, str] = {}
    results = _run(usual, effort, left_out, advance)
    results_sliding = _run(sliding, effort, left_out, advance, results)
    # P does not depend on the arctangent: one setting of the integers is enough.
    for_force = {
        (method, setting): result
        for (method, setting), result in results.items()
        if method not in (INT32, INT32_TABLE) or setting == "28 iterations"
    }
    force = _series(for_force, lambda estimate: errors(estimate[0], usual.P_newtons) / usual.full_scale_newtons)
    angle = _series(results, lambda estimate: errors(estimate[1], usual.theta_deg, 360.0))
    near = _series(results_sliding, lambda estimate: errors(estimate[1], sliding.theta_deg, 360.0))
    off = "largest error of theta (degrees)"
    remarks = _remarks(_worst(force), _worst(angle), _worst(near), usual.full_scale_newtons, results)
    return [
        _study(*row, left_out) for row in (
            ("force", "the force P", "largest error of P / full scale", usual, "and the corners of the converter range",
             force, remarks[0], Need("force P from strain, to 1e-6 of full scale", 1e-6, unfit=(NAIVE32,))),
            ("angle", "the contact angle theta", off, usual, "at least 0.1 in |cos(delta)| from tangency",
             angle, remarks[1], Need("contact angle from strain, to 0.01 degree", 0.01, "degree", (NAIVE32,))),
            ("tangent", "theta of contacts that nearly slide", off, sliding, "with |cos(delta)| from 0.001 to 0.1",
             near, remarks[2], Need("contact angle near tangency, to 0.1 degree", 0.1, "degree", (NAIVE32,))),
        )
    ]  # fmt: skip


def _run(
    given: Contacts,
    effort: Effort,
    left_out: dict[str, str],
    advance: Callable[[], None],
    known: _Results | None = None,
) -> _Results:
    """Run all methods, timed or with the times of ``known``; one that does not run is entered in left_out, once."""
    results: _Results = {}
    for method, settings in _METHODS.items():
        for setting, prepare in settings.items():
            work = prepare(given)
            timing = known[method, setting][1] if known else timed(work, effort, units=len(given.counts))
            results[method, setting] = work(), timing
            advance()
    if MICROPYTHON not in left_out:
        try:
            estimate, timing = methods.on_micropython(given, effort)
            results[MICROPYTHON, _INSIDE] = estimate, known[MICROPYTHON, _INSIDE][1] if known else timing
        except EnvironmentLackError as lack:
            left_out[MICROPYTHON] = str(lack)
    advance()
    return results


def _series(results: _Results, error: Callable[[methods.Estimate], FloatArray]) -> tuple[Series, ...]:
    points = []
    for (method, setting), (estimate, timing) in results.items():
        off = error(estimate)
        points.append((method, Point(setting, float(np.abs(off).max()), timing, float(np.sqrt(np.mean(off**2))))))
    return series_of(points)


def _worst(series: tuple[Series, ...]) -> dict[_Setting, float]:
    return {(method.method, point.setting): point.error for method in series for point in method.points}


def _study(
    key: str, title: str, error_unit: str, given: Contacts, inputs: str, series: tuple[Series, ...],
    remarks: list[str], need: Need, left_out: dict[str, str],
) -> Study:  # fmt: skip
    reference = (
        f"the formula in decimal arithmetic with {DIGITS} digits, on the same counts and the same float64 C; "
        f"{len(given.counts)} random pushes {inputs}, as counts of a {COUNT_BITS}-bit converter with a range of "
        f"{RANGE_MICROSTRAIN:g} microstrain; case III of the paper, full scale {given.full_scale_newtons:.2f} N"
    )
    remarks.append("The times of the integer methods are those of numpy on this machine, not of a microcontroller.")
    return Study(
        f"estimator-{key}", f"Estimator arithmetic: {title}", error_unit, "s per sample", reference, REFERENCE_ERROR,
        series, left_out, tuple(remarks), (need,),
    )  # fmt: skip


def _remarks(
    force: dict[_Setting, float], angle: dict[_Setting, float], near: dict[_Setting, float], full_scale_newtons: float,
    results: _Results,
) -> tuple[list[str], list[str], list[str]]:  # fmt: skip
    double, single, naive = (FLOAT64, "float64 C"), (FLOAT32, "float32 C"), (NAIVE32, "float32 C")
    half_lsb = 2.0**-COUNT_BITS
    of_force = [
        f"Single precision is off by {force[single]:.1e} of full scale at most, {force[single] / half_lsb:.1f} times "
        f"half a step of a {COUNT_BITS}-bit converter ({half_lsb:.1e}).",
        f"16-bit coefficients: with a 32-bit accumulator the worst sample is off by "
        f"{force[WRAPS, '16-bit C'] * full_scale_newtons:.3g} N, with a 64-bit one by "
        f"{force[INT16, '16-bit C'] * full_scale_newtons:.2g} N.",
        f"The node's INTEGER16 object rounds P to 1 mN: {force[NODE, 'INTEGER16 object']:.1e} of full scale.",
    ]
    of_angle = [
        f"From 8 to 20 CORDIC iterations the error falls from {angle[INT32, '8 iterations']:.1e} to "
        f"{angle[INT32, '20 iterations']:.1e} degrees; 28 iterations give {angle[INT32, '28 iterations']:.1e}.",
        f"An arctangent table of 256 entries with linear interpolation gives "
        f"{angle[INT32_TABLE, '256 entries']:.1e} degrees.",
        f"16-bit readings, not the arctangent, hold int16 at {angle[INT16, '16-bit C']:.2g} degrees, for the smallest "
        "loads.",
    ]
    there = results.get((MICROPYTHON, _INSIDE))
    if there is not None:
        here = results[NODE, "inside, REAL32 C"]
        apart = max(float(np.abs(b - a).max()) for a, b in zip(there[0], here[0], strict=True))
        of_angle.append(f"The node's code gives the same under MicroPython and CPython, to {apart:.1g} N and degrees.")
    near_tangency = [
        f"The error is {near[double] / angle[double]:.0f} times (float64) and {near[single] / angle[single]:.0f} times "
        f"(float32) what it is away from tangency, and still only {near[double]:.0e} and {near[single]:.0e} degrees.",
        f"With P^2 - F2^2 in place of its factors the largest error is {near[naive] / near[single]:.1f} times as "
        "large: the rounding of F = C V decides here, not that of the difference.",
    ]
    return of_force, of_angle, near_tangency


def contacts(rng: np.random.Generator, k: int, sliding: bool = False, corners: bool = False) -> Contacts:
    """Return k pushes in any direction: half log-uniform from 1 % of the range, half above 50 %; |cos(delta)| at least
    0.1, or ``sliding`` 0.001 to 0.1. corners: also those with every gauge at an end of the range."""
    C, A = calibration_matrix(FABRICATED, CASE), strain_matrix(FABRICATED, CASE)
    phi = rng.uniform(-np.pi, np.pi, k)
    cosine = 10.0 ** rng.uniform(-3.0, -1.0, k) if sliding else rng.uniform(0.1, 1.0, k)
    delta = np.pi - np.arccos(cosine) * rng.choice([-1.0, 1.0], k)  # a push: cos(delta) < 0
    microstrain = 1e6 * force_vector(1.0, phi, phi - delta) @ A.T
    share = np.where(np.arange(k) % 2, rng.uniform(0.5, 1.0, k), 10.0 ** rng.uniform(-2.0, 0.0, k))
    P = share * _FILLED * RANGE_MICROSTRAIN / np.abs(microstrain).max(axis=1)
    counts = np.rint(P[:, np.newaxis] * microstrain / LSB_MICROSTRAIN).astype(np.int64)
    if corners:
        # Every gauge at a limit of its range that a contact can cause: |F2| < P.
        signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
        F = signs @ C.T
        possible = np.abs(F[:, 1]) < 0.99 * np.hypot(F[:, 0], F[:, 2])
        counts = np.concatenate((counts, signs[possible] * round(_FILLED * 2 ** (COUNT_BITS - 1))))
    exact = [_exact(C, row) for row in counts.tolist()]
    # The largest strain of a gauge per newton: that for F2 = P or F2 = -P at the best phi.
    at, sine = np.meshgrid(np.linspace(-np.pi, np.pi, 721), np.linspace(-1.0, 1.0, 3))
    largest = np.abs(np.stack((np.sin(at), sine, np.cos(at)), axis=-1) @ A.T).max()
    P_exact, theta_exact = map(list, zip(*exact, strict=True))
    return Contacts(C, counts, P_exact, theta_exact, float(RANGE_MICROSTRAIN * 1e-6 / largest))


def _exact(C: FloatArray, counts: list[int]) -> tuple[Decimal, Decimal]:
    """Return P in newtons and theta in degrees: the paper's equation (16) inverted with 50 digits."""
    with localcontext() as context:
        context.prec = DIGITS
        lsb = Decimal(LSB_MICROSTRAIN) * Decimal("1e-6")
        F1, F2, F3 = (sum((Decimal(c) * n for c, n in zip(row, counts, strict=True)), Decimal(0)) * lsb
                      for row in C.tolist())  # fmt: skip
        squared = F1 * F1 + F3 * F3
        hypotenuse = squared.sqrt()
        cosine_squared = squared - F2 * F2
        P = hypotenuse if cosine_squared >= 0 else (hypotenuse + abs(F2)) / 2
        delta = arctan2(F2, -max(cosine_squared, Decimal(0)).sqrt())
        theta = (arctan2(F1, F3) - delta) * 180 / PI
        if theta > 180:
            theta -= 360
        elif theta <= -180:
            theta += 360
        return P, theta


PI = Decimal(
    "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803482534211706798214808651"
)


def arctan2(y: Decimal, x: Decimal) -> Decimal:
    """Return the angle of (x, y) in radians, in the precision of the context."""
    if abs(y) > abs(x):
        return (PI / 2).copy_sign(y) - _arctan(x / y)
    if x > 0:
        return _arctan(y / x)
    return PI.copy_sign(y) + _arctan(y / x) if x else Decimal(0)


def _arctan(t: Decimal) -> Decimal:
    """Compute atan(t) = 2 atan(t / (1 + sqrt(1 + t^2))), five times; then the series."""
    for _ in range(5):
        t = t / (1 + (1 + t * t).sqrt())
    term, total, k = t, t, 1
    while abs(term) > abs(t) * Decimal(10) ** (-DIGITS - 2):
        term *= -t * t
        k += 2
        total += term / k
    return total * 32


def errors(estimated: FloatArray, exact: list[Decimal], period: float = 0.0) -> FloatArray:
    """Return found - exact, (k,), as the difference of exact numbers; angles wrapped to half a period."""
    difference = np.array([float(Decimal(f) - e) for f, e in zip(estimated.tolist(), exact, strict=True)])
    return difference - period * np.rint(difference / period) if period else difference
