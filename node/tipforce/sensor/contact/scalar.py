"""Contact of one sample on the MicroPython subset: force to contact, and status; estimate.py has arrays. NaN or
infinity in gives NaN out. F1 = P sin(phi), F2 = P sin(phi - theta), F3 = P cos(phi): equation (16)."""

from math import atan2, frexp, ldexp, pi, sqrt

TYPE_CHECKING = False
if TYPE_CHECKING:
    ScaledForce = tuple[float, float, float, float, float, float, float, int]

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
    counts as tangential, P = (hypot + |F2|) / 2. Full precision from 1e-300 to 1e300 N."""
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
