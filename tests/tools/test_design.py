"""`tipforce design table|sweep|optimise`: numbers, figures, files, and what they say to wrong words."""

import contextlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tipforce.sensor.structure.plane_frame import worst_stress
from tipforce.sensor.structure.strain import gauge_matrix
from tipforce.sources.layout_file import read_layout
from tipforce_lab.design.merit import merit
from tipforce_lab.design.other_bodies import condition_range
from tools.rig import Printed, Streams, exit_code

QUICK = "--starts 2"
Optimised = Callable[[str], list[dict[str, Any]]]


def rows(found: list[dict[str, Any]], table: str) -> list[dict[str, Any]]:
    return [record for record in found if record["table"] == table and "notes" not in record]


@pytest.fixture(scope="module")
def everything() -> list[dict[str, Any]]:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert exit_code("design table all --repeats 50 --json") == 0
    return Streams(out.getvalue(), "").records


def test_every_table_is_there_with_its_explanation(everything: list[dict[str, Any]]) -> None:
    tables = {
        "1": 8, "2": 8, "3": 3, "ranking": 28, "comparators": 5, "fig6": 12, "fig9": 19, "off-axis": 18, "materials": 6,
        "scaling": 10,
    }  # fmt: skip
    assert {name: len(rows(everything, name)) for name in tables} == tables
    assert {record["table"] for record in everything if "notes" in record} == set(tables)


def test_table_3_to_the_printed_digits(everything: list[dict[str, Any]]) -> None:
    cases = rows(everything, "3")
    shown = [
        (row["case"], f"{row['actual']:.3f}", f"{row['thin']:.3f}", f"{row['printed_matrix']:.2f}") for row in cases
    ]
    assert shown == [
        ("I", "2.510", "2.555", "3.52"),
        ("II", "2.610", "2.626", "3.53"),
        ("III", "2.711", "2.693", "3.34"),
    ]
    # The paper cuts after two decimals: rounding would give 2.63 for case II.
    assert [int(100 * row["thin"]) / 100 for row in cases] == [row["paper_theory"] for row in cases]
    assert [(row["paper_theory"], row["paper_simulation"], row["can_be_printed_value"]) for row in cases] == [
        (2.55, 2.53, False), (2.62, 3.36, False), (2.69, 3.94, True),
    ]  # fmt: skip
    assert [f"{row['simulation_over_theory'] - 1:.0%}" for row in cases[1:]] == ["28%", "46%"]
    by_unit = cases[0]["by_unit"]
    assert [f"{by_unit['M/r']:.1f}", f"{by_unit['N mm']:.0f}", f"{by_unit['N m']:.0f}"] == ["2.5", "8", "158"]

    assert [row["simulation_shift_of"] for row in cases[1:]] == [["L"], ["L", "R"]]  # one shift explains them
    shifts = [row["simulation_shift_mm_others_half_mm"] for row in cases[1:]]
    assert shifts == pytest.approx([1.96, 2.01], abs=0.01)


@pytest.mark.parametrize(
    ("case", "condition", "most"), [("I", 2.510, ["SG3"]), ("II", 2.610, ["SG1"]), ("III", 2.711, ["SG1", "SG2"])]
)
def test_figure_6_claim(case: str, condition: float, most: list[str], everything: list[dict[str, Any]]) -> None:
    found = [row for row in rows(everything, "fig6") if row["case"] == case]
    assert [row["condition"][0] for row in found] == pytest.approx([condition] * 4, abs=5e-4)
    slopes = {row["moved"]: abs(row["slope_per_mm"]) for row in found if row["moved"] != "all"}
    assert max(slopes, key=lambda name: slopes[name]) in most


def test_comparators_on_one_scale(everything: list[dict[str, Any]]) -> None:
    found = {row["sensor"]: row for row in rows(everything, "comparators")}
    first = found["case I"]
    assert [round(first[f"in {unit}"], 1) for unit in ("M/r", "N mm", "N m")] == [2.5, 8.1, 158.2]
    assert first["smallest"] < first["in M/r"]
    # The paper's 4.2 and 20.05, at some unit of the moment, are numbers of its own sensor.
    assert first["equal_at_mm"][0] == pytest.approx([1.945, 26.10], abs=0.01)
    assert found["[5]"]["at_M_r_if_printed_in"]["M/r"] == [4.2, 4.2]
    low, high = found["[11]"]["at_M_r_if_printed_in"]["N mm"]
    assert (low, high) == pytest.approx((20.05 / 15.0, 20.05 * 15.0))
    for unit in ("N mm", "N m"):  # the bound holds for a sensor of which all is known
        low, high = condition_range(first[f"in {unit}"], {"N mm": 1e-3, "N m": 1.0}[unit], 15e-3)
        assert low <= first["in M/r"] <= high


