"""The error budget: each cause propagated analytically, against the thing itself simulated."""

from collections.abc import Callable
from dataclasses import replace
from math import pi

import numpy as np
import pytest

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.contact.estimate import contacts, force_vector
from tipforce.sensor.structure.off_axis import PlacedGauge, off_axis_wrenches, planar_part, wrench_strain_matrix
from tipforce.sensor.structure.strain import FABRICATED, GaugePosition, position_matrix
from tipforce_lab.design import error_budget
from tipforce_lab.design.error_budget import DEGREE, Causes, Loads, Sensor, budget, elementary_errors

Draw = Callable[[np.random.Generator], FloatArray]

# Inside the beams, so that a gauge may shift both ways.
POSITIONS = (GaugePosition("H", "left", 2e-3), GaugePosition("H", "right", 2e-3), GaugePosition("V", "right", 13e-3))
A = position_matrix(FABRICATED, list(POSITIONS))
C: FloatArray = np.asarray(np.linalg.inv(A), dtype=np.float64)
COVARIANCE = 1e-12 * np.array([[1.0, 0.5, 0.0], [0.5, 2.0, 0.0], [0.0, 0.0, 0.5]])
SENSOR = Sensor(C, A, COVARIANCE, False, True, FABRICATED, POSITIONS)
LOADS = Loads(np.full(3, 2.0), np.radians([200.0, 262.0, 310.0]), np.radians([50.0, 90.0, 110.0]))
CAUSES = Causes()
HUNG = error_budget.groove_loads()
EVERY_LOAD = np.meshgrid(np.linspace(0.0, 2.0 * pi, 181), np.linspace(0.0, 2.0 * pi, 181))
LARGEST = np.abs(force_vector(1.0, *EVERY_LOAD).reshape(-1, 3) @ A.T).max(axis=0)  # gauge, load of 1 N


def contact_error(F: FloatArray) -> FloatArray:
    """Errors of P, phi, theta, (m, 3, 3), of estimates F (m, 3, 3) at LOADS."""
    found = contacts(F, pull=False)
    angles = [found.phi_rad - LOADS.phi_rad, found.theta_rad - LOADS.theta_rad]
    turned = [np.remainder(angle + pi, 2 * pi) - pi for angle in angles]
    return np.stack([found.P_newtons - LOADS.P_newtons, *turned], axis=-1)


def calibrated(hung: Loads, noise: FloatArray | float = 0.0) -> FloatArray:
    """Estimates at LOADS by a real fit to loads that the fit takes for HUNG, tares among them."""
    G = np.column_stack([np.vstack([HUNG.F, np.zeros((19, 3))]), np.ones(38)])
    B = np.linalg.lstsq(G, np.vstack([hung.F, np.zeros((19, 3))]) @ A.T + noise, rcond=None)[0]
    F: FloatArray = (LOADS.F @ A.T - B[3]) @ np.linalg.inv(B[:3].T).T
    return F


STRAINS: dict[str, Callable[[FloatArray, np.random.Generator], FloatArray]] = {
    "gauge noise": lambda V, rng: V + rng.multivariate_normal(np.zeros(3), COVARIANCE),
    "gain": lambda V, rng: V * (1.0 + CAUSES.gain * rng.normal(size=3)),
    "offset": lambda V, rng: V + CAUSES.offset_strain * rng.normal(size=3),
    "temperature, mismatch": lambda V, rng: (
        V + CAUSES.temperature_K * CAUSES.mismatch_strain_per_K * rng.normal(size=3)
    ),
    "hysteresis": lambda V, rng: V + CAUSES.hysteresis * LARGEST * LOADS.P_newtons[:, np.newaxis] * rng.normal(size=3),
    "creep": lambda V, rng: V * float(1.0 + CAUSES.creep * rng.normal()),
}
"""Causes that change what the gauges read, (m, 3)."""


