"""Force to contact: round trips, range, tangency, misses; the status byte."""

import math
import re
from collections.abc import Callable
from functools import partial
from math import inf, isnan, nan, pi, radians

import numpy as np
import pytest
from bench.coverage import miss_uncertainties, status
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.sensor.contact import scalar, scalar_uncertainty
from tipforce.sensor.contact.estimate import contacts, force_from_strain, force_vector, standard_uncertainties
from tipforce.sensor.contact.validity import check_limits
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix

SMALL = 4.0 * np.spacing(pi)
"""A few units in the last place of an angle near pi."""

FORCE = st.one_of(
    st.floats(min_value=-1e300, max_value=1e300),
    st.floats(min_value=-1.0, max_value=1.0),
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 5e-324, 1e-300, 1e300, nan, inf, -inf]),
)
LIMITS = (0.2, 0.1, 0.0, 180.0)
ANGLES = scalar.UNKNOWN_PHI | scalar.UNKNOWN_THETA
GOOD = scalar.CONTACT_PRESENT | scalar.CALIBRATED
LOAD = st.sampled_from([0.0, 0.05, 0.0999999, 0.1, 0.15, 0.1999999, 0.2, 0.5, nan])
Covariance = tuple[float, float, float, float, float, float]


def turn(difference_rad: object) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """The size of an angle difference, whole turns taken out."""
    return np.abs(np.remainder(np.asarray(difference_rad, dtype=np.float64) + pi, 2 * pi) - pi)


@pytest.mark.parametrize("P", [1e-300, 1e-160, 1e-3, 4.4, 1e160, 1e300])
@pytest.mark.parametrize("pull", [True, False])
def test_round_trip_over_the_whole_range(P: float, pull: bool) -> None:
    theta, delta = np.meshgrid(np.radians(np.arange(-179, 181)), np.radians(np.arange(-80, 81, 4)))
    phi = theta + delta if pull else theta + delta + pi
    found = contacts(force_vector(P, phi, theta), pull=pull)
    np.testing.assert_allclose(found.P_newtons, P, rtol=4e-16)
    assert turn(found.phi_rad - phi).max() < 3 * SMALL
    assert turn(found.theta_rad - theta).max() < 10 * SMALL  # 1 / cos(80 degrees) is 5.8
    assert turn(found.delta_rad - (phi - theta)).max() < 10 * SMALL
    assert not found.miss_newtons.any()
    assert np.all(np.cos(found.delta_rad) > 0) if pull else np.all(np.cos(found.delta_rad) < 0)


@settings(max_examples=400, derandomize=True, deadline=None)
@given(st.tuples(FORCE, FORCE, FORCE), st.booleans())
def test_scalar_is_the_array_formula(F: tuple[float, float, float], pull: bool) -> None:
    one, many = scalar.contact(*F, pull), contacts(np.array([F]), pull=pull)
    np.testing.assert_allclose(many.P_newtons[0], one[0], rtol=4e-16)
    np.testing.assert_allclose(many.miss_newtons[0], one[3], rtol=4e-16)
    for found, expected in ((many.phi_rad[0], one[1]), (many.theta_rad[0], one[2])):
        assert isnan(found) if isnan(expected) else turn(found - expected) <= SMALL
        assert isnan(expected) or -pi < expected <= pi
        assert isnan(found) or -pi < found <= pi