def test_materials_and_the_largest_load(everything: list[dict[str, Any]]) -> None:
    found = {row["material"].split(",")[0]: row for row in rows(everything, "materials")}
    steel, soft = found["AISI 4340"], found["AISI 304"]
    assert steel["strain_ue"] == pytest.approx(912.1, abs=0.05)
    assert steel["largest_N"] == steel["slit_N"] == pytest.approx(15.19, abs=0.01)
    assert soft["largest_N"] == soft["yield_N"] == pytest.approx(5.06, abs=0.01)
    for row in found.values():
        assert row["strain_ue"] * row["E_GPa"] == pytest.approx(steel["strain_ue"] * steel["E_GPa"])
        # The strain at the yield load is the yield strain.
        assert row["strain_ue"] / 4.4 * row["yield_N"] == pytest.approx(1e3 * row["yield_MPa"] / row["E_GPa"])
        assert row["largest_N"] <= min(row["yield_N"], row["slit_N"])


def test_smaller_fingertips_scale_as_beams_do(everything: list[dict[str, Any]]) -> None:
    found = rows(everything, "scaling")
    for beams, power in (("scaled", -2.0), ("kept", 0.0)):
        whole, *smaller = [row for row in found if row["beams"] == beams]
        for row in smaller:
            scale = row["r_mm"] / whole["r_mm"]
            assert row["strain_ue"] == pytest.approx(whole["strain_ue"] * scale**power, rel=0.03)
            assert row["condition_of_gauges"] > whole["condition_of_gauges"] or beams == "kept"
    whole, *smaller = [row for row in found if row["beams"] == "scaled"]
    assert all(row["frequency_hz"] == pytest.approx(15.0 / row["r_mm"] * whole["frequency_hz"]) for row in smaller)
    assert all(row["condition"] == pytest.approx(whole["condition"]) for row in smaller)


def test_off_axis_claim(everything: list[dict[str, Any]]) -> None:
    for row in rows(everything, "off-axis"):
        if row["placement"] == "centred, axial":
            assert row["F_per_N_of_z"] < 1e-12
            assert row["F_per_N_and_mm_off_centre"] < 1e-12
        elif (row["placement"], row["warping"]) == ("1 mm lateral", "held"):
            assert 0.5 < row["F_per_N_of_z"] < 0.9


@pytest.mark.parametrize("what", ["a", "d", "r", "h1", "h2", "width"])
def test_sweep_of_a_dimension_passes_the_nominal_value(printed: Printed, what: str) -> None:
    found = rows(printed(0, f"design sweep {what} --steps 3 --json").records, "sweep")
    assert f"{found[1]['condition']:.3f}" == "2.510"
    assert found[1]["noise_gain_N_per_ue"] == pytest.approx(0.015789, abs=1e-6)
    assert found[1]["largest_strain_ue_per_N"] == pytest.approx(912.087 / 4.4, abs=1e-3)
    if what == "width":
        assert found[0]["noise_gain_N_per_ue"] == pytest.approx(0.5 * found[1]["noise_gain_N_per_ue"])


def test_sweep_of_a_shift_is_figure_6(printed: Printed, everything: list[dict[str, Any]]) -> None:
    for what in ("SG1", "SG2", "SG3", "all"):
        found = printed(0, f"design sweep {what} --layout II --from 0 --to 5 --steps 11 --json").records
        swept = {row[f"{what}_mm"]: row["condition"] for row in rows(found, "sweep")}
        row = next(row for row in rows(everything, "fig6") if (row["case"], row["moved"]) == ("II", what))
        for shift, condition in zip(row["shift_mm"], row["condition"], strict=True):
            assert swept[shift] == pytest.approx(condition)


def test_figures_are_reproducible_and_small(printed: Printed, tmp_path: Path) -> None:
    for what, name in (("all", "one"), ("3", "two"), ("scaling", "two")):  # which has no figure
        printed(0, f"design table {what} --repeats 5 -q -o {tmp_path / name}")
    names = {path.name for path in (tmp_path / "one").iterdir()}
    stems = ("cross-section", "condition-and-noise", "figure-6", "grooves", "figure-9", "off-axis")
    assert names == {f"{stem}.svg" for stem in stems}
    for name in names:
        first = (tmp_path / "one" / name).read_bytes()
        assert b"<dc:date>" not in first
        assert len(first) < 100_000
    (again,) = (tmp_path / "two").iterdir()
    assert again.read_bytes() == (tmp_path / "one" / again.name).read_bytes()


