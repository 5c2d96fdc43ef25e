"""Figures of merit: predicted uncertainties against the contact's own, stresses, the bound on the condition number."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tipforce.errors import InputError
from tipforce.sensor.contact.estimate import contacts, force_vector, standard_uncertainties
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.limits import worst_stress
from tipforce.sensor.structure.strain import condition_number, noise_gain, strain_matrix
from tipforce_lab.design.merit import LoadSet, merit, worst_strain

NOISE = 0.5
LOADS = LoadSet()


@pytest.mark.parametrize("case", ["I", "II", "III"])
@pytest.mark.parametrize("loads", [LOADS, LoadSet(1.0, 30.0, 100.0, 0.9), LoadSet(20.0, 0.0, 180.0, 0.0)])
def test_uncertainties_are_those_of_the_contact(case: str, loads: LoadSet) -> None:
    A = strain_matrix(FABRICATED, case)
    C = np.linalg.pinv(A)
    phi, theta = loads.angles()
    assert np.all(np.cos(phi - theta) < 0.0), "pushes"
    u = standard_uncertainties(force_vector(loads.load_newtons, phi, theta), (NOISE * 1e-6) ** 2 * C @ C.T, pull=False)
    rms = np.sqrt(np.mean(u**2, axis=0))
    got = merit(A, NOISE, loads)
    # The contact's u(theta) has a correction near tangency, beyond first order: nothing here.
    assert [got.u_P_newtons, got.u_phi_deg, got.u_theta_deg] == pytest.approx(
        [rms[0], math.degrees(rms[1]), math.degrees(rms[2])], rel=1e-4
    )
    assert got.noise_gain_newtons == pytest.approx(1e-6 * noise_gain(C))
    assert got.smallest_singular_value == pytest.approx(1e6 / np.linalg.norm(C, 2))
    assert got.condition_number == pytest.approx(condition_number(A))


def test_uncertainties_by_monte_carlo() -> None:
    rng = np.random.default_rng(20261121)
    A = strain_matrix(FABRICATED, ("K_H", "S_H", "U", "L"))
    phi, theta = (np.repeat(angle, 40) for angle in LOADS.angles())
    strain = force_vector(LOADS.load_newtons, phi, theta) @ A.T
    noisy = strain + rng.normal(0.0, NOISE * 1e-6, strain.shape)
    contact = contacts(noisy @ np.linalg.pinv(A).T, pull=False)
    off = np.degrees(np.angle(np.exp(1j * (contact.theta_rad - theta))))
    expected = merit(A, NOISE, LOADS)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(expected.u_theta_deg, rel=0.02)
    assert np.std(contact.P_newtons) == pytest.approx(expected.u_P_newtons, rel=0.02)


def test_worst_stress_and_strain_over_all_angles() -> None:
    phi, theta = np.meshgrid(np.radians(np.arange(-180, 181)), np.radians(np.arange(0, 181)))
    F = force_vector(4.4, phi, theta).reshape(-1, 3).T
    A = strain_matrix(FABRICATED, ("L", "R", "T", "U", "K_H", "S_H", "K_V", "S_V"))
    largest = np.abs(A @ F).max()
    assert worst_strain(A, 4.4) == pytest.approx(largest, rel=1e-3)
    assert worst_stress(FABRICATED, 4.4) == pytest.approx(largest * FABRICATED.youngs_modulus_pascals, rel=1e-3)
    assert worst_stress(FABRICATED, 4.4) == pytest.approx(187.0e6, rel=1e-3)


@pytest.mark.parametrize(
    "change",
    [{"load_newtons": 0.0}, {"load_newtons": math.nan}, {"theta_min_deg": 10.0, "theta_max_deg": 0.0},
     {"theta_max_deg": math.nan}, {"friction": -0.1}, {"friction": math.inf}],
)  # fmt: skip
def test_loads_that_are_wrong(change: dict[str, float]) -> None:
    with pytest.raises(InputError, match="allowed is"):
        LoadSet(**change)


def test_matrices_and_noise_that_are_wrong() -> None:
    with pytest.raises(InputError, match=r"strain matrix of shape \(2, 3\)"):
        merit(np.ones((2, 3)), NOISE, LOADS)
    with pytest.raises(InputError, match=r"noise = nan"):
        merit(np.eye(3), math.nan, LOADS)
