"""The status byte: each bit, hysteresis, what is unknown; what the node computes alone: condition number, bound."""

from __future__ import annotations

import math
from math import inf, nan, pi, radians

import numpy as np
import pytest
from bench.coverage import miss_uncertainties, status
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.estimate import check_limits, contacts, standard_uncertainties
from tipforce.sensor.contact.scalar import (
    CALIBRATED,
    CONTACT_PRESENT,
    FRONT_END_FAULT,
    MISSES_TIP,
    OUTSIDE_PAD,
    SATURATED,
    STALE,
    THETA_UNRESOLVED,
    UNKNOWN_FORCE,
    UNKNOWN_GAUGES,
    UNKNOWN_PHI,
    UNKNOWN_THETA,
    status_bits,
    unknown,
)
from tipforce.sensor.contact.scalar_condition import condition_number

LIMITS = (0.2, 0.1, 0.0, 180.0)
ANGLES = UNKNOWN_PHI | UNKNOWN_THETA
GOOD = CONTACT_PRESENT | CALIBRATED


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
    return status_bits(P, u_P, u_theta, miss, u_miss, theta, limits, was_present)


def test_a_clear_contact_sets_its_bit_alone() -> None:
    assert bits() == CONTACT_PRESENT


@pytest.mark.parametrize(
    ("P", "was_present", "present"),
    [(0.2, False, True), (0.199, False, False), (0.1, True, True), (0.0999, True, False), (nan, True, False)],
)
def test_hysteresis(P: float, was_present: bool, present: bool) -> None:
    assert bool(bits(P=P, was_present=was_present) & CONTACT_PRESENT) is present


def test_theta_is_unresolved_by_its_uncertainty_or_a_small_load() -> None:
    assert not bits(u_theta=radians(29.9)) & THETA_UNRESOLVED
    for found in (bits(u_theta=radians(30.1)), bits(u_theta=nan), bits(u_theta=inf), bits(u_P=nan)):
        assert found == CONTACT_PRESENT | THETA_UNRESOLVED
    assert bits(P=0.09) == THETA_UNRESOLVED
    assert bits(theta=nan) & THETA_UNRESOLVED
    assert bits(P=nan, theta=nan, miss=nan) == THETA_UNRESOLVED


def test_a_load_misses_the_tip_only_beyond_its_uncertainty() -> None:
    assert not bits(miss=0.0299) & MISSES_TIP
    assert bits(miss=0.0301) == CONTACT_PRESENT | MISSES_TIP
    # A tangential load without any noise may miss by rounding.
    assert not bits(miss=1e-15, u_miss=0.0) & MISSES_TIP
    assert bits(miss=1e-5, u_miss=0.0) & MISSES_TIP


@pytest.mark.parametrize(
    ("theta_deg", "pad", "outside"),
    [
        (0.0, (0.0, 180.0), False),
        (-1e-9, (0.0, 180.0), False),
        (180.0, (0.0, 180.0), False),
        (-0.01, (0.0, 180.0), True),
        (-90.0, (0.0, 180.0), True),
        (29.0, (30.0, 150.0), True),
        (151.0, (30.0, 150.0), True),
        (-170.0, (150.0, 210.0), False),
        (-140.0, (150.0, 210.0), True),
        (-100.0, (-120.0, 30.0), False),
        (100.0, (-180.0, 180.0), False),
        (-179.9, (0.0, 360.0), False),
    ],
)
def test_pad(theta_deg: float, pad: tuple[float, float], outside: bool) -> None:
    found = bits(theta=radians(theta_deg), limits=(0.2, 0.1, *pad))
    assert found == CONTACT_PRESENT | (OUTSIDE_PAD if outside else 0)


def test_the_pad_is_judged_only_where_theta_is_known() -> None:
    assert bits(theta=-1.0) & OUTSIDE_PAD
    for found in (bits(theta=-1.0, P=0.15), bits(theta=-1.0, u_theta=1.0), bits(theta=-1.0, miss=1.0)):
        assert not found & OUTSIDE_PAD


@pytest.mark.parametrize(
    ("status_byte", "expected"),
    [
        (GOOD, 0),
        (GOOD | OUTSIDE_PAD, 0),
        (GOOD | THETA_UNRESOLVED, UNKNOWN_THETA),
        (GOOD | MISSES_TIP, UNKNOWN_THETA),
        (CALIBRATED, ANGLES),
        (CONTACT_PRESENT, UNKNOWN_FORCE | ANGLES),
        (GOOD | SATURATED, UNKNOWN_FORCE | ANGLES),
        (GOOD | STALE, UNKNOWN_FORCE | ANGLES | UNKNOWN_GAUGES),
        (GOOD | FRONT_END_FAULT, UNKNOWN_FORCE | ANGLES | UNKNOWN_GAUGES),
        (0, UNKNOWN_FORCE | ANGLES),
    ],
)
def test_what_a_status_makes_unknown(status_byte: int, expected: int) -> None:
    assert unknown(status_byte) == expected