def test_sweep_figure(printed: Printed, tmp_path: Path) -> None:
    path = tmp_path / "r.png"
    assert f"wrote {path}" in printed(0, f"design sweep r --steps 5 -o {path}").err
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.fixture
def optimised(printed: Printed) -> Optimised:
    """The records of `design optimise` with these words."""

    def run(words: str) -> list[dict[str, Any]]:
        streams = printed(0, f"design optimise --json {QUICK} {words}")
        assert streams.err == ""
        return streams.records

    return run


def test_the_papers_cases_stand_beside_the_designs(optimised: Optimised) -> None:
    *entries, summary = optimised("--starts 6")
    by_name = {entry["name"]: entry for entry in entries}
    assert list(by_name)[:5] == ["I", "II", "III", "I glued", "best"]
    assert [round(by_name[case]["condition_number"], 3) for case in ("I", "II", "III")] == [2.510, 2.610, 2.711]
    assert by_name["I"]["gauges"] == ["K_H", "S_H", "U"]
    assert by_name["best"]["u_theta_deg"] < 0.9 * by_name["I glued"]["u_theta_deg"]
    assert summary["u_theta_against_case_I_glued"] == pytest.approx(
        by_name["best"]["u_theta_deg"] / by_name["I glued"]["u_theta_deg"]
    )
    assert (summary["summary"], summary["agrees"], summary["agreement_limit"]) == (True, True, 0.03)
    assert summary["condition_only_u_theta_against_case_I"] > 5.0
    assert summary["condition_only_noise_against_case_I"] > 5.0


def test_the_layout_that_it_writes(tmp_path: Path, optimised: Optimised) -> None:
    path = tmp_path / "four.toml"
    records = optimised(f"--gauges 4 --load 3 --noise 1 -q -o {path}")
    best = next(record for record in records if record["name"] == "best")
    text = path.read_text()
    assert text.startswith("# tipforce design optimise --objective theta --gauges 4 --seed 0\n")
    geometry, gauges = read_layout(str(path))
    assert geometry.a_m == best["a_m"]
    got = merit(gauge_matrix(geometry, gauges), 1.0, 3.0)
    assert got.u_theta_deg == pytest.approx(best["u_theta_deg"], rel=1e-12)
    assert got.condition_number == pytest.approx(best["condition_number"], rel=1e-12)
    assert worst_stress(geometry, 3.0) == pytest.approx(best["worst_stress_pascals"])
    assert np.linalg.matrix_rank(gauge_matrix(geometry, gauges)) == 3


def test_for_people(printed: Printed, tmp_path: Path) -> None:
    path = tmp_path / "layout.toml"
    captured = printed(0, f"design optimise {QUICK} -o {path}")
    assert "Structures, mm" in captured.out
    assert "K_H, S_H, U" in captured.out
    assert "condition number alone: 1." in captured.out
    assert "beam theory and the independent frame agree within 3 %: PASS (best 0." in captured.out
    assert captured.err == f"wrote {path}\n"
    assert all(len(line) <= 120 for line in captured.out.splitlines())


def test_a_design_that_the_frame_does_not_confirm_fails(printed: Printed) -> None:
    out = printed(1, f"design optimise {QUICK} --objective condition").out
    assert "agree within 3 %: FAIL (condition" in out
    assert "condition: u(theta) +" in out


def test_the_flags_reach_the_limits(optimised: Optimised) -> None:
    words = "--envelope 24,28 --width 8 --min-h 0.3 --gauge-length 1.5 --load 6 --max-stress 300 --slit 0.2"
    best = next(record for record in optimised(words) if record["name"] == "best")
    assert best["r_m"] <= 12e-3 + 1e-9
    assert best["d_m"] + best["r_m"] + best["h1_m"] / 2 <= 28e-3 + 1e-8
    assert min(best["h1_m"], best["h2_m"]) >= 0.3e-3 - 1e-9
    assert best["width_m"] == pytest.approx(8e-3)
    assert best["worst_stress_pascals"] <= 300e6 * (1 + 1e-6)
    assert best["slit_load_newtons"] >= 6 * (1 - 1e-6)


def test_gauges_too_long_for_the_paper_leave_out_its_glued_case(optimised: Optimised) -> None:
    *entries, summary = optimised("--gauge-length 15.5 --envelope 80,80 --slit 1")
    assert "I glued" not in [entry["name"] for entry in entries]
    assert summary["u_theta_against_case_I_glued"] is None
