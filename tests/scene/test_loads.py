"""Loads over time: knots, straight lines, steps, and the vectorised form that the errors are taken with."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tipforce.scene import schema
from tipforce.scene.loads import LoadHistory, load_history
from tipforce.scene.results import applied_at
from tipforce.sensor.calibration.simulation import paper_grooves
from tipforce.sensor.contact.estimate import force_vector

NUMBERS = st.floats(-1e3, 1e3, allow_subnormal=False)


def test_lines_between_knots_and_steps_at_them() -> None:
    load = LoadHistory([(1.0, 0.0, 0.0, 0.0), (2.0, 4.0, 10.0, 20.0), (2.0, 1.0, 0.0, 0.0), (3.0, 1.0, 0.0, 0.0)])
    assert load.at(0.0) == (0.0, 0.0, 0.0)
    assert load.at(1.25) == (1.0, 2.5, 5.0)
    assert load.at(2.0) == (1.0, 0.0, 0.0)
    assert load.at(9.0) == (1.0, 0.0, 0.0)
    assert not load.constant


@given(st.lists(st.tuples(st.integers(0, 20), NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=8), st.data())
def test_the_vectorised_form_is_the_same(knots: list[tuple[int, float, float, float]], data: st.DataObject) -> None:
    load = LoadHistory(sorted(((0.25 * t, P, phi, theta) for t, P, phi, theta in knots), key=lambda knot: knot[0]))
    times = data.draw(st.lists(st.floats(-1.0, 7.0), min_size=1, max_size=20)) + [knot[0] for knot in load.knots]
    expected = np.array([load.at(t) for t in times])
    np.testing.assert_allclose(applied_at(load, np.array(times)), expected, rtol=1e-12, atol=1e-9)


def test_the_force_is_equation_16() -> None:
    load = LoadHistory([(0.0, 2.5, -70.0, 100.0)])
    expected = force_vector(2.5, math.radians(-70.0), math.radians(100.0))
    np.testing.assert_allclose(load.force(3.0), expected, rtol=1e-15)


def test_the_grooves_are_the_papers() -> None:
    load = load_history(schema.Grooves(P_N=4.4, dwell_s=0.1, change_s=0.03), 1)
    assert load is not None
    grooves = paper_grooves()
    found = [load.at(0.01 + 0.13 * k + 0.05) for k in range(19)]
    expected = [
        (4.4, float(phi), float(theta))
        for phi, theta in zip(np.degrees(grooves.phi_rad), np.degrees(grooves.theta_rad), strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert [load.at(0.13 * k + 0.125)[0] for k in range(19)] == [0.0] * 19


def test_a_grasp_gives_each_finger_its_own() -> None:
    fingers = (
        schema.Finger(node=1, P_N=2.0, phi_deg=-90, theta_deg=80),
        schema.Finger(node=2, P_N=1.0, phi_deg=-80, theta_deg=90, delay_s=0.1),
    )
    grasp = schema.Grasp(fingers=fingers, start_s=0.5, close_s=0.2, hold_s=1.0, open_s=0.4)
    one, two = (load_history(grasp, node_id) for node_id in (1, 2))
    assert one is not None
    assert two is not None
    assert load_history(grasp, 3) is None
    assert [one.at(t)[0] for t in (0.5, 0.7, 1.7, 2.1)] == pytest.approx([0.0, 2.0, 2.0, 0.0])
    assert one.at(0.6) == pytest.approx((1.0, -90.0, 80.0))
    assert two.at(0.7) == pytest.approx((0.5, -80.0, 90.0))


def test_taps_rise_and_fall() -> None:
    load = load_history(schema.Tap(P_N=5.0, at_s=(0.2, 0.1), phi_deg=0, theta_deg=0, rise_ms=1, fall_ms=3), 1)
    assert load is not None
    assert [load.at(t)[0] for t in (0.05, 0.1, 0.1005, 0.101, 0.1025, 0.104, 0.15, 0.201, 0.3)] == pytest.approx(
        [0.0, 0.0, 2.5, 5.0, 2.5, 0.0, 0.0, 5.0, 0.0]
    )
