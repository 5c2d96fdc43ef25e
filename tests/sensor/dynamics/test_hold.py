"""The held step: 60-digit arithmetic, linearity, energy; impacts: closed forms, other integrators, the slit."""

import math
from decimal import Decimal, localcontext
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from stability.case import energy
from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import Hold, at_rest, hold, respond
from tipforce.sensor.dynamics.model import Modes, half_cylinder, modes
from tipforce.sensor.structure.plane_frame import Frame, closing_load, slit_closure
from tipforce.sensor.structure.strain import FABRICATED
from tipforce_lab.dynamics import integrators
from tipforce_lab.dynamics.impact import Striker, impact, overload
from tipforce_lab.dynamics.switched import slit_stop

DAMPING = [0.0, 0.01, 0.3, 0.999999, 1.0, 1.0000001, 1.4, 1.5000001, 2.0, 50.0]
damping = st.one_of(st.sampled_from(DAMPING), st.floats(0.0, 50.0))
BODY = modes(FABRICATED)
STIFF = modes(FABRICATED, beam_density_kg_m3=7850.0)
F = np.array([1.0, 0.5, -0.3])
steps = st.floats(-9.0, 0.0).map(lambda e: 10.0**e)


def series(x: float, zeta: float) -> Hold:
    """The same integrals by their power series with 60 digits or more: s = sum of c_n x^n / n!."""
    with localcontext() as context:
        context.prec = 80 + int(3.0 * x * (zeta + 1.0))
        X, Z = Decimal(x), Decimal(zeta)
        before, c, power = Decimal(0), Decimal(1), X
        s, step, J = Decimal(0), Decimal(0), Decimal(0)
        n = 1
        while True:
            term = c * power
            s, step, J = s + term, step + term * X / (n + 1), J + term * X * X / ((n + 1) * (n + 2))
            # Without damping every second coefficient is 0.
            if n > 8 and abs(power) * (abs(c) + abs(before)) < Decimal(10) ** -70 * X:
                break
            before, c = c, -2 * Z * c - before
            n += 1
            power = power * X / n
        ramp, mean = J / X, step / X
        values = (1 - step, s, -s, 1 - step - 2 * Z * s, step - ramp, ramp, s - mean, mean)
        return Hold(*(float(value) for value in values))


@pytest.mark.parametrize("zeta", DAMPING)
@pytest.mark.parametrize("x", [1e-12, 1e-9, 1e-4, 0.009, 0.011, 0.3, 0.99, 1.01, 2.5, 7.0, 40.0])
def test_it_equals_the_series_in_long_arithmetic(x: float, zeta: float) -> None:
    x = min(x, 40.0 / (1.0 + zeta))  # the series needs as many digits as terms cancel
    found, wanted = hold(x, zeta), series(x, zeta)
    # What multiplies a position and a velocity of size 1: relative to the row, for the largest entry is the response.
    for name in ("p12", "b11", "b21"):
        a, b = getattr(found, name), getattr(wanted, name)
        assert abs(a - b) <= 4e-14 * max(abs(b), math.exp(-x) * 1e-3 if zeta < 1 else 0.0), name
    for a, b in zip(found, wanted, strict=True):
        assert abs(a - b) <= 2e-15 * max(1.0, x / 8)
    if x <= 1e-4 and zeta <= 2.0:  # short steps keep all digits of the input
        assert found[4:] == pytest.approx(wanted[4:], rel=1e-14)


@settings(max_examples=200, deadline=None)
@given(st.floats(-140.0, 299.0), st.floats(0.0, 1e6))
def test_a_mode_never_gains_energy_by_itself_and_every_weight_is_finite(exponent: float, zeta: float) -> None:
    held = hold(10.0**exponent, zeta)
    assert all(math.isfinite(value) for value in held)
    for start in ((1.0, 0.0), (0.0, 1.0), (0.6, -0.8)):
        assert math.hypot(*advance(held, start, 0.0, 0.0)) <= 1.0 + 1e-13
    assert -1e-13 <= held.b11 <= 1.5


