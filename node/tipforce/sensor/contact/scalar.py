"""Contact of one sample on the MicroPython subset: force to contact, uncertainty, status; estimate.py has arrays. NaN
or infinity in gives NaN out. F1 = P sin(phi), F2 = P sin(phi - theta), F3 = P cos(phi): equation (16)."""

from math import asin, atan2, frexp, ldexp, pi, sqrt

TYPE_CHECKING = False
if TYPE_CHECKING:
    ScaledForce = tuple[float, float, float, float, float, float, float, int]
    ScaledCovariance = tuple[tuple[float, float, float, float, float, float], int]

NAN = float("nan")
TWO_PI = 2.0 * pi
DEGREES = 180.0 / pi

# The status byte. Bits 0, 4, 5, 6 come from status_bits(); the reader of the gauges sets the others.
CONTACT_PRESENT = 0x01
CALIBRATED = 0x02
SATURATED = 0x04
STALE = 0x08
THETA_UNRESOLVED = 0x10
MISSES_TIP = 0x20
OUTSIDE_PAD = 0x40
FRONT_END_FAULT = 0x80
_ALL_KNOWN = CONTACT_PRESENT | CALIBRATED | OUTSIDE_PAD

# Values that a status byte marks unknown.
UNKNOWN_FORCE = 0x01  # F1, F2, F3 and P
UNKNOWN_PHI = 0x02
UNKNOWN_THETA = 0x04
UNKNOWN_GAUGES = 0x08

MISS_COVERAGE_FACTOR = 3.0  # standard uncertainties by which |F2| must exceed P before the load misses the tip
MISS_FLOOR = 1e-6  # times P: rounding of single-precision coefficients, which is not in the noise covariance
THETA_RESOLVED_DEG = 30.0  # largest standard uncertainty with which theta still counts as resolved
CLEARLY_RESOLVED = 0.5  # radians, 28.6 degrees
ROOT_2 = 1.4143  # no less
SMALLEST_STEP = 1e-30  # noise over load below which an angle counts as exactly known
SMALLEST_COSINE = 1e-15  # sqrt(SMALLEST_STEP): keeps slopes, and their squares in single precision, finite
PAD_SLACK_DEG = 1e-4  # rounding of theta in single precision must not push a contact off the edge of the pad


def contact(F1: float, F2: float, F3: float, pull: bool) -> tuple[float, float, float, float]:
    """Return (P, phi, theta, miss), newtons and radians in (-pi, pi], NaN for F1 = F3 = 0. pull selects one of the two
    points where the line of action meets the tip. miss is the excess of |F2| over hypot(F1, F3): above 0 the contact
    counts as tangential, P = (hypot + |F2|) / 2. Full precision from 1e-300 to 1e300 N.
    """
    return contact_of(scaled_force(F1, F2, F3), pull)


def contact_of(force: "ScaledForce | None", pull: bool) -> tuple[float, float, float, float]:
    """Return contact() of a scaled_force()."""
    if force is None:
        return NAN, NAN, NAN, NAN
    F1, F3, _f1, f2, _f3, hypotenuse, cosine_squared, exponent = force
    # One factor less than the exponent: the largest floats would overflow in 2 ** exponent.
    unit = ldexp(1.0, exponent - 1) if exponent else 0.5
    if cosine_squared >= 0.0:
        P, miss, cosine = 2.0 * hypotenuse * unit, 0.0, sqrt(cosine_squared)
    else:
        excess = -cosine_squared / (abs(f2) + hypotenuse)
        P, miss, cosine = (2.0 * hypotenuse + excess) * unit, 2.0 * excess * unit, 0.0
    if F1 == 0.0 and F3 == 0.0:
        return P, NAN, NAN, miss
    # Adding zero turns -0.0 into 0.0, which keeps atan2 away from -pi.
    phi = atan2(F1 + 0.0, F3)
    if phi <= -pi:
        phi = pi
    theta = phi - atan2(f2, cosine if pull else -cosine)
    if theta > pi:
        theta -= TWO_PI
    elif theta <= -pi:
        theta += TWO_PI
    return P, phi, theta, miss


def uncertainty(
    F1: float, F2: float, F3: float, cov: tuple[float, float, float, float, float, float], pull: bool
) -> tuple[float, float, float]:
    """Return the standard uncertainties (u_P, u_phi, u_theta). cov: upper triangle (11, 12, 13, 22, 23, 33) of the
    covariance of F, N^2. First order, J cov J^T, but finite_slope() for 1 / |cos(delta)|, which grows without bound
    near a tangential contact (the real spread of theta stays near SNR ** -0.5). F1 = F3 = 0: worst u_P, angles NaN.
    """
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


def magnitude_uncertainty(
    F1: float, F2: float, F3: float, cov: tuple[float, float, float, float, float, float]
) -> float:
    """Return u_P of uncertainty() alone, bit for bit, for a third of the work: the angles cost the rest."""
    force, covariance = scaled_force(F1, F2, F3), scaled_covariance(cov)
    if force is None or covariance is None:
        return NAN
    _F1, _F3, f1, _f2, f3, hypotenuse, _cosine_squared, _exponent = force
    K, half = covariance
    if hypotenuse == 0.0:
        return _times_power(_worst_deviation(K), half)
    return _times_power(_deviation(K, f1 / hypotenuse, 0.0, f3 / hypotenuse), half)


