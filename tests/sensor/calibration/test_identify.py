"""What the data cannot show is refused by name, with what to add; adding it helps."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt
import pytest

from tipforce.errors import InputError
from tipforce.sensor.calibration.distributions import f_quantile, t_quantile
from tipforce.sensor.calibration.fit import Fit, Model, Readings, fit_calibration
from tipforce.sensor.calibration.simulation import paper_grooves
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import strain_matrix

FloatArray = npt.NDArray[np.float64]
A = strain_matrix(FABRICATED, "I")
QUADRANT = [(0, theta) for theta in (5, 15, 30, 45, 60)] + [(90, theta) for theta in (30, 45, 60, 75, 90)]
TARE = [(0.0, 0, 0)]


def fitted(rows: list[tuple[float, int, int]], model: Model | None = None) -> Fit:
    """Fit of readings with 1 microstrain of noise and 20 of offset; rows of (P, phi, theta) in degrees."""
    P, phi, theta = np.array(rows, dtype=np.float64).T
    load = P, np.radians(phi), np.radians(theta)
    noise = 1e-6 * np.random.default_rng(0).normal(size=(len(P), 3))
    V = force_vector(*load) @ A.T + 20e-6
    return fit_calibration(Readings(V + noise, *load, t_s=np.arange(len(P), dtype=np.float64)), model)


def one_weight(places: list[tuple[int, int]], P: float = 4.4) -> list[tuple[float, int, int]]:
    return [(P, phi, theta) for phi, theta in places]


def test_the_papers_range_cannot_show_an_offset() -> None:
    with pytest.raises(InputError) as caught:
        fitted(one_weight(QUADRANT * 2))
    text = str(caught.value)
    assert "cannot show 1 of the 4 unknowns" in text
    assert "F1 + F3 is 4.4 N in every row, so that an offset cannot be told" in text
    assert "add tare rows (unloaded readings), or loads with another F1 + F3" in text
    assert "beyond theta = 90 degrees" in text
    smallest = float(re.findall(r"singular values [^)]*?([\d.e-]+)\)", text)[0])
    assert smallest < 1e-10


@pytest.mark.parametrize(
    "more",
    [TARE, one_weight([(180, 120)]), one_weight([(0, 30)], 2.2)],
    ids=["a tare", "an x-groove beyond 90 degrees", "another weight"],
)
def test_what_the_message_asks_for_helps(more: list[tuple[float, int, int]]) -> None:
    fit = fitted(one_weight(QUADRANT * 2) + more)
    np.testing.assert_allclose(fit.offset_strain, 20e-6, atol=5e-6)


def test_all_19_grooves_show_an_offset_with_one_weight() -> None:
    grooves = paper_grooves()
    places = np.degrees(np.stack((grooves.phi_rad, grooves.theta_rad), axis=-1)).round().astype(int)
    fit = fitted([(4.4, phi, theta) for phi, theta in places.tolist()])
    np.testing.assert_allclose(fit.offset_strain, 20e-6, atol=2e-6)


def test_without_an_offset_the_papers_range_is_enough() -> None:
    assert fitted(one_weight(QUADRANT), Model(offset=False)).N.shape == (3, 3)


def test_nearly_the_same_weight_is_lost_in_the_noise() -> None:
    rows = [(4.4 + 0.001 * (k % 3), phi, theta) for k, (phi, theta) in enumerate(QUADRANT * 2)]
    with pytest.raises(InputError, match=r"lost in the noise .*F1 \+ F3 is about 4.401 N"):
        fitted(rows)


@pytest.mark.parametrize(
    ("rows", "model", "text"),
    [
        ([*one_weight([(90, theta) for theta in range(30, 151, 15)]), *TARE], None, "F3 is 0 N in every row"),
        (
            [(P, 0, 45) for P in (1.0, 2.0, 3.0, 4.0, 0.0)],
            None,
            "cannot show 2 .* F2 \\+ 0.707 F3 is 0 N in every row: .*; F1 is 0 N",
        ),
        ([(P, 0, 0) for P in (1.0, 2.0, 4.0, 0.0)], None, "F1 is 0 N in every row"),
        (one_weight([(0, 45), (90, 45), (90, 90)]), None, r"cannot show 1 .*\(3 rows"),
        ([*one_weight([(0, 45), (90, 45), (90, 90)]), *TARE], None, "leave no residuals .* state the gauge noise"),
        (one_weight(QUADRANT * 2), Model(drift="linear"), "F1 \\+ F3 is 4.4 N"),
        ([*one_weight(QUADRANT), *TARE], Model(drift="tare"), "at two times at least, .* there are 1"),
    ],
    ids=["y-grooves", "one groove", "one line", "three loads", "no residual", "drift", "one tare"],
)
def test_each_direction_has_its_words(rows: list[tuple[float, int, int]], model: Model | None, text: str) -> None:
    with pytest.raises(InputError, match=text):
        fitted(rows, model)


def test_stated_noise_makes_up_for_missing_residuals() -> None:
    fit = fitted([*one_weight([(0, 45), (90, 45), (90, 90)]), *TARE], Model(noise_strain=1e-6))
    assert fit.dof == pytest.approx(0.0, abs=1e-6)
    assert fit.coverage_factor == pytest.approx(1.96, abs=1e-3)
    assert np.isnan(fit.sigma0)


def test_no_times_no_drift() -> None:
    P, phi, theta = np.ones(3), np.zeros(3), np.zeros(3)
    with pytest.raises(InputError, match="column t_s"):
        fit_calibration(Readings(np.ones((3, 3)), P, phi, theta), Model(drift="tare", saturation_strain=np.inf))
    model = Model(drift="linear", saturation_strain=np.inf)
    with pytest.raises(InputError, match="every row has t_s = 5"):
        fit_calibration(Readings(np.ones((3, 3)), P, phi, theta, np.full(3, 5.0)), model)


def test_a_gauge_that_is_always_saturated_is_named() -> None:
    rows = [*one_weight(QUADRANT), *TARE, *TARE]
    with pytest.raises(InputError, match="for SG3"):
        fitted(rows, Model(saturation_strain=np.array([1.0, 1.0, 1e-6])))


@pytest.mark.parametrize("dof", [1.0, 2.0, 5.5, 30.0, 1000.0])
def test_quantiles_are_scipys(dof: float) -> None:
    stats = pytest.importorskip("scipy.stats")
    for probability in (0.6, 0.975, 0.9999):
        assert t_quantile(probability, dof) == pytest.approx(stats.t.ppf(probability, dof), rel=1e-8)
        for count in (1.0, 3.0, 8.0):
            assert f_quantile(probability, count, dof) == pytest.approx(stats.f.ppf(probability, count, dof), rel=1e-8)
    assert t_quantile(0.975, np.inf) == pytest.approx(1.959964, abs=1e-6)
