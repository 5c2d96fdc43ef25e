"""Tables 1 to 3 and figure 9 recomputed; figures of merit against the contact's own uncertainties."""

import math
from dataclasses import astuple
from math import isnan, nan

import numpy as np
import pytest

from tipforce.sensor import FABRICATED, Geometry, force_vector, standard_uncertainties
from tipforce.sensor.calibration.simulation import paper_grooves
from tipforce.sensor.structure import quality, strain
from tipforce.sensor.structure.layouts import CASES, LAYOUTS, POINTS
from tipforce.sensor.structure.plane_frame import worst_stress
from tipforce_lab.design import tables
from tipforce_lab.design.merit import load_angles, merit, worst_strain
from tipforce_lab.design.sections import simulate_groove_errors
from tipforce_lab.design.tables import HALF_DIGIT, MEASURED_MATRICES, TABLE_2

ODD = Geometry(0.011, 0.017, 0.019, 0.0005, 0.0007, 0.009, 2.0e11)
THETA, PHI = np.meshgrid(np.radians(np.arange(0.0, 180.5, 0.5)), np.radians(np.arange(-179.5, 180.5, 0.5)))
CONTACTS = force_vector(1.0, PHI, THETA).reshape(-1, 3)
NOISE = 0.5


@pytest.mark.parametrize("geometry", [FABRICATED, ODD])
def test_table_1_formulas_give_its_numbers(geometry: Geometry) -> None:
    values = dict(zip(("a", "d", "r", "h1", "h2"), astuple(geometry)[:5], strict=True))
    for point, coefficients in quality.stress_coefficients(geometry).items():
        found = [eval(symbol.replace("^", "**"), {"__builtins__": {}}, values) for symbol in tables.SYMBOLS[point]]
        assert found == pytest.approx(coefficients, rel=1e-14), point


def test_maxima_against_a_search() -> None:
    rng = np.random.default_rng(3)
    rows = [tuple(rng.normal(size=3).tolist()) for _ in range(60)]
    rows += [(1.0, 0.0, 2.0), (0.0, 2.0, 0.0), (0.0, -2.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0), (0.0, 1.0, 1.0)]
    for g1, g2, g3 in rows:
        best = tables.maximum_over_contacts((g1, g2, g3))
        largest = float((CONTACTS @ np.array([g1, g2, g3])).max())
        assert largest <= best.value * (1.0 + 1e-12)
        assert best.value == pytest.approx(largest, rel=1e-4)
        for theta in (0.0, 70.0) if isnan(best.theta_deg) else (best.theta_deg,):
            phi = best.phi_deg + (theta if isnan(best.theta_deg) and g2 else 0.0)
            assert tables.reading((g1, g2, g3), theta, phi) == pytest.approx(best.value, rel=1e-9)
    assert tables.maximum_over_contacts((0.0, 0.0, 0.0)) == pytest.approx((0.0, nan, 0.0), nan_ok=True)


def test_table_2_thin_limit() -> None:
    found = {row.point: row.thin for row in tables.table_2(FABRICATED)}
    for point, printed in TABLE_2.items():
        assert found[point].value == pytest.approx(printed.maximum, rel=1e-12)
    places = {point: (row.theta_deg, row.phi_deg % 180.0) for point, row in found.items()}
    assert places["L"] == places["K_H"] == (180.0, 90.0)
    assert places["R"] == places["S_H"] == (0.0, 90.0)
    assert places["T"] == places["U"] == (90.0, 0.0)
    assert isnan(places["K_V"][0])
    assert isnan(places["S_V"][0])


def test_printed_places_of_table_2() -> None:
    """What the thin limit really reads where the paper puts the maxima: R nothing, T and U half."""
    there = {}
    for point, (g1, g2, g3) in zip(POINTS, quality.thin_limit_matrix(POINTS).tolist(), strict=True):
        printed = TABLE_2[point]
        there[point] = (
            tables.THIN_UNIT * abs(tables.reading((g1, g2, g3), printed.theta_deg, printed.phi_deg)) / printed.maximum
        )
    expected = {"L": 1.0, "R": 0.0, "T": 0.5, "U": 0.5, "K_H": 1.0, "S_H": 1.0, "K_V": 1.0, "S_V": 1.0}
    assert there == pytest.approx(expected, abs=1e-12)


def test_ranking() -> None:
    rows = tables.ranked_layouts(FABRICATED)
    assert len(rows) == 28
    assert len({frozenset(points) for row in rows for points in (row["gauges"], row["mirror"])}) == 56
    assert [round(row["condition"], 3) for row in rows[:5]] == [2.510, 2.610, 2.622, 2.711, 3.618]
    assert [row["case"] for row in rows[:5]] == ["I", "II", "", "III", ""]
    assert {frozenset(rows[2]["gauges"]), frozenset(rows[2]["mirror"])} == {
        frozenset("LT") | {"S_H"},
        frozenset("RU") | {"K_H"},
    }
    assert all(row["mirror"] == quality.mirror(row["gauges"]) for row in rows)
    for by, order in (("noise_gain_N_per_ue", ["I", "II", "III"]), ("row_equilibrated", ["III", "II", "I"])):
        assert [row["case"] for row in tables.ranked_layouts(FABRICATED, by) if row["case"]] == order
    assert [row["case"] for row in tables.ties(tables.ranked_layouts(FABRICATED, "thin"), "thin")[0]] == ["II", ""]
    assert not tables.ties(rows, "condition")


