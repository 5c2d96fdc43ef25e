"""Extreme contacts: vanishing, enormous and broken loads, tangential ones, and those that miss the tip."""

import math
from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np

from fingertip import finger as rig
from stability.case import Observed
from tipforce.sensor.contact import estimate, scalar
from tipforce.sensor.contact.estimate import force_vector

_SMALLEST = 5e-324
_EPSILON = 2.0**-52


def contact_no_load() -> Observed:
    """F = 0 exactly -> flagged: P is 0 and phi and theta are unknown, on the host and in the node's PDO"""
    found = estimate.contacts(np.zeros(3), pull=False)
    node = rig.finger().sync()
    angles_unknown = bool(np.isnan(found.phi_rad) and np.isnan(found.theta_rad))
    held = float(found.P_newtons) == 0.0 and angles_unknown and node.contact == (0, rig.UNKNOWN, rig.UNKNOWN)
    return held, f"P = {float(found.P_newtons):g} N, phi {found.phi_rad}, node {node.contact}"


def contact_denormal_load() -> Observed:
    """|F| from 5e-324 to 1e-308 N, below what floats hold with full precision -> bounded: the angles are those of F
    times 2^1060, to rounding; P is off by at most one smallest float"""
    rng = np.random.default_rng(1)
    F = np.round(rng.uniform(-1.0, 1.0, (2000, 3)) * 10.0 ** rng.uniform(0.0, 15.0, (2000, 1))) * _SMALLEST
    small, large = estimate.contacts(F, pull=True), estimate.contacts(np.ldexp(F, 1060), pull=True)
    worst = float(np.nanmax(np.abs([small.phi_rad - large.phi_rad, small.theta_rad - large.theta_rad])))
    same = worst <= 4.0 * _EPSILON and np.array_equal(np.isnan(small.theta_rad), np.isnan(large.theta_rad))
    P_off = np.abs(small.P_newtons / _SMALLEST - np.ldexp(large.P_newtons, -1060 + 1074)).max()
    return bool(same and P_off <= 1.0), f"angles off by {worst:.1e} radian; P by {P_off:.2g} smallest floats"


def contact_magnitudes() -> Observed:
    """|F| from 1e-300 to 1e300 N, 1000 of 20000 directions -> pass: P and |F2| - P equal exact arithmetic within 4
    units in the last place of the larger force"""
    rng = np.random.default_rng(2)
    F = rng.standard_normal((20000, 3)) * 10.0 ** rng.uniform(-300.0, 299.0, (20000, 1))
    found = estimate.contacts(F, pull=False)
    worst = 0.0 if np.isfinite([found.P_newtons, found.miss_newtons]).all() else math.inf
    for row, P, miss in zip(F[::20].tolist(), found.P_newtons[::20].tolist(), found.miss_newtons[::20].tolist(),
                            strict=True):  # fmt: skip
        if not worst < math.inf:
            break
        hypotenuse, exact_miss = _exact(*row)
        exact_P = hypotenuse + exact_miss / 2
        unit = Fraction(max(map(abs, row))) * Fraction(_EPSILON)
        worst = max(worst, float(abs(Fraction(P) - exact_P) / unit), float(abs(Fraction(miss) - exact_miss) / unit))
    return worst <= 4.0, f"worst error {worst:.2f} units in the last place"


def contact_overflow() -> Observed:
    """P = 2.4e308 N, beyond the largest float -> flagged: P is infinite, never a wrong number, and both angles are
    right"""
    F = np.array([1.7e308, 1.0e308, 1.7e308])
    found, small = estimate.contacts(F, pull=True), estimate.contacts(np.ldexp(F, -600), pull=True)
    angles = float(found.phi_rad) == float(small.phi_rad) and float(found.theta_rad) == float(small.theta_rad)
    P = float(found.P_newtons)
    return math.inf == P and angles, f"P = {P:g} N, angles as of F / 2^600: {angles}"


