"""Extreme uncertainties: none, enormous, beyond the range of squares, and near a tangential contact."""

import math

import numpy as np
from bench.coverage import miss_uncertainties, status

from fingertip import finger as rig
from stability.case import Observed, refusal
from tipforce.arrays import FloatArray
from tipforce.dictionary import indices
from tipforce.sensor.contact import estimate, scalar, scalar_uncertainty, validity
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.contact.redundancy import weighted_inverse

_DRAWS = 40_000
_LIMITS = (0.05, 0.02, -180.0, 180.0)


def uncertainty_no_noise() -> Observed:
    """covariance of F exactly 0, load oblique, and exactly tangential -> pass: u of P, phi and theta are 0, not NaN,
    and theta counts as resolved"""
    F, nothing = np.array([[0.3, 0.1, -0.9], [3.0, 5.0, 4.0]]), np.zeros((3, 3))
    u = estimate.standard_uncertainties(F, nothing, pull=False)
    node = [scalar_uncertainty.uncertainty(a, b, c, (0.0,) * 6, False) for a, b, c in F.tolist()]
    bits = status(estimate.contacts(F, pull=False), u, miss_uncertainties(F, nothing), _LIMITS)
    held = not u.any() and not np.isnan(u).any() and node == [(0.0, 0.0, 0.0)] * 2
    return held and bits.tolist() == [1, 1], f"u {u.ravel().tolist()}, status {bits.tolist()}"


def uncertainty_enormous_noise() -> Observed:
    """noise of 1e-6 to 1e6 times the load -> flagged: u_theta grows with the noise; from 30 degrees on status bit 4 is
    set, on host and node alike"""
    F = force_vector(1.0, math.radians(175.0), math.radians(10.0))
    noise = 10.0 ** np.arange(-6.0, 7.0, 0.5)
    u = np.array([estimate.standard_uncertainties(F, s * s * np.eye(3), pull=False) for s in noise])
    found = estimate.contacts(np.tile(F, (len(noise), 1)), pull=False)
    bit_4 = status(found, u, np.zeros(len(noise)), _LIMITS) & scalar.THETA_UNRESOLVED != 0
    f1, f2, f3 = F.tolist()
    node = []
    for variance in (noise * noise).tolist():
        covariance = variance, 0.0, 0.0, variance, 0.0, variance
        u_P, _, u_theta = scalar_uncertainty.uncertainty(f1, f2, f3, covariance, False)
        bits = scalar.status_bits(1.0, u_P, u_theta, 0.0, 0.0, 0.1, _LIMITS, True)
        node.append(bool(bits & scalar.THETA_UNRESOLVED))
    grows = bool((np.diff(u[:, 2]) > 0.0).all())
    first = float(noise[np.argmax(bit_4)])
    # First order for this load: u_theta = 1.41 s / P. From about 0.37 N on it is 30 degrees.
    held = grows and bit_4.tolist() == node and bit_4[noise >= 1.0].all() and not bit_4[noise <= 0.1].any()
    return bool(held), f"bit 4 from {first:g} N noise on 1 N, u_theta up to {u[-1, 2]:.2g} radian"


def uncertainty_node_enormous_noise() -> Observed:
    """a node whose gauge noise is 100 times the load -> flagged: status bit 4 is set, theta is unknown, 2107h has u_P;
    2123h is at its limit, 65.534 N"""
    sigma = 100.0 * 1e-4  # strain: 100 N
    finger = rig.finger(load=rig.PUSH, calibrated=rig.record(noise_strain=sigma))
    found, u_P = finger.sync(), finger.get("f", indices.UNCERTAINTY, 1)
    flagged = bool(found.status & scalar.THETA_UNRESOLVED) and found.contact[2] == rig.UNKNOWN
    held = flagged and abs(u_P / 100.0 - 1.0) < 1e-5 and finger.get("H", indices.U_P) == 65534
    return held, f"status {found.status:02X}h, u_P {u_P:g} N, 2123h at its end of {65.534} N"