def test_rounding_ranges_exclude_3_50_for_cases_i_and_ii() -> None:
    found = {case: tables.rounding_range(MEASURED_MATRICES[case]) for case in CASES}
    assert [round(found[case].printed, 2) for case in CASES] == [3.52, 3.53, 3.34]
    assert found["I"].low > 3.505
    assert found["II"].low > 3.505
    assert found["III"].low < 3.34 < found["III"].high
    rng = np.random.default_rng(4)
    for case in CASES:
        inside = np.array(MEASURED_MATRICES[case]) + rng.uniform(-HALF_DIGIT, HALF_DIGIT, (20_000, 3, 3))
        conditions = np.linalg.cond(inside)
        assert found[case].low <= conditions.min()
        assert conditions.max() <= found[case].high


def test_no_common_gauge_shift_gives_the_measured_condition_numbers() -> None:
    measured = {case: tables.rounding_range(MEASURED_MATRICES[case]).printed for case in CASES}
    shifts_m, miss = tables.nearest_common_shifts(FABRICATED, measured)
    assert miss > 0.05
    shifts = {case: [shifts_m[point] for point in LAYOUTS[case]] for case in CASES}
    misses = [
        abs(np.linalg.cond(quality.shifted_matrix(FABRICATED, case, shifts[case])) - measured[case]) for case in CASES
    ]
    assert max(misses) == pytest.approx(miss, rel=1e-9)
    exact = {case: tables.table_3(FABRICATED, case).actual for case in CASES}
    shifts_m, miss = tables.nearest_common_shifts(FABRICATED, exact, steps=5)
    assert miss < 1e-12
    assert set(shifts_m.values()) == {0.0}


def test_grooves_pull_outward() -> None:
    grooves = paper_grooves()
    assert len(grooves.theta_rad) == 19
    assert int(grooves.along_x.sum()) == 10
    assert (np.cos(grooves.phi_rad - grooves.theta_rad) > 0.49).all()  # |phi - theta| up to 60 degrees
    assert np.degrees(grooves.phi_rad[:10]).tolist() == [0.0] * 5 + [180.0] * 5
    assert set(np.degrees(grooves.phi_rad[10:])) == {90.0}


def test_errors_have_the_stated_uncertainty() -> None:
    found = simulate_groove_errors(FABRICATED, "I", 2e-6, repeats=1500, seed=5)
    ratio = found.errors.std(axis=0) / found.standard_uncertainties
    assert ratio.shape == (19, 3)
    assert np.abs(ratio - 1.0).max() < 0.09  # 1500 runs: 1.8 % standard error each, 57 numbers
    assert (np.abs(found.errors) < 1.96 * found.standard_uncertainties).mean() == pytest.approx(0.95, abs=0.01)


def test_theta_is_worst_where_the_rope_pulls_tangentially() -> None:
    found = simulate_groove_errors(FABRICATED, "I", 2e-6, repeats=1, seed=6)
    u_theta = found.standard_uncertainties[:, 2]
    assert u_theta[4] > 2.0 * u_theta[0]  # x-grooves at 60 and 5 degrees
    assert found.standard_uncertainties[18, 0] > 1.4 * found.standard_uncertainties[14, 0]  # extrapolated y-groove


def test_same_seed_same_errors_and_noise_scales() -> None:
    one, two = (simulate_groove_errors(FABRICATED, "III", 1e-6, repeats=3, seed=7) for _ in range(2))
    np.testing.assert_array_equal(one.errors, two.errors)
    double = simulate_groove_errors(FABRICATED, "III", 2e-6, repeats=3, seed=7)
    np.testing.assert_allclose(double.standard_uncertainties, 2.0 * one.standard_uncertainties, rtol=0.05)


@pytest.mark.parametrize("case", ["I", "II", "III"])
@pytest.mark.parametrize("load_newtons", [1.0, 4.4, 20.0])
def test_uncertainties_are_those_of_the_contact(case: str, load_newtons: float) -> None:
    A = strain.strain_matrix(FABRICATED, case)
    C = np.linalg.pinv(A)
    phi, theta = load_angles()
    assert np.all(np.cos(phi - theta) < 0.0), "pushes"
    u = standard_uncertainties(force_vector(load_newtons, phi, theta), (NOISE * 1e-6) ** 2 * C @ C.T, pull=False)
    rms = np.sqrt(np.mean(u**2, axis=0))
    got = merit(A, NOISE, load_newtons)
    # The contact's u(theta) has a correction near tangency, beyond first order: nothing here.
    assert [got.u_P_newtons, got.u_phi_deg, got.u_theta_deg] == pytest.approx(
        [rms[0], math.degrees(rms[1]), math.degrees(rms[2])], rel=1e-4
    )
    assert got.noise_gain_newtons == pytest.approx(1e-6 * quality.noise_gain(C))
    assert got.smallest_singular_value == pytest.approx(1e6 / np.linalg.norm(C, 2))
    assert got.condition_number == pytest.approx(quality.condition_number(A))
    of_any_size = [quality.row_equilibrated_condition_number(size * A) for size in (1e-300, 1e-160, 1e160, 1e300)]
    assert of_any_size == pytest.approx([quality.row_equilibrated_condition_number(A)] * 4)


def test_worst_stress_and_strain_over_all_angles() -> None:
    phi, theta = np.meshgrid(np.radians(np.arange(-180, 181)), np.radians(np.arange(0, 181)))
    F = force_vector(4.4, phi, theta).reshape(-1, 3).T
    A = strain.strain_matrix(FABRICATED, ("L", "R", "T", "U", "K_H", "S_H", "K_V", "S_V"))
    largest = np.abs(A @ F).max()
    assert worst_strain(A, 4.4) == pytest.approx(largest, rel=1e-3)
    assert worst_stress(FABRICATED, 4.4) == pytest.approx(largest * FABRICATED.youngs_modulus_pascals, rel=1e-3)
    assert worst_stress(FABRICATED, 4.4) == pytest.approx(187.0e6, rel=1e-3)