def of_strain(cause: str) -> tuple[str, Draw, int]:
    return cause, lambda rng: STRAINS[cause](LOADS.F @ A.T, rng) @ C.T, 4000


def quantisation(rng: np.random.Generator) -> FloatArray:
    q = CAUSES.resolution_strain
    dither = rng.uniform(-0.5, 0.5, 3)  # the true strain lies anywhere between two steps
    return (np.round(LOADS.F @ A.T / q + dither) - dither) * q @ C.T


def temperature(rng: np.random.Generator) -> FloatArray:
    dT = CAUSES.temperature_K * rng.normal()
    V = LOADS.F @ A.T * (1.0 + CAUSES.sensitivity_per_K * dT) + CAUSES.apparent_strain_per_K * dT
    return V @ C.T


def calibration_noise(rng: np.random.Generator) -> FloatArray:
    return calibrated(HUNG, rng.multivariate_normal(np.zeros(3), COVARIANCE, 38))


def load_angle(rng: np.random.Generator) -> FloatArray:
    return calibrated(replace(HUNG, phi_rad=HUNG.phi_rad + CAUSES.load_angle_rad * rng.normal(size=19)))


def gravity(rng: np.random.Generator) -> FloatArray:
    along_y = np.arange(19) >= 10
    return calibrated(replace(HUNG, phi_rad=HUNG.phi_rad + CAUSES.gravity_rad * rng.normal() * along_y))


def gauge_position(rng: np.random.Generator) -> FloatArray:
    shifts = CAUSES.gauge_shift_m * rng.normal(size=3)
    moved = [place._replace(position_m=place.position_m + s) for place, s in zip(POSITIONS, shifts, strict=True)]
    return LOADS.F @ position_matrix(FABRICATED, moved).T @ C.T


def off_axis(rng: np.random.Generator) -> FloatArray:
    z, angle = CAUSES.lateral_offset_m * rng.normal(size=3), CAUSES.misalignment_rad * rng.normal(size=3)
    placed = [PlacedGauge(place, *errors) for place, *errors in zip(POSITIONS, z, angle, strict=True)]
    matrix = wrench_strain_matrix(FABRICATED, placed)
    V = LOADS.F @ planar_part(FABRICATED, matrix).T
    V = V + CAUSES.off_axis_newtons * off_axis_wrenches(FABRICATED, LOADS.theta_rad) @ matrix.T
    return V @ np.linalg.inv(planar_part(FABRICATED, matrix)).T  # calibrated in the plane as the gauges sit


@pytest.mark.parametrize(
    ("cause", "draw", "draws"),
    [
        *map(of_strain, STRAINS), ("quantisation", quantisation, 4000), ("temperature, common", temperature, 4000),
        ("calibration noise", calibration_noise, 2000),
        ("load angle", load_angle, 2000), ("gravity", gravity, 2000), ("gauge position", gauge_position, 2000),
        ("off-axis load", off_axis, 800),
    ],
)  # fmt: skip
def test_each_cause_is_what_a_simulation_of_it_gives(cause: str, draw: Draw, draws: int) -> None:
    rng = np.random.default_rng(7)
    uncertainties = budget(replace(SENSOR, calibrated=cause != "gauge position"), LOADS, CAUSES).rows[cause]
    spread = np.sqrt(np.mean(contact_error(np.array([draw(rng) for _ in range(draws)])) ** 2, axis=0))
    # Relative error of a standard deviation: 1 / sqrt(2 draws), here four times that.
    np.testing.assert_allclose(uncertainties, spread, rtol=4.0 / np.sqrt(2.0 * draws), atol=3e-6)