def uncertainty_scale() -> Observed:
    """F and its standard deviations times 2^-800 to 2^500: squares out of range -> pass: relative uncertainties do not
    change, to rounding"""
    rng = np.random.default_rng(6)
    F, B = rng.standard_normal((200, 3)), 0.05 * rng.standard_normal((3, 3))
    one = estimate.standard_uncertainties(F, B @ B.T, pull=False)
    worst = 0.0
    for power in (-800, -500, -100, 100, 500):
        with np.errstate(under="ignore"):
            covariance = np.ldexp(B @ B.T, 2 * power)
        scaled = estimate.standard_uncertainties(np.ldexp(F, power), covariance, pull=False)
        scaled[:, 0] = np.ldexp(scaled[:, 0], -power)
        worst = max(worst, float(np.abs(scaled / one - 1.0).max())) if abs(power) <= 500 else worst
        if power == -800:  # the covariance underflows to 0: u must be 0, not NaN
            worst = max(worst, float(np.abs(scaled).max()))
    return worst <= 1e-12, f"largest relative change {worst:.1e}"


def uncertainty_not_finite() -> Observed:
    """NaN or infinity in F or in its covariance -> flagged: all three uncertainties are NaN, and theta is unresolved"""
    good = 1e-6 * np.eye(3)
    unknown = []
    for bad in (math.nan, math.inf, -math.inf):
        for k in range(3):
            F, K = np.array([0.1, 0.2, -0.9]), good.copy()
            F[k], K[k, k] = bad, bad
            unknown.append(np.isnan(estimate.standard_uncertainties(F, good, pull=False)).all())
            unknown.append(np.isnan(estimate.standard_uncertainties([0.1, 0.2, -0.9], K, pull=False)).all())
    bits = scalar.status_bits(1.0, math.nan, math.nan, 0.0, 0.0, 0.1, _LIMITS, True)
    held = bool(all(unknown)) and bool(bits & scalar.THETA_UNRESOLVED)
    return held, f"{sum(map(bool, unknown))} of {len(unknown)} all NaN; status {bits:02X}h"


def uncertainty_tangential() -> Observed:
    """P cos(delta) from 0 to 0.3 N at a noise of 1 mN: |F2| = P included -> bounded: u_theta is within a factor of 1.5
    of a Monte Carlo of 40000 draws, where first order is infinite"""
    ratios = []
    for cosine in (0.0, 1e-3, 0.01, 0.03, 0.1, 0.3):
        F = np.array([0.6, math.sqrt(1.0 - cosine * cosine), 0.8])
        ratios.append(float(estimate.standard_uncertainties(F, 1e-6 * np.eye(3), pull=False)[2]) / _spread(F, 1e-3))
    held = all(1.0 / 1.5 <= ratio <= 1.5 for ratio in ratios)
    return held, "u_theta over Monte Carlo: " + ", ".join(f"{ratio:.3f}" for ratio in ratios)


def _spread(F: FloatArray, sigma: float, seed: int = 7) -> float:
    """Return the root mean square deviation of theta from its true value under noise."""
    draws = F + sigma * np.random.default_rng(seed).standard_normal((_DRAWS, 3))
    true = float(estimate.contacts(F, pull=False).theta_rad)
    off = estimate.contacts(draws, pull=False).theta_rad - true
    off = (off + math.pi) % (2.0 * math.pi) - math.pi
    return float(np.sqrt(np.mean(off * off)))