def test_saturation_takes_nothing_where_the_other_gauges_suffice() -> None:
    assert unknown(GOOD | SATURATED, rank_left_is_3=True) == 0
    assert unknown(CONTACT_PRESENT | SATURATED, rank_left_is_3=True) == UNKNOWN_FORCE | ANGLES


def test_bits_are_the_positions_of_the_status_byte() -> None:
    names = (
        CONTACT_PRESENT, CALIBRATED, SATURATED, STALE, THETA_UNRESOLVED, MISSES_TIP, OUTSIDE_PAD, FRONT_END_FAULT,
    )  # fmt: skip
    assert names == tuple(1 << bit for bit in range(8))


LOAD = st.sampled_from([0.0, 0.05, 0.0999999, 0.1, 0.15, 0.1999999, 0.2, 0.5, nan])


@settings(max_examples=100, derandomize=True, deadline=None)
@given(st.lists(st.tuples(LOAD, st.floats(-pi, pi), st.floats(-2.0, 2.0)), max_size=30), st.booleans())
def test_arrays_repeat_the_scalar_sample_by_sample(loads: list[tuple[float, float, float]], start: bool) -> None:
    F = np.array([(P * np.sin(phi), P * x, P * np.cos(phi)) for P, phi, x in loads]).reshape(-1, 3)
    covariance = 1e-4 * np.eye(3)
    found, u = contacts(F, pull=False), standard_uncertainties(F, covariance, pull=False)
    u_miss = miss_uncertainties(F, covariance)
    present, expected = start, []
    for k in range(len(F)):
        one = status_bits(
            float(found.P_newtons[k]), float(u[k, 0]), float(u[k, 2]), float(found.miss_newtons[k]), float(u_miss[k]),
            float(found.theta_rad[k]), LIMITS, present,
        )  # fmt: skip
        present = bool(one & CONTACT_PRESENT)
        expected.append(one)
    assert status(found, u, u_miss, LIMITS, start).tolist() == expected


def test_errors() -> None:
    for limits, name in (
        ((0.1, 0.2, 0.0, 180.0), "contact_off_newtons = 0.2"),
        ((nan, 0.2, 0.0, 180.0), "contact_off_newtons"),
        ((0.2, 0.1, 180.0, 0.0), "theta_min_deg = 180.0"),
    ):
        with pytest.raises(InputError, match=name):
            check_limits(limits)
    assert scalar.MISS_COVERAGE_FACTOR == 3.0


REAL32 = st.floats(-1e6, 1e6, width=32)


@settings(derandomize=True, max_examples=300, deadline=None)
@given(st.integers(3, 8).flatmap(lambda n: st.lists(st.lists(REAL32, min_size=n, max_size=n), min_size=3, max_size=3)))
def test_agrees_with_numpy(rows: list[list[float]]) -> None:
    singular = np.linalg.svd(np.array(rows, dtype=np.float64), compute_uv=False)
    found = condition_number(rows)
    if singular[0] == 0.0:
        assert found == math.inf
    elif singular[-1] <= 1e-13 * singular[0]:
        # Here numpy's own smallest singular value is rounding noise; either way the matrix is refused.
        assert found > 1e12
    else:
        expected = singular[0] / singular[-1]
        assert found == pytest.approx(expected, rel=1e-12 + 1e-14 * expected)


@pytest.mark.parametrize("exponent", range(11))
@pytest.mark.parametrize("n", [3, 8])
def test_known_singular_values(exponent: int, n: int) -> None:
    rng = np.random.default_rng(100 * exponent + n)
    left = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    right = np.linalg.qr(rng.normal(size=(n, n)))[0][:3]
    rows = left @ np.diag([1.0, 10.0 ** (-exponent / 2), 10.0**-exponent]) @ right
    assert condition_number(rows.tolist()) == pytest.approx(10.0**exponent, rel=1e-14 * 10.0**exponent + 1e-12)


@pytest.mark.parametrize("scale", [1e-38, 1e-20, 1.0, 1e20, 3e38])
def test_does_not_depend_on_the_scale(scale: float) -> None:
    rows = [[scale * value for value in row] for row in ([4.0, 1.0, 0.0], [1.0, 3.0, 1.0], [0.0, 1.0, 2.0])]
    assert condition_number(rows) == pytest.approx(np.linalg.cond([[4, 1, 0], [1, 3, 1], [0, 1, 2]]), rel=1e-12)


@pytest.mark.parametrize(
    "rows",
    [
        [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.0, 1.0]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]],
        [[1e-45, 0.0, 0.0], [0.0, 3e38, 0.0], [0.0, 3e38, 0.0]],
    ],
)
def test_singular_matrix_has_no_usable_condition_number(rows: list[list[float]]) -> None:
    assert condition_number(rows) > 1e15


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_element_not_finite_gives_nan(value: float) -> None:
    for k in range(9):
        flat = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        flat[k] = value
        assert math.isnan(condition_number([flat[0:3], flat[3:6], flat[6:9]]))


Covariance = tuple[float, float, float, float, float, float]


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
    _, _, u_theta = scalar.uncertainty(F1, F2, F3, cov, pull)
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