def test_estimate_from_strain_takes_offset_and_tare() -> None:
    rng = np.random.default_rng(4)
    theta, phi = rng.uniform(0.3, 2.8, 50), rng.uniform(0.5, 2.5, 50)
    F = force_vector(4.4, phi, theta)
    pull = np.cos(phi - theta) > 0
    for gauges in ("I", ("L", "R", "T", "U", "K_H")):
        A, C = strain_matrix(FABRICATED, gauges), calibration_matrix(FABRICATED, gauges)
        offset, tare = rng.normal(size=len(A)) * 1e-5, np.array([0.1, -0.2, 0.3])
        V = (F + tare) @ A.T + offset
        found = force_from_strain(C, V, offset, tare)
        np.testing.assert_allclose(found, F, atol=1e-11)
        assert turn(contacts(found, pull=True).theta_rad - theta)[pull].max() < 1e-8
    V[7, 1] = nan
    assert np.flatnonzero(np.isnan(force_from_strain(C, V)).any(axis=1)).tolist() == [7]


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (partial(contacts, [1.0, 2.0], pull=True), "F has the shape (2,): allowed is (..., 3)"),
        (partial(force_vector, np.ones(2), np.ones(3), 0.0), "broadcast"),
        (partial(force_from_strain, np.ones((3, 3, 1)), np.ones(3)), "C has"),
        (partial(force_from_strain, np.ones((4, 3)), np.ones(3)), "C has"),
        (partial(force_from_strain, np.ones((3, 4)), np.ones(3)), "strain has"),
        (partial(force_from_strain, np.ones((3, 3)), np.ones(3), np.ones(2)), "offset_strain has"),
        (partial(force_from_strain, np.ones((3, 3)), np.ones(3), 0.0, np.ones(2)), "tare_newtons has"),
        (partial(check_limits, (0.1, 0.2, 0.0, 180.0)), "contact_off_newtons = 0.2"),
        (partial(check_limits, (nan, 0.2, 0.0, 180.0)), "contact_off_newtons"),
        (partial(check_limits, (0.2, 0.1, 180.0, 0.0)), "theta_min_deg = 180.0"),
    ],
)
def test_errors(call: Callable[[], object], text: str) -> None:
    with pytest.raises(InputError, match=re.escape(text)):
        call()


def bits(
    P: float = 1.0,
    u_P: float = 0.01,
    u_theta: float = 0.01,
    miss: float = 0.0,
    u_miss: float = 0.01,
    theta: float = 1.0,
    was_present: bool = False,
    limits: tuple[float, float, float, float] = LIMITS,
) -> int:
    return scalar.status_bits(P, u_P, u_theta, miss, u_miss, theta, limits, was_present)


@pytest.mark.parametrize(
    ("P", "was_present", "present"),
    [(0.2, False, True), (0.199, False, False), (0.1, True, True), (0.0999, True, False), (nan, True, False)],
)
def test_hysteresis(P: float, was_present: bool, present: bool) -> None:
    assert bool(bits(P=P, was_present=was_present) & scalar.CONTACT_PRESENT) is present


def test_theta_is_unresolved_by_its_uncertainty_or_a_small_load() -> None:
    assert not bits(u_theta=radians(29.9)) & scalar.THETA_UNRESOLVED
    for found in (bits(u_theta=radians(30.1)), bits(u_theta=nan), bits(u_theta=inf), bits(u_P=nan)):
        assert found == scalar.CONTACT_PRESENT | scalar.THETA_UNRESOLVED
    assert bits(P=0.09) == scalar.THETA_UNRESOLVED
    assert bits(theta=nan) & scalar.THETA_UNRESOLVED
    assert bits(P=nan, theta=nan, miss=nan) == scalar.THETA_UNRESOLVED


def test_a_load_misses_the_tip_only_beyond_its_uncertainty() -> None:
    assert not bits(miss=0.0299) & scalar.MISSES_TIP
    assert bits(miss=0.0301) == scalar.CONTACT_PRESENT | scalar.MISSES_TIP
    # A tangential load without any noise may miss by rounding.
    assert not bits(miss=1e-15, u_miss=0.0) & scalar.MISSES_TIP
    assert bits(miss=1e-5, u_miss=0.0) & scalar.MISSES_TIP


@pytest.mark.parametrize(
    ("theta_deg", "pad", "outside"),
    [
        (0.0, (0.0, 180.0), False), (-1e-9, (0.0, 180.0), False), (180.0, (0.0, 180.0), False),
        (-0.01, (0.0, 180.0), True), (-90.0, (0.0, 180.0), True), (29.0, (30.0, 150.0), True),
        (151.0, (30.0, 150.0), True), (-170.0, (150.0, 210.0), False), (-140.0, (150.0, 210.0), True),
        (-100.0, (-120.0, 30.0), False), (100.0, (-180.0, 180.0), False), (-179.9, (0.0, 360.0), False),
    ],
)  # fmt: skip
def test_pad(theta_deg: float, pad: tuple[float, float], outside: bool) -> None:
    found = bits(theta=radians(theta_deg), limits=(0.2, 0.1, *pad))
    assert found == scalar.CONTACT_PRESENT | (scalar.OUTSIDE_PAD if outside else 0)


def test_the_pad_is_judged_only_where_theta_is_known() -> None:
    assert bits(theta=-1.0) & scalar.OUTSIDE_PAD
    for found in (bits(theta=-1.0, P=0.15), bits(theta=-1.0, u_theta=1.0), bits(theta=-1.0, miss=1.0)):
        assert not found & scalar.OUTSIDE_PAD


