"""Force -> contact: round trips, range, tangency, misses; the scalar and the array formula held together."""

from __future__ import annotations

from math import atan2, inf, isnan, nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.estimate import contacts, estimate, force_from_strain, force_vector
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import calibration_matrix, strain_matrix

SMALL = 4.0 * np.spacing(pi)
"""A few units in the last place of an angle near pi."""


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


def test_load_sense_selects_the_point_where_the_line_of_action_cuts() -> None:
    F = force_vector(2.0, 0.3, 0.1)
    pulled, pushed = contacts(F, pull=True), contacts(F, pull=False)
    assert pulled.theta_rad == pytest.approx(0.1)
    assert pulled.phi_rad == pushed.phi_rad == pytest.approx(0.3)
    assert pushed.theta_rad == pytest.approx(0.3 - (pi - 0.2))


@pytest.mark.parametrize("scale", [1e-300, 1.0, 1e300])
def test_a_line_of_action_that_misses_is_projected_and_measured(scale: float) -> None:
    for F2, pull in ((1.5, True), (-1.5, True), (1.5, False), (-1.5, False)):
        P, phi, theta, miss = scalar.contact(0.6 * scale, F2 * scale, 0.8 * scale, pull)
        assert pytest.approx(1.25 * scale, rel=1e-15) == P
        assert miss == pytest.approx(0.5 * scale, rel=1e-15)
        assert abs(phi - atan2(0.6, 0.8)) < SMALL
        assert turn(phi - theta - (pi / 2 if F2 > 0 else -pi / 2)) < SMALL


FORCE = st.one_of(
    st.floats(min_value=-1e300, max_value=1e300),
    st.floats(min_value=-1.0, max_value=1.0),
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 5e-324, 1e-300, 1e300, nan, inf, -inf]),
)


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


@settings(max_examples=300, derandomize=True, deadline=None)
@given(st.tuples(FORCE, FORCE, FORCE), st.booleans())
def test_the_contact_explains_the_force(F: tuple[float, float, float], pull: bool) -> None:
    found = contacts(F, pull=pull)
    if not np.isfinite(found.theta_rad) or found.miss_newtons > 0:
        return
    back = force_vector(found.P_newtons, found.phi_rad, found.theta_rad)
    np.testing.assert_allclose(back, F, rtol=0, atol=3e-15 * float(found.P_newtons))


def test_shapes_are_kept() -> None:
    assert contacts(np.ones((4, 5, 3)), pull=True).theta_rad.shape == (4, 5)
    assert contacts(np.ones((0, 3)), pull=True).theta_rad.shape == (0,)
    assert force_vector(np.ones((4, 1)), 0.0, np.ones(5)).shape == (4, 5, 3)


def test_estimate_from_strain_takes_offset_and_tare() -> None:
    rng = np.random.default_rng(4)
    theta, phi = rng.uniform(0.3, 2.8, 50), rng.uniform(0.5, 2.5, 50)
    F = force_vector(4.4, phi, theta)
    pull = np.cos(phi - theta) > 0
    for gauges in ("I", ("L", "R", "T", "U", "K_H")):
        A, C = strain_matrix(FABRICATED, gauges), calibration_matrix(FABRICATED, gauges)
        offset, tare = rng.normal(size=len(A)) * 1e-5, np.array([0.1, -0.2, 0.3])
        V = (F + tare) @ A.T + offset
        found_F, found = estimate(C, V, offset, tare, pull=True)
        np.testing.assert_allclose(found_F, F, atol=1e-11)
        assert turn(found.theta_rad - theta)[pull].max() < 1e-8
    V[7, 1] = nan
    assert np.flatnonzero(np.isnan(force_from_strain(C, V)).any(axis=1)).tolist() == [7]


def test_shape_errors() -> None:
    with pytest.raises(InputError, match=r"F has the shape \(2,\): allowed is \(\.\.\., 3\)"):
        contacts([1.0, 2.0], pull=True)
    with pytest.raises(InputError, match="broadcast"):
        force_vector(np.ones(2), np.ones(3), 0.0)
    for C, strain, offset, tare, name in (
        (np.ones((3, 3, 1)), np.ones(3), 0.0, 0.0, "C has"),
        (np.ones((4, 3)), np.ones(3), 0.0, 0.0, "C has"),
        (np.ones((3, 4)), np.ones(3), 0.0, 0.0, "strain has"),
        (np.ones((3, 3)), np.ones(3), np.ones(2), 0.0, "offset_strain has"),
        (np.ones((3, 3)), np.ones(3), 0.0, np.ones(2), "tare_newtons has"),
    ):
        with pytest.raises(InputError, match=name):
            force_from_strain(C, strain, offset, tare)