def advance(held: Hold, state: tuple[float, float], g0: float, g1: float) -> tuple[float, float]:
    z, w = state
    return (
        held.p11 * z + held.p12 * w + held.b10 * g0 + held.b11 * g1,
        held.p21 * z + held.p22 * w + held.b20 * g0 + held.b21 * g1,
    )


def test_smooth_loads_converge_with_order_2_to_the_closed_solution() -> None:
    body = BODY.with_damping(0.01)
    errors = []
    for n in (200, 400, 800):
        t = np.linspace(0.0, 0.04, n + 1)
        loads = np.outer(0.5 - 0.5 * np.cos(2.0 * math.pi * t / 0.04), F)
        wanted = integrators.closed_form(body, integrators.Wave(F, 0.5, -0.5, 0.0, 25.0), t)
        errors.append(np.abs(respond(body, loads, 0.04 / n).elastic_newtons - wanted).max())
    assert np.log2(np.array(errors[:-1]) / errors[1:]) == pytest.approx([2.0, 2.0], abs=0.02)


def test_one_sample_and_bad_input() -> None:
    assert respond(BODY, [[1.0, 2.0, 3.0]], 1e-3).elastic_newtons.tolist() == [[0.0, 0.0, 0.0]]
    assert at_rest(STIFF).position.shape == (6,)
    with pytest.raises(InputError, match="loads of shape"):
        respond(BODY, np.zeros((2, 2)), 1e-3)