def uncertainty_tangential_flag() -> Observed:
    """the same loads, noise from 0.1 mN to 0.3 N -> flagged: where u_theta passes 30 degrees bit 4 is set; where the
    slope bends by a quarter first_order_holds() says no"""
    wrong, flagged, warned = 0, 0, 0
    for cosine in (0.0, 0.01, 0.1, 0.3):
        F = np.array([[0.6, math.sqrt(1.0 - cosine * cosine), 0.8]])
        for sigma in (1e-4, 1e-3, 1e-2, 0.1, 0.3):
            K = sigma * sigma * np.eye(3)
            u = estimate.standard_uncertainties(F, K, pull=False)
            bits = status(estimate.contacts(F, pull=False), u, miss_uncertainties(F, K), _LIMITS)
            large = bool(u[0, 2] > math.radians(30.0))
            bit_4, holds = bool(bits[0] & scalar.THETA_UNRESOLVED), bool(validity.first_order_holds(F, K)[0, 2])
            # The curvature of asin over one standard uncertainty: u(x) / cos^2, u(x) = sigma sqrt(1 + x^2) here.
            bend = sigma * math.sqrt(2.0 - cosine * cosine) / max(cosine * cosine, 1e-300)
            wrong += bit_4 != large or holds != (bend <= 0.25)
            flagged, warned = flagged + bit_4, warned + (not holds)
    held = wrong == 0 and 0 < flagged < warned < 20
    return held, f"of 20: bit 4 in {flagged}, first order refused in {warned}, {wrong} disagree"


def uncertainty_first_order() -> Observed:
    """1000 random loads at 1 to 20 % noise -> bounded: where first_order_holds(), u_theta is within 15 % of a Monte
    Carlo; elsewhere it says no"""
    rng = np.random.default_rng(8)
    draws = rng.standard_normal((4000, 3))
    worst, holding = 0.0, 0
    for _ in range(1000):
        delta, phi, sigma = rng.uniform(-1.5, 1.5), rng.uniform(-3.0, 3.0), 10.0 ** rng.uniform(-2.0, -0.7)
        F = force_vector(1.0, phi, phi - delta + math.pi)
        K = sigma * sigma * np.eye(3)
        if not validity.first_order_holds(F, K)[2]:
            continue
        holding += 1
        theta = estimate.contacts(np.vstack((F, F + sigma * draws)), pull=False).theta_rad
        off = (theta[1:] - theta[0] + math.pi) % (2.0 * math.pi) - math.pi
        ratio = float(estimate.standard_uncertainties(F, K, pull=False)[2] / np.sqrt(np.mean(off * off)))
        worst = max(worst, abs(ratio - 1.0))
    held = worst <= 0.15 and 100 < holding < 900
    return held, f"{holding} of 1000 hold; u_theta off by at most {worst:.1%}"


def uncertainty_missing_by_noise() -> Observed:
    """|F2| above P by 0 to 6 standard uncertainties -> bounded: bit 5 is set from 3 standard uncertainties on, not
    before: noise alone sets it at most in 0.14 %"""
    bits = []
    for k in range(25):
        u = 0.01
        bits.append(bool(scalar.status_bits(1.0, u, 0.1, 0.25 * k * u, u, 0.1, _LIMITS, True) & scalar.MISSES_TIP))
    rng = np.random.default_rng(9)
    F = np.array([0.6, 1.0, 0.8]) + 0.01 * rng.standard_normal((200_000, 3))
    found = estimate.contacts(F, pull=False)
    rate = float(np.mean(found.miss_newtons > 3.0 * miss_uncertainties(F, 1e-4 * np.eye(3))))
    held = bits == [0.25 * k > 3.0 for k in range(25)] and rate < 0.002
    return held, f"first set at {0.25 * bits.index(True):g} u; tangential load at noise: {rate:.2%}"


def uncertainty_impossible_covariance() -> Observed:
    """host: a covariance with a negative variance for n > 3 gauges -> refused: InputError says that it is not positive
    definite"""
    A = np.array(rig.strain_per_newton(4))
    said = refusal(weighted_inverse, A, np.diag([1e-14, -1e-14, 1e-14, 1e-14]))
    return "not positive definite" in said, said.split(":")[0]
