"""Standard uncertainty of one sample's contact on the MicroPython subset; loaded when one is asked for. NaN or infinity
in gives NaN out. ``cov`` is the upper triangle (11, 12, 13, 22, 23, 33) of the covariance of F, N^2."""

from math import asin, frexp, ldexp, sqrt

from .scalar import NAN, SMALLEST_COSINE, SMALLEST_STEP, scaled_force

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .scalar import ScaledForce

    Six = tuple[float, float, float, float, float, float]
    ScaledCovariance = tuple[Six, int]


def uncertainty(F1: float, F2: float, F3: float, cov: "Six", pull: bool) -> tuple[float, float, float]:
    """Return the standard uncertainties (u_P, u_phi, u_theta). First order, J cov J^T, but finite_slope() for
    1 / |cos(delta)|, which grows without bound near a tangential contact (the real spread of theta stays near SNR **
    -0.5). F1 = F3 = 0: worst u_P, angles NaN."""
    return deviations(scaled_force(F1, F2, F3), scaled_covariance(cov), pull)[:3]


def deviations(
    force: "ScaledForce | None", covariance: "ScaledCovariance | None", pull: bool
) -> tuple[float, float, float, float, float]:
    """Return uncertainty(), the standard uncertainty of F2 / P to first order, and |cos(delta)|. force, covariance: of
    scaled_force() and scaled_covariance()."""
    if force is None or covariance is None:
        return NAN, NAN, NAN, NAN, NAN
    _F1, _F3, f1, f2, f3, hypotenuse, cosine_squared, exponent = force
    K, half = covariance
    if hypotenuse == 0.0:
        return _times_power(_worst_deviation(K), half), NAN, NAN, NAN, NAN
    n1, n3 = f1 / hypotenuse, f3 / hypotenuse
    u_P = _deviation(K, n1, 0.0, n3)
    P = max(hypotenuse, 0.5 * (hypotenuse + abs(f2)))
    x = max(-1.0, min(1.0, f2 / hypotenuse))
    # Gradients of phi and of F2 / P, times P.
    g1, g3 = -x * n1, -x * n3
    step = _times_power(_deviation(K, g1, 1.0, g3) / P, half - exponent)
    cosine = sqrt(max(0.0, cosine_squared)) / hypotenuse
    slope = finite_slope(abs(x), cosine, step)
    if not pull:
        slope = -slope
    u_phi = _deviation(K, n3, 0.0, -n1) / P
    u_theta = _deviation(K, n3 - slope * g1, -slope, -n1 - slope * g3) / P
    return (
        _times_power(u_P, half),
        _times_power(u_phi, half - exponent),
        _times_power(u_theta, half - exponent),
        step,
        cosine,
    )


def magnitude_uncertainty(F1: float, F2: float, F3: float, cov: "Six") -> float:
    """Return u_P of uncertainty() alone, bit for bit, for a third of the work: the angles cost the rest."""
    force, covariance = scaled_force(F1, F2, F3), scaled_covariance(cov)
    if force is None or covariance is None:
        return NAN
    _F1, _F3, f1, _f2, f3, hypotenuse, _cosine_squared, _exponent = force
    K, half = covariance
    if hypotenuse == 0.0:
        return _times_power(_worst_deviation(K), half)
    return _times_power(_deviation(K, f1 / hypotenuse, 0.0, f3 / hypotenuse), half)


def miss_uncertainty(F1: float, F2: float, F3: float, cov: "Six") -> float:
    """Return the standard uncertainty of |F2| - hypot(F1, F3) in newtons. Needed only for a
    miss above zero. F1 = F3 = 0: the largest that any direction and correlation can give."""
    force, covariance = scaled_force(F1, F2, F3), scaled_covariance(cov)
    if force is None or covariance is None:
        return NAN
    _F1, _F3, f1, f2, f3, hypotenuse, _cosine_squared, _exponent = force
    K, half = covariance
    if hypotenuse == 0.0:
        return _times_power(_worst_deviation(K) + sqrt(max(0.0, K[3])), half)
    sign = -1.0 if f2 < 0.0 else 1.0
    return _times_power(_deviation(K, -f1 / hypotenuse, sign, -f3 / hypotenuse), half)


def finite_slope(x: float, cosine: float, step: float) -> float:
    """Return the slope of asin at x = |F2| / P in [0, 1] over one standard uncertainty, ``step``: root mean square of
    the two chords. cosine = sqrt(1 - x^2) is more precise than x. At x = 1 it is about step ** -0.5."""
    if step < SMALLEST_STEP:
        return 1.0 / max(cosine, SMALLEST_COSINE)
    inward = _arc(x, cosine, -min(step, 1.0 + x))
    outward = _arc(x, cosine, min(step, cosine * cosine / (1.0 + x)))
    return sqrt(0.5 * (inward * inward + outward * outward)) / step


def scaled_covariance(cov: "Six") -> "ScaledCovariance | None":
    """Return (K, half) with cov = K 2^(2 half): variances at most 1. None for NaN and infinity."""
    check = 0.0
    for value in cov:
        check += value - value
    if check != 0.0:
        return None
    half = (frexp(max(cov[0], cov[3], cov[5], 0.0))[1] + 1) // 2
    k11, k12, k13, k22, k23, k33 = cov
    down = -2 * half
    K = (ldexp(k11, down), ldexp(k12, down), ldexp(k13, down), ldexp(k22, down), ldexp(k23, down), ldexp(k33, down))
    return K, half


def _deviation(K: "Six", g1: float, g2: float, g3: float) -> float:
    """Return sqrt(g K g), or zero if rounding makes an exactly known combination negative."""
    k11, k12, k13, k22, k23, k33 = K
    variance = g1 * (k11 * g1 + 2.0 * (k12 * g2 + k13 * g3)) + g2 * (k22 * g2 + 2.0 * k23 * g3) + g3 * k33 * g3
    return sqrt(max(0.0, variance))


def _worst_deviation(K: "Six") -> float:
    """Return the largest standard deviation of (F1, F3) along any direction of their plane."""
    k11, _, k13, _, _, k33 = K
    difference = 0.5 * (k11 - k33)
    return sqrt(max(0.0, 0.5 * (k11 + k33) + sqrt(difference * difference + k13 * k13)))


def _arc(x: float, cosine: float, step: float) -> float:
    """Return |asin(x + step) - asin(x)| from the chord between two points of the unit circle: no cancellation."""
    other = sqrt(max(0.0, cosine * cosine - step * (2.0 * x + step)))
    total = cosine + other
    ratio = (2.0 * x + step) / total if total > 0.0 else 0.0
    return 2.0 * asin(min(1.0, 0.5 * abs(step) * sqrt(1.0 + ratio * ratio)))


def _times_power(value: float, exponent: int) -> float:
    """Return value 2^exponent in two steps: infinity or zero where one step would raise."""
    first = exponent // 2
    return value * ldexp(1.0, first) * ldexp(1.0, exponent - first)