def test_one_degree_of_gravity_costs_one_percent_and_one_degree_and_hardly_shows() -> None:
    causes = Causes(gravity_rad=DEGREE)
    loads = error_budget.pad_loads(4.4, 0.0, 180.0, pull=False)
    worst_P, worst_phi, worst_theta = budget(SENSOR, loads, causes).rows["gravity"].max(axis=0)
    assert worst_P / 4.4 == pytest.approx(0.0087, abs=0.0002)  # gamma / 2, at phi = 45 degrees
    assert worst_phi / DEGREE == pytest.approx(1.0, abs=0.01)
    assert worst_theta / DEGREE == pytest.approx(0.79, abs=0.02)
    assert error_budget.gravity_residual(DEGREE) == pytest.approx(0.0022, abs=0.0001)
    # The same from the fit itself.
    F = np.vstack([replace(HUNG, phi_rad=HUNG.phi_rad + DEGREE * (np.arange(19) >= 10)).F, np.zeros((19, 3))])
    G = np.column_stack([np.vstack([HUNG.F, np.zeros((19, 3))]), np.ones(38)])
    residual = (F - G @ np.linalg.lstsq(G, F, rcond=None)[0])[:19]
    assert np.sqrt(np.mean(np.sum(residual**2, axis=1))) / 4.4 == pytest.approx(
        error_budget.gravity_residual(DEGREE), rel=0.02
    )


def test_total_is_the_sum_and_says_where_first_order_holds() -> None:
    found = budget(SENSOR, LOADS, CAUSES)
    squares = np.sum([uncertainties**2 for uncertainties in found.rows.values()], axis=0)
    np.testing.assert_allclose(found.total**2, squares, rtol=1e-3)
    assert found.holds.all()
    assert not found.left_out
    assert not budget(SENSOR, Loads(np.array([2e-3]), np.array([pi]), np.array([0.5])), CAUSES).holds.any()


def test_what_cannot_act_is_zero_and_what_cannot_be_told_has_no_row() -> None:
    assert not budget(SENSOR, LOADS, CAUSES).rows["gauge position"].any()
    theory = budget(replace(SENSOR, calibrated=False), LOADS, CAUSES).rows
    assert theory["gauge position"].all()
    assert not theory["gravity"].any()
    blind = replace(SENSOR, geometry=None, positions=())
    found = budget(blind, LOADS, CAUSES)
    assert list(found.left_out) == ["off-axis load"]
    assert "off-axis load" not in found.rows
    assert list(budget(replace(blind, calibrated=False), LOADS, CAUSES).left_out) == ["gauge position", "off-axis load"]


def test_zero_sizes_give_zero_and_noise_can_be_stated() -> None:
    none = Causes(
        0.0, 0.0, 0.0, 0.0, 0.0, hysteresis=0.0, creep=0.0, load_angle_rad=0.0, gravity_rad=0.0, off_axis_newtons=0.0
    )
    assert not budget(SENSOR, LOADS, none).total.any()
    errors, _ = elementary_errors(SENSOR, LOADS, Causes(noise_strain=2e-6))
    np.testing.assert_allclose(errors["gauge noise"][:, 0, :], 2e-6 * C.T)


def test_pad_loads_push_inwards_and_pull_outwards() -> None:
    for pull in (True, False):
        loads = error_budget.pad_loads(1.5, 0.0, 180.0, pull=pull)
        assert loads.P_newtons.shape == (37 * 7,)
        assert error_budget.pad_loads(1.5, 0.0, 1e9, pull=pull).P_newtons.shape == (73 * 7,)
        error = np.remainder(contacts(loads.F, pull=pull).theta_rad - loads.theta_rad + pi, 2 * pi) - pi
        np.testing.assert_allclose(error, 0.0, atol=1e-12)
    h = 1e-6
    step = force_vector(LOADS.P_newtons, LOADS.phi_rad + h, LOADS.theta_rad) - LOADS.F
    np.testing.assert_allclose(step / h, LOADS.turned, atol=1e-5)


def test_shape_error() -> None:
    with pytest.raises(InputError, match="allowed are"):
        budget(replace(SENSOR, A=A[:2]), LOADS, CAUSES)