def clearly_resolved(P: float, F2: float, cov: tuple[float, float, float, float, float, float]) -> bool:
    """Return True where a bound shows that u_theta is below THETA_RESOLVED_DEG: a sixth of the work of uncertainty().
    False, for NaN too, says nothing."""
    # s^2 = trace: the step of x = |F2| / P is at most sqrt(2) s / P, u_theta at most s / P (1 + sqrt(2) slope there).
    trace = cov[0] + cov[3] + cov[5]
    if not (trace > SMALLEST_STEP and P > 0.0):
        return False
    u = sqrt(trace) / P
    end = abs(F2) / P + ROOT_2 * u
    return end < 1.0 and u * (1.0 + ROOT_2 / sqrt(1.0 - end * end)) < CLEARLY_RESOLVED


def miss_uncertainty(F1: float, F2: float, F3: float, cov: tuple[float, float, float, float, float, float]) -> float:
    """Return the standard uncertainty of |F2| - hypot(F1, F3) in newtons; cov as in uncertainty(). Needed only for a
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


def status_bits(
    P: float,
    u_P: float,
    u_theta: float,
    miss: float,
    u_miss: float,
    theta: float,
    limits: tuple[float, float, float, float],
    was_present: bool,
) -> int:
    """Return the bits CONTACT_PRESENT, THETA_UNRESOLVED, MISSES_TIP, OUTSIDE_PAD (of a contact with neither). NaN is no
    contact, in theta or u unresolved. limits: contact-on >= contact-off, N, theta minimum <= maximum, degrees."""
    on, off, theta_min_deg, theta_max_deg = limits
    bits = 0
    if P >= (off if was_present else on):
        bits = CONTACT_PRESENT
    resolved = P >= off and u_P >= 0.0 and u_theta * DEGREES <= THETA_RESOLVED_DEG and -pi <= theta <= pi
    if not resolved:
        bits |= THETA_UNRESOLVED
    if miss > MISS_COVERAGE_FACTOR * u_miss + MISS_FLOOR * P:
        bits |= MISSES_TIP
    if bits == CONTACT_PRESENT:
        past_start_deg = (theta * DEGREES - theta_min_deg + PAD_SLACK_DEG) % 360.0
        if past_start_deg > theta_max_deg - theta_min_deg + 2.0 * PAD_SLACK_DEG:
            bits |= OUTSIDE_PAD
    return bits


def unknown(status: int, rank_left_is_3: bool = False) -> int:
    """Return the values that a status byte makes unknown, as bits UNKNOWN_FORCE, _PHI, _THETA and _GAUGES.
    rank_left_is_3: the unsaturated gauges determined all three forces; SATURATED then makes no value unknown."""
    if status | OUTSIDE_PAD == _ALL_KNOWN:
        return 0
    bits = 0
    if status & (STALE | FRONT_END_FAULT):
        bits = UNKNOWN_GAUGES | UNKNOWN_FORCE | UNKNOWN_PHI | UNKNOWN_THETA
    if not status & CALIBRATED or (status & SATURATED and not rank_left_is_3):
        bits |= UNKNOWN_FORCE | UNKNOWN_PHI | UNKNOWN_THETA
    if not status & CONTACT_PRESENT:
        bits |= UNKNOWN_PHI | UNKNOWN_THETA
    if status & (THETA_UNRESOLVED | MISSES_TIP):
        bits |= UNKNOWN_THETA
    return bits


def scaled_force(F1: float, F2: float, F3: float) -> "ScaledForce | None":
    """Return (F1, F3, f1, f2, f3, hypotenuse, cosine squared, exponent) with F = f 2^exponent; None for NaN, infinity.
    Scaled by a power of two, squares neither over- nor underflow; hypotenuse is that of f1 and f3."""
    f1, f2, f3, exponent = F1, F2, F3, 0
    a1, a2, a3 = abs(F1), abs(F2), abs(F3)
    if not 1e-9 < a1 + a2 + a3 < 1e9:  # else, nearly always, the squares are within single precision as they are
        if (F1 - F1) + (F2 - F2) + (F3 - F3) != 0.0:  # true for NaN and infinity only
            return None
        exponent = frexp(max(a1, a2, a3))[1]
        f1, f2, f3 = ldexp(F1, -exponent), ldexp(F2, -exponent), ldexp(F3, -exponent)
        a1, a2, a3 = abs(f1), abs(f2), abs(f3)
    large, small = (a1, a3) if a1 > a3 else (a3, a1)
    hypotenuse = sqrt(large * large + small * small)
    # P^2 - F2^2 in factors: no digit is lost where small is tiny, half of the digits at most elsewhere.
    return F1, F3, f1, f2, f3, hypotenuse, (large - a2) * (large + a2) + small * small, exponent


def scaled_covariance(cov: tuple[float, float, float, float, float, float]) -> "ScaledCovariance | None":
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


def _deviation(K: tuple[float, float, float, float, float, float], g1: float, g2: float, g3: float) -> float:
    """Return sqrt(g K g), or zero if rounding makes an exactly known combination negative."""
    k11, k12, k13, k22, k23, k33 = K
    variance = g1 * (k11 * g1 + 2.0 * (k12 * g2 + k13 * g3)) + g2 * (k22 * g2 + 2.0 * k23 * g3) + g3 * k33 * g3
    return sqrt(max(0.0, variance))


def _worst_deviation(K: tuple[float, float, float, float, float, float]) -> float:
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