def contact_not_finite() -> Observed:
    """NaN or an infinity in one of F1, F2, F3, among 1000 good rows -> flagged: all five results of that row are NaN,
    the others change by rounding at most, no exception"""
    F = np.random.default_rng(3).standard_normal((1009, 3))
    good = estimate.contacts(F, pull=False)
    spoilt = F.copy()
    for k in range(9):
        spoilt[100 * k, k % 3] = (math.nan, math.inf, -math.inf)[k // 3]
    found = estimate.contacts(spoilt, pull=False)
    bad = np.zeros(1009, dtype=np.bool_)
    bad[:900:100] = True
    names = ("P_newtons", "phi_rad", "theta_rad", "delta_rad", "miss_newtons")
    unknown = all(np.isnan(getattr(found, name)[bad]).all() for name in names)
    # The last bit of numpy 1.26's arctan2 depends on the places of its operands in memory.
    pairs = [(getattr(found, name)[~bad], getattr(good, name)[~bad]) for name in names]
    same = all(np.allclose(one, other, rtol=1e-15, atol=0.0) for one, other in pairs)
    node = all(
        math.isnan(value) for row in spoilt[bad].tolist() for value in scalar.contact(row[0], row[1], row[2], False)
    )
    return unknown and same and node, f"unknown: {unknown}, node's formula: {node}, others unchanged: {same}"


def contact_exactly_tangential() -> Observed:
    """|F2| = P exactly: (3, 5, 4) N times 2^-1000 to 2^1000, both signs -> pass: theta is phi -+ 90 degrees to
    rounding, the load counts as on the tip"""
    scales = np.ldexp(1.0, np.arange(-1000, 1001, 100))[:, np.newaxis]
    worst, missed = 0.0, 0.0
    for sign in (1.0, -1.0):
        for pull in (True, False):
            found = estimate.contacts(np.array([3.0, sign * 5.0, 4.0]) * scales, pull=pull)
            right = math.atan2(3.0, 4.0) - sign * 0.5 * math.pi
            worst = max(worst, float(np.abs(found.theta_rad - right).max()))
            missed = max(missed, float(found.miss_newtons.max()))
    return worst <= 2.0 * _EPSILON and missed == 0.0, f"theta off by {worst:.1e} radian, miss {missed:g} N"


def contact_nearly_tangential() -> Observed:
    """|F2| = P (1 - 2^-k), k to 52, force along an axis -> pass: the angle to the normal keeps all digits: P^2 - F2^2
    is computed in factors"""
    worst = 0.0
    for k in range(1, 53):
        F2 = 1.0 - 2.0**-k
        for F in ((1.0, F2, 0.0), (0.0, F2, 1.0), (1.0, F2, 2.0**-60), (-(2.0**-30), F2, -1.0)):
            found = estimate.contacts(F, pull=True)
            exact = math.atan2(F2, _exact_cosine(*F))
            worst = max(worst, abs(float(found.delta_rad) / exact - 1.0), _cosine_error(found, F))
    return worst <= 8.0 * _EPSILON, f"worst relative error {worst:.1e} of delta and of 90 degrees - delta"


def _cosine_error(found: estimate.Contact, F: tuple[float, float, float]) -> float:
    """Return the relative error of pi/2 - delta without a difference of rounded numbers: by the sine of the gap."""
    exact = _exact_cosine(*F) / math.hypot(F[0], F[2])
    # delta itself is rounded to 1 unit of 1.57: the gap cannot be known better than that.
    return max(0.0, abs(math.cos(float(found.delta_rad)) - exact) - 2.0 * _EPSILON) / max(exact, _EPSILON)


def contact_nearly_tangential_oblique() -> Observed:
    """|F2| = P (1 - 2^-k), k to 50, oblique force -> bounded: theta is off by at most 3e-8 radian: the root of
    rounding, no clamp"""
    rng = np.random.default_rng(4)
    worst = 0.0
    for k in range(1, 51):
        for phi in rng.uniform(-3.0, 3.0, 20).tolist():
            F1, F3 = math.sin(phi), math.cos(phi)
            F2 = (1.0 - 2.0**-k) * math.hypot(F1, F3)
            found = estimate.contacts((F1, F2, F3), pull=True)
            worst = max(worst, abs(float(found.delta_rad) - math.atan2(F2, _exact_cosine(F1, F2, F3))))
    return worst <= 3e-8, f"worst error of delta {worst:.1e} radian"


def contact_misses_tip() -> Observed:
    """line of action passes the tip: |F2| = 1.5 P, by 500 standard uncertainties -> flagged: status bit 5 is set and
    theta is unknown; P and phi stay"""
    finger = rig.finger()
    finger.source.forces = lambda _now_us: (0.6, 1.5, -0.8)
    found = finger.sync()
    P, phi, theta = found.contact
    right_phi = round(math.degrees(math.atan2(0.6, -0.8)) * 100)
    held = bool(found.status & scalar.MISSES_TIP) and theta == rig.UNKNOWN and (P, phi) == (1250, right_phi)
    return held, f"status {found.status:02X}h, P {P} mN, phi {phi / 100:g} degrees, theta unknown"


def contact_only_F2() -> Observed:
    """F1 = F3 = 0 and F2 = 1 N: a force without direction -> flagged: P is the projection F2 / 2 and both angles are
    unknown"""
    found = estimate.contacts((0.0, 1.0, 0.0), pull=False)
    P, phi, theta, miss = scalar.contact(0.0, -1.0, 0.0, True)
    held = (float(found.P_newtons), float(found.miss_newtons), P, miss) == (0.5, 1.0, 0.5, 1.0)
    held &= bool(np.isnan(found.phi_rad) and np.isnan(found.theta_rad)) and math.isnan(phi) and math.isnan(theta)
    return held, f"P {P:g} N, miss {miss:g} N, phi {phi}, theta {theta}"


def contact_angle_wrap() -> Observed:
    """phi and theta at +-180 degrees, and within 1e-13 degrees of it -> pass: angles lie in (-180, 180] and jump by one
    turn only; the PDO shows 180.00, never -180.00"""
    beside = np.concatenate(([0.0], 10.0 ** np.arange(-15.0, 0.0)))
    turn = np.concatenate((math.pi - beside, beside - math.pi))
    phi, theta = (grid.ravel() for grid in np.meshgrid(turn, turn))
    F = force_vector(1.0, phi, theta)
    found = estimate.contacts(np.concatenate((F, [[-0.0, 0.0, -1.0], [0.0, -0.0, -1.0]])), pull=True)
    inside = all(bool(((a > -math.pi) & (a <= math.pi)).all()) for a in (found.phi_rad, found.theta_rad))
    off = max(float(np.abs(np.sin(found.phi_rad[:-2] - phi)).max()),
              float(np.abs(np.sin(found.theta_rad[:-2] - theta)).max()))  # fmt: skip
    shown = [rig.finger(load=(1.0, angle, 10.0)).sync().contact[1] for angle in (180.0, 179.9999, -179.9999)]
    held = inside and off <= 1e-14 and shown == [18000] * 3
    return held, f"inside: {inside}, off by {off:.1e} radian, node shows {shown}"


def contact_node_agrees() -> Observed:
    """10000 loads of any size, 1000 of them tangential within 1e-12 -> pass: the node's formulas give the host's
    numbers, within 8 units in the last place"""
    rng = np.random.default_rng(5)
    F = rng.standard_normal((10000, 3)) * 10.0 ** rng.uniform(-290.0, 290.0, (10000, 1))
    near = F[:1000]
    near[:, 1] = np.hypot(near[:, 0], near[:, 2]) * (1.0 + 1e-12 * rng.standard_normal(1000))
    worst = 0.0
    for pull in (True, False):
        found = estimate.contacts(F, pull=pull)
        ours = np.array([scalar.contact(a, b, c, pull) for a, b, c in F.tolist()])
        theirs = np.stack((found.P_newtons, found.phi_rad, found.theta_rad, found.miss_newtons), axis=-1)
        size = np.stack((found.P_newtons, np.ones(10000), np.ones(10000), found.P_newtons), axis=-1)
        worst = max(worst, float((np.abs(ours - theirs) / size).max()))
    return worst <= 8.0 * _EPSILON, f"largest difference {worst:.1e}, relative to P and 1 radian"


def _exact(F1: float, F2: float, F3: float) -> tuple[Fraction, Fraction]:
    """Return hypot(F1, F3) and the excess of |F2| over it, to 60 digits."""
    with localcontext() as context:
        context.prec = 60
        square = Fraction(F1) ** 2 + Fraction(F3) ** 2
        root = Fraction((Decimal(square.numerator) / Decimal(square.denominator)).sqrt())
    return root, max(Fraction(0), abs(Fraction(F2)) - root)


def _exact_cosine(F1: float, F2: float, F3: float) -> float:
    """P cos(delta) = sqrt(F1^2 + F3^2 - F2^2), the radicand without any rounding."""
    square = Fraction(F1) ** 2 + Fraction(F3) ** 2 - Fraction(F2) ** 2
    with localcontext() as context:
        context.prec = 60
        return float((Decimal(square.numerator) / Decimal(square.denominator)).sqrt()) if square > 0 else 0.0