@pytest.mark.parametrize("exponent", [1.0, 1.5])
@pytest.mark.parametrize("k", [1e5, 1e8])
def test_on_the_structure_an_independent_integrator_agrees_to_1e_10(exponent: float, k: float) -> None:
    # scipy's DOP853 stops at the end of contact; its equation is written out here, not taken from the product.
    striker = Striker(0.01, 0.3, k, exponent, theta_rad=1.0)
    omega, along = BODY.omega_rad_s, BODY.load_shape @ striker.direction

    def rate(_: float, X: np.ndarray[tuple[int], np.dtype[np.float64]]) -> list[float]:
        q, p, overlap = X[:3], X[3:6], max(X[6], 0.0)
        P = k * overlap**exponent
        return [*p, *(along * P - omega**2 * q), X[7] - along @ p, -P / 0.01]

    def parted(_: float, X: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
        return float(X[6])

    parted.terminal, parted.direction = True, -1.0  # type: ignore[attr-defined]
    found = impact(BODY, striker, 0.02)
    duration = found.touches[0].end_s
    assert math.isfinite(duration)
    run = solve_ivp(
        rate, (0.0, 0.02), [0.0] * 7 + [0.3], method="DOP853", events=parted, rtol=2.5e-14,
        atol=[1e-20] * 3 + [1e-17] * 3 + [1e-21, 1e-17], t_eval=[found.touches[0].peak_s], max_step=duration / 200.0,
    )  # fmt: skip
    assert run.t_events[0][0] == pytest.approx(duration, rel=1e-10)
    overlap = run.y[6, 0]
    assert k * overlap**exponent == pytest.approx(found.touches[0].peak_newtons, rel=1e-10)


def test_linear_and_hertz_run_the_same_free_motion_and_samples() -> None:
    times = np.linspace(0.0, 0.01, 41)
    for exponent in (1.0, 1.5):
        striker = Striker(0.01, 0.3, 1e7, exponent)
        dense, alone = impact(BODY, striker, 0.01, times), impact(BODY, striker, 0.01)
        assert dense.touches[0].end_s == pytest.approx(alone.touches[0].end_s, rel=1e-12)
        assert dense.elastic_newtons.shape == (41, 3)
        end = dense.structure.position @ BODY.force_shape.T
        np.testing.assert_allclose(dense.elastic_newtons[-1], end, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(alone.structure.position, dense.structure.position, rtol=1e-9, atol=1e-12)


def test_the_peak_of_a_stiff_impact_is_not_in_the_gauges() -> None:
    found = impact(BODY, Striker(0.01, 0.3, 1e8), 0.02, np.linspace(0.0, 0.02, 401))
    assert found.touches[0].peak_newtons > 20.0 * np.abs(found.elastic_newtons).max()
    # What is in them is the momentum that passed: a short blow J leaves omega J.
    tip, omega = half_cylinder(FABRICATED).mass_kg, BODY.omega_rad_s[1]
    J = 2.0 * 0.3 * 0.01 * tip / (0.01 + tip)
    assert np.abs(found.elastic_newtons).max() == pytest.approx(omega * J, rel=1e-3)


def test_the_finger_against_a_stop_ends_at_rest_pressed() -> None:
    # An unyielding body at constant speed: the contact force rises with the structure's stiffness against the drive.
    found = impact(BODY.with_damping(1.0), Striker(math.inf, 1e-3, 1e6), 0.5, [0.5])
    lift = ((BODY.load_shape.T / BODY.omega_rad_s**2) @ BODY.load_shape)[0, 0]
    series = 1.0 / (lift + 1e-6)
    assert found.touches[0].end_s == math.inf
    # Ramp response: the damper adds 2 zeta / omega of the mode times the tip's share of the speed.
    lag = 2.0 / BODY.omega_rad_s[1] * lift * series
    assert found.contact_newtons[0, 0] == pytest.approx(series * 1e-3 * (0.5 + lag), rel=1e-9)


def test_a_stop_never_reached_changes_nothing() -> None:
    t = np.linspace(0.0, 0.05, 101)
    loads = np.outer(np.sin(60.0 * t), [1.0, 0.3, -0.5])
    body = BODY.with_damping(0.02)
    found = overload(body, slit_stop(FABRICATED, BODY), t, loads)
    assert found.touches == ()
    wanted = respond(body, loads, 5e-4).elastic_newtons
    np.testing.assert_allclose(found.elastic_newtons, wanted, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.vertical_newtons, wanted, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("body", [BODY, STIFF])
def test_overload_at_rest_is_the_static_solution_and_the_vertical_beam_sees_all_of_it(body: Modes) -> None:
    damped = body.with_damping(1.0)
    F = np.array([-50.0, -10.0, 5.0])
    stop = slit_stop(FABRICATED, damped)
    found = overload(damped, stop, [0.0, 0.05, 0.1], np.vstack((0.0 * F, F, F)))
    np.testing.assert_allclose(found.vertical_newtons[-1], F, rtol=0.0, atol=1e-9)
    # Static, by hand: the arms carry F less the stops; a closed stop's overlap is what all forces on its arm yield.
    k = len(stop.fraction) // 2
    x = stop.fraction[:k]
    assert stop.fraction.tolist() == [*x, *x]
    assert 0.0 in x
    s = Frame(FABRICATED).slit_closure(x).reshape(-1, 3)
    N = found.contact_newtons[-1]
    bending = FABRICATED.youngs_modulus_pascals * FABRICATED.width_m * FABRICATED.h1_m**3 / 12.0
    a = FABRICATED.a_m
    for arm in range(2):
        forces = N[arm * k : arm * k + k]
        for j in range(k):
            # A beam with held ends: w(x) = b^2 x^2 (3 y L - x (3 y + b)) / 6 E I L^3 left of a force at y, b = L - y.
            yields = sum(
                force * a**3 * (1 - max(x[j], y)) ** 2 * min(x[j], y) ** 2
                * (3 * max(x[j], y) - min(x[j], y) * (2 * max(x[j], y) + 1)) / (6 * bending)
                for force, y in zip(forces, x, strict=True)
            )  # fmt: skip
            overlap = s[arm * k + j] @ found.elastic_newtons[-1] - 0.25e-3 - yields
            assert (forces[j] == 0.0 and overlap <= 0.0) or overlap == pytest.approx(forces[j] * 1e-7, rel=1e-6)
    assert N.max() > 10.0


def test_the_load_that_closes_the_slit() -> None:
    worst = 0.25e-3 / slit_closure(FABRICATED, 1.0)
    # Straight down, at the side: F1 = F2 = -P presses the right arm's end, whatever F3.
    assert closing_load(FABRICATED, 0.0, 1.5 * math.pi) == pytest.approx(worst, rel=1e-12)
    assert closing_load(FABRICATED, math.pi, 1.5 * math.pi) == pytest.approx(worst, rel=1e-12)
    assert closing_load(FABRICATED, 0.0, math.pi) == math.inf
    assert worst == pytest.approx(15.2, abs=0.05)
    # Straight down, the slit closes at the joint; off to the side, a place between may close long before the ends.
    assert closing_load(FABRICATED, 0.5 * math.pi, 1.5 * math.pi) == pytest.approx(19.44, abs=0.01)
    assert closing_load(FABRICATED, math.radians(60.0), math.radians(155.0)) == pytest.approx(118.3, abs=0.05)
    # Slowly raised, it is also the load at which the stop closes in the simulation.
    P, F = closing_load(FABRICATED, 0.5 * math.pi, 1.5 * math.pi), np.array([-1.0, 0.0, 0.0])
    slow = overload(BODY.with_damping(1.0), slit_stop(FABRICATED, BODY), [0.0, 0.51], np.outer([0.0, 1.02 * P], F))
    lag = 2.0 / BODY.omega_rad_s[1]  # of a critically damped mode behind a ramp
    assert slow.touches[0].begin_s == pytest.approx(0.5 + lag, rel=1e-10)


def test_an_impact_closes_the_slit_and_loses_nothing() -> None:
    stop = slit_stop(FABRICATED, BODY)
    found = impact(BODY, Striker(0.05, 2.0, 1e7), 0.003, slit=stop)
    places = len(stop.fraction) // 2
    assert {0, 1, 1 + places} <= {touch.contact for touch in found.touches}  # the body, and both arms at the joint
    assert all(math.isfinite(touch.end_s) for touch in found.touches)
    total = energy(BODY, found.structure) + 0.5 * 0.05 * found.body_speed_m_s**2
    assert total == pytest.approx(0.5 * 0.05 * 2.0**2, rel=1e-11)
    for place in range(1, 1 + places):
        left, right = ([t for t in found.touches if t.contact == j] for j in (place, place + places))
        assert len(left) == len(right)
    left, right = ([t for t in found.touches if t.contact == j] for j in (1, 1 + places))
    for a, b in zip(left, right, strict=True):  # a blow on the top is symmetric
        assert a.begin_s == pytest.approx(b.begin_s, rel=1e-12)
        assert a.peak_newtons == pytest.approx(b.peak_newtons, rel=1e-9)


def test_runs_out_of_range_are_refused() -> None:
    striker, stop = Striker(0.01, 0.3, 1e6), slit_stop(FABRICATED, BODY)
    for run, text in (
        (partial(impact, BODY, Striker(0.01, 0.3, 1e6, 1.5), 1.0, slit=stop), "Hertzian"),
        (partial(impact, None, striker, 1.0, slit=stop), "rigid ground"),
        (partial(impact, None, Striker(math.inf, 0.3, 1e6, 1.5), 1.0), "stop on rigid ground"),
        (partial(overload, BODY, stop, [0.0, 0.0], np.zeros((2, 3))), "rise strictly"),
        (partial(overload, BODY, stop, [0.0, 1.0], np.full((2, 3), math.inf)), "finite"),
    ):
        with pytest.raises(InputError, match=text):
            run()
