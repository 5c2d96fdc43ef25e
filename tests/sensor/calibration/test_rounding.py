"""A fit is rounded to what is finer than REAL32 and coarser than the arithmetic's last bits."""

from __future__ import annotations

import numpy as np
import pytest

from tipforce.sensor.calibration.fit import Model, Readings, fit_calibration
from tipforce.sensor.calibration.result import DIGITS, matrix_to_digits, rounded, to_digits
from tipforce.sensor.calibration.simulation import Simulated, simulate


def test_all_values_are_rounded_to_the_place_of_the_largest() -> None:
    assert to_digits([12345.678912345, 0.00012345, -1e-12]).tolist() == [12345.6789, 0.0001, 0.0]
    assert to_digits([3.1e-15, 1.23456789012e-14]).tolist() == pytest.approx([3.1e-15, 1.23456789e-14], rel=1e-15)
    assert to_digits([1e-12], scale=1e-3).tolist() == [0.0]
    assert to_digits([0.0, -0.0]).tolist() == [0.0, 0.0]
    assert np.isnan(to_digits([np.nan, 1.0])[0])
    assert to_digits(2.0 / 3.0, 3) == 0.667


def test_rows_are_rounded_by_themselves() -> None:
    assert matrix_to_digits([[1e6 / 3, 1.0], [1e-3 / 3, 1.0]]).tolist() == [[333333.333, 1.0], [0.00033333, 1.0]]


def test_the_place_is_finer_than_the_nodes_numbers() -> None:
    assert np.finfo(np.float32).eps > 10.0 ** (1 - DIGITS) / 2


@pytest.fixture(scope="module")
def sim() -> Simulated:
    return simulate("I", np.random.default_rng(4))


def test_nothing_that_the_data_show_is_lost(sim: Simulated) -> None:
    exact = fit_calibration(
        Readings(sim.strain, sim.P_newtons, sim.phi_rad, sim.theta_rad, sim.t_s), Model(saturation_strain=np.inf)
    )
    found = rounded(exact)
    assert (np.abs(found.C - exact.C) < 1e-5 * exact.C_uncertainty).all()
    scatter = np.sqrt(np.einsum("kiki->ki", exact.parameter_covariance)[:, 3])
    assert (np.abs(found.offset_strain - exact.offset_strain) < 1e-5 * scatter).all()
    for name in ("noise_covariance_strain2", "residual_covariance_strain2", "parameter_covariance", "N"):
        before, after = getattr(exact, name), getattr(found, name)
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-8 * np.abs(before).max())
        matrix = after.reshape(int(np.sqrt(after.size)), -1)
        assert np.array_equal(matrix, matrix.T), name
        assert np.linalg.eigvalsh(matrix)[0] > 0.0, name