@pytest.mark.parametrize(
    ("status_byte", "expected"),
    [
        (GOOD, 0),
        (GOOD | scalar.OUTSIDE_PAD, 0),
        (GOOD | scalar.THETA_UNRESOLVED, scalar.UNKNOWN_THETA),
        (GOOD | scalar.MISSES_TIP, scalar.UNKNOWN_THETA),
        (scalar.CALIBRATED, ANGLES),
        (scalar.CONTACT_PRESENT, scalar.UNKNOWN_FORCE | ANGLES),
        (GOOD | scalar.SATURATED, scalar.UNKNOWN_FORCE | ANGLES),
        (GOOD | scalar.STALE, scalar.UNKNOWN_FORCE | ANGLES | scalar.UNKNOWN_GAUGES),
        (GOOD | scalar.FRONT_END_FAULT, scalar.UNKNOWN_FORCE | ANGLES | scalar.UNKNOWN_GAUGES),
        (0, scalar.UNKNOWN_FORCE | ANGLES),
    ],
)
def test_what_a_status_makes_unknown(status_byte: int, expected: int) -> None:
    assert scalar.unknown(status_byte) == expected


def test_saturation_takes_nothing_where_the_other_gauges_suffice() -> None:
    assert scalar.unknown(GOOD | scalar.SATURATED, rank_left_is_3=True) == 0
    uncalibrated = scalar.CONTACT_PRESENT | scalar.SATURATED
    assert scalar.unknown(uncalibrated, rank_left_is_3=True) == scalar.UNKNOWN_FORCE | ANGLES


@settings(max_examples=100, derandomize=True, deadline=None)
@given(st.lists(st.tuples(LOAD, st.floats(-pi, pi), st.floats(-2.0, 2.0)), max_size=30), st.booleans())
def test_arrays_repeat_the_scalar_sample_by_sample(loads: list[tuple[float, float, float]], start: bool) -> None:
    F = np.array([(P * np.sin(phi), P * x, P * np.cos(phi)) for P, phi, x in loads]).reshape(-1, 3)
    covariance = 1e-4 * np.eye(3)
    found, u = contacts(F, pull=False), standard_uncertainties(F, covariance, pull=False)
    u_miss = miss_uncertainties(F, covariance)
    present, expected = start, []
    for k in range(len(F)):
        one = scalar.status_bits(
            float(found.P_newtons[k]), float(u[k, 0]), float(u[k, 2]), float(found.miss_newtons[k]), float(u_miss[k]),
            float(found.theta_rad[k]), LIMITS, present,
        )  # fmt: skip
        present = bool(one & scalar.CONTACT_PRESENT)
        expected.append(one)
    assert status(found, u, u_miss, LIMITS, start).tolist() == expected


@settings(max_examples=400)
@given(
    st.floats(-1, 1), st.floats(-math.pi, math.pi), st.floats(-15, 6), st.floats(-6, 1), st.integers(0, 1 << 32),
    st.booleans(),
)  # fmt: skip
def test_what_is_clearly_resolved_is_resolved(
    sine: float, phi: float, exponent: float, noise: float, seed: int, pull: bool
) -> None:
    P = 10.0**exponent
    root = np.random.default_rng(seed).normal(size=(3, 3)) * P * 10.0**noise
    matrix = root @ root.T
    cov: Covariance = tuple(matrix[np.triu_indices(3)].tolist())
    F1, F2, F3 = P * math.sin(phi), P * sine, P * math.cos(phi)
    found, *_ = scalar.contact(F1, F2, F3, pull)
    _, _, u_theta = scalar_uncertainty.uncertainty(F1, F2, F3, cov, pull)
    if scalar.clearly_resolved(found, F2, cov):
        assert math.degrees(u_theta) < scalar.THETA_RESOLVED_DEG


def test_a_good_sensor_is_clearly_resolved_and_numbers_that_are_none_never() -> None:
    cov: Covariance = (1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)
    assert scalar.clearly_resolved(1.0, 0.7, cov)
    assert not scalar.clearly_resolved(1.0, 1.0, cov)
    assert not scalar.clearly_resolved(0.0, 0.0, cov)
    assert not scalar.clearly_resolved(math.nan, 0.0, cov)
    assert not scalar.clearly_resolved(1.0, 0.0, (math.nan, 0.0, 0.0, 1e-6, 0.0, 1e-6))
    assert not scalar.clearly_resolved(1.0, math.inf, cov)
