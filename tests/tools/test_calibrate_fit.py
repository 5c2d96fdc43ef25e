"""`tipforce calibrate fit` and `tipforce estimate`: what they print and write, row by row, and when they refuse."""

import csv
import io
import json
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sensor.calibration.made import CLEAN
from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration, read_calibration, write_calibration
from tipforce.host.decoding import estimator
from tipforce.sensor import covariance_of_estimate
from tipforce.sensor.calibration.simulation import Faults, Simulated, simulate
from tipforce.sensor.calibration.statistics import matrix_uncertainty
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix
from tipforce_tools.estimate import COLUMNS
from tools.rig import Printed, write_readings

LIMIT = ("--saturation", "853.85")
"""Of the simulated converter, just below the value that it clips to."""
Fitted = Callable[..., dict[str, Any]]
Rows = tuple[list[dict[str, str]], str]
Estimated = Callable[..., Rows]
A = strain_matrix(FABRICATED, "I")
OFFSET = np.array([20e-6, -30e-6, 5e-6])


@pytest.fixture
def sim() -> Simulated:
    return simulate("I", np.random.default_rng(4))


@pytest.fixture
def data(sim: Simulated, tmp_path: Path) -> Path:
    path = tmp_path / "grooves.csv"
    write_readings(path, sim)
    return path


@pytest.fixture
def fitted(printed: Printed) -> Fitted:
    """The record of `calibrate fit` with these words."""

    def fit(*words: object) -> dict[str, Any]:
        (record,) = printed(0, ["calibrate", "fit", *words, "--json"]).records
        return record

    return fit


def test_the_file_has_the_digits_that_were_told_and_gives_the_covariance_again(
    data: Path, sim: Simulated, tmp_path: Path, fitted: Fitted
) -> None:
    path = tmp_path / "cal.toml"
    record = fitted(data, "-o", path, "--layout", "I", "--serial", 7, "--date", "2025-12-31", *LIMIT)
    calibration = read_calibration(path, with_fit=True)
    assert calibration.parameter_covariance is not None
    assert np.array_equal(calibration.C, record["matrix_newtons_per_strain"])
    np.testing.assert_allclose(calibration.C @ sim.true_A, np.eye(3), atol=0.02)
    assert (calibration.serial, calibration.date, calibration.layout_code) == (7, 20251231, 1)
    assert calibration.pull
    assert record["crc32"] == f"0x{calibration.crc32():08X}"
    interval = np.array(record["matrix_interval_95"])
    np.testing.assert_allclose(interval.mean(axis=0), calibration.C, rtol=1e-9)
    np.testing.assert_allclose(
        (interval[1] - interval[0]) / 2, record["coverage_factor"] * np.array(record["matrix_standard_uncertainty"])
    )
    # Few degrees of freedom widen what is read as they do the interval.
    read, A = calibration.parameter_covariance[:, :3, :, :3], np.asarray(np.linalg.inv(calibration.C), dtype=np.float64)
    u = matrix_uncertainty(A, calibration.C, calibration.covariance_strain2, read)
    np.testing.assert_allclose(1.959964 * u, (interval[1] - interval[0]) / 2, rtol=1e-6)
    covariance = covariance_of_estimate(
        calibration.C, calibration.covariance_strain2, calibration.parameter_covariance, [1.0, 0.0, -2.0]
    )
    assert 0.005 < np.sqrt(covariance[0, 0]) < 0.05
    table = tomllib.loads(path.read_text())["fit"]
    assert (table["rows"], table["unloaded_rows"], table["drift"], table["bad_lines"]) == (77, 20, "tare", [])
    assert table["outlier_lines"] == [int(row) + 2 for row in np.flatnonzero(sim.true_outlier)]
    # S and N alone give nearly the same.
    path.write_text(path.read_text().replace("parameter_covariance_microstrain2", "covariance"))
    assert np.asarray(Calibration.read(path).parameter_covariance).shape == (3, 4, 3, 4)


def test_the_last_bits_of_the_arithmetic_change_no_file(sim: Simulated, tmp_path: Path, fitted: Fitted) -> None:
    """Another numpy gives other last bits. Here they come with the data: 1e-14 of each reading."""
    disturbed = np.random.default_rng(1).uniform(-1e-14, 1e-14, sim.strain.shape)
    files = []
    for name, strain in (("one", sim.strain), ("other", sim.strain * (1.0 + disturbed))):
        folder = tmp_path / name
        folder.mkdir()
        write_readings(folder / "grooves.csv", replace(sim, strain=strain))
        fitted(folder / "grooves.csv", "-o", folder / "cal.toml", "--date", "2025-12-31", *LIMIT)
        files.append(read_calibration(folder / "cal.toml"))
    assert not np.array_equal(sim.strain, sim.strain * (1.0 + disturbed))
    assert files[0].record() == files[1].record()
    for part in ("C", "offset_strain", "covariance_strain2"):
        assert np.array_equal(getattr(files[0], part), getattr(files[1], part)), part


def test_bad_rows_are_told_and_strict_refuses(data: Path, tmp_path: Path, printed: Printed) -> None:
    lines = data.read_text().splitlines()
    lines[9] = lines[9].replace(",", ",x", 1)
    data.write_text("\n".join(lines))
    path = tmp_path / "cal.toml"
    fit = ["calibrate", "fit", data]
    out, err = printed(0, [*fit, "-o", path, *LIMIT])
    assert "bad: line 10: SG1 is 'x" in out
    assert "1 bad rows were not used" in err
    path.unlink()
    assert "no file is written" in printed(1, [*fit, "-o", path, "--strict", *LIMIT]).err
    assert not path.exists()
    data.write_text("\n".join((lines[0], lines[1], lines[9])))
    assert "1 bad rows were not used, the first: line 3: SG1 is 'x" in printed(2, fit).err


def test_a_table_in_doubt_is_refused_by_strict(data: Path, sim: Simulated, tmp_path: Path, printed: Printed) -> None:
    """Every row twice; loads that leave no residual; offsets with --no-offset. More noise under load is a note."""
    head, *lines = data.read_text().splitlines()
    fit = ["calibrate", "fit", data, "-o", tmp_path / "cal.toml", "--strict"]
    data.write_text("\n".join([head, *np.repeat(lines, 2)]))
    assert "intervals are too narrow" in printed(1, [*fit, *LIMIT]).err
    weights = sim.P_newtons * (np.cumsum(sim.P_newtons == 4.4) <= 3) * (sim.P_newtons == 4.4)
    few = np.flatnonzero((weights > 0.0) | (sim.P_newtons == 0.0))
    data.write_text("\n".join([head, *np.array(lines)[few]]))
    assert "nothing checks a load" in printed(1, [*fit, *LIMIT]).err
    assert not (tmp_path / "cal.toml").exists()
    clean = simulate("I", np.random.default_rng(1), CLEAN)
    write_readings(data, replace(clean, strain=clean.strain * np.random.default_rng(2).normal(1.0, 0.01, (77, 3))))
    assert "times as far as unloaded ones" in printed(0, fit).out
    write_readings(data, clean)
    assert "fit without --no-offset" in printed(1, [*fit, "--no-offset"]).err
    write_readings(data, replace(clean, strain=clean.strain - clean.true_offset_strain))
    assert "loaded ones" not in printed(0, [*fit, "--no-offset"]).out


@pytest.mark.parametrize(
    ("strain", "load", "text"),
    [(1e-6, 1.0, "(multiply SG1.. by 1e6)"), (1.0, 1000.0 / 9.80665, "(multiply P_N by 0.00980665)")],
)
def test_strain_in_si_units_and_loads_in_grams_are_refused_with_the_factor(
    strain: float, load: float, text: str, data: Path, sim: Simulated, printed: Printed
) -> None:
    write_readings(data, replace(sim, strain=strain * sim.strain, P_newtons=load * sim.P_newtons))
    assert text in printed(2, ["calibrate", "fit", data, "--saturation", strain * 853.85]).err


def test_load_sense_layout_and_notes(sim: Simulated, tmp_path: Path, fitted: Fitted) -> None:
    data = tmp_path / "push.csv"
    write_readings(data, sim, temperature_degC=[23.0] * 77, mode=["push" if P else "tare" for P in sim.P_newtons])
    path = tmp_path / "cal.toml"
    record = fitted(data, "-o", path, "--layout", "II'", *LIMIT)
    assert record["load_sense"] == "push"
    assert any("1 degree costs about 1 % of P and 1 degree of phi or theta" in note for note in record["notes"])
    assert not any("loaded rows scatter" in note for note in record["notes"])
    assert (read_calibration(path).reference_temperature_degC, read_calibration(path).layout_code) == (23.0, 255)
    assert any("opposite to beam theory" in note for note in record["notes"])
    assert "all rows at 23 degC: what a warm finger reads is not known" in record["notes"]
    assert fitted(data, "--sense", "pull", *LIMIT)["load_sense"] == "pull"


def test_a_fit_table_of_somebody_else_does_not_hinder(data: Path, tmp_path: Path, fitted: Fitted) -> None:
    path = tmp_path / "cal.toml"
    fitted(data, "-o", path, *LIMIT)
    text = path.read_text()
    path.write_text(text.replace("normal_matrix = ", "matrix = ").replace("parameter_covariance_", "covariance_"))
    assert read_calibration(path).gauges == 3
    with pytest.raises(InputError, match=r"cal\.toml: fit: parameter_covariance_microstrain2 is missing"):
        Calibration.read(path)
    path.write_text(text.replace("condition_number = ", "condition_number = inf\nof_somebody_else = nan #", 1))
    assert Calibration.read(path).parameter_covariance is not None
    path.write_text(text[: text.index("[fit]")])
    assert Calibration.read(path).parameter_covariance is None
    path.write_text(text[: text.index("[fit]")] + "[fit]\ndof = 1.0\nresidual_covariance_microstrain2 = [[1.0]]\n"
                    "normal_matrix = [[1.0]]\n")  # fmt: skip
    with pytest.raises(InputError, match=r"residual_covariance_microstrain2 must be \(3, 3\)"):
        Calibration.read(path)


def test_prior_for_few_loads(data: Path, printed: Printed) -> None:
    data.write_text("\n".join(data.read_text().splitlines()[:9]))
    fit = f"calibrate fit {data} --layout I --noise 1 --drift none"
    assert "cannot show" in printed(2, fit).err
    assert "prior: beam theory within 10%" in printed(0, f"{fit} --prior beam").out


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "cal.toml"
    write_calibration(
        path,
        Calibration(
            calibration_matrix(FABRICATED, "I"), OFFSET, 1e-12 * np.eye(3), layout_code=1, pull=True,
            calibrated_force_newtons=10.0,
        ),
    )  # fmt: skip
    return path


def microstrain(P: float, phi_deg: float, theta_deg: float, offset: FloatArray = OFFSET) -> str:
    V = A @ force_vector(P, np.radians(phi_deg), np.radians(theta_deg)) + offset
    return ",".join(repr(float(value * 1e6)) for value in V)


@pytest.fixture
def estimated(calibration: Path, printed: Printed) -> Estimated:
    """The rows of `estimate` of lines of readings, and what it writes to stderr."""

    def run(lines: list[str], head: str = "SG1,SG2,SG3", words: str = "", code: int = 0) -> Rows:
        path = calibration.with_name("gauges.csv")
        path.write_text("\n".join([head, *lines]))
        out, err = printed(code, f"estimate {calibration} {path} {words}")
        return list(csv.DictReader(io.StringIO(out))), err

    return run


def test_one_row_for_each_row(estimated: Estimated) -> None:
    loads = [(2.0, 30.0, 50.0), (0.5, -90.0, 90.0), (4.4, 100.0, 80.0)]
    rows, err = estimated([*(microstrain(*load) for load in loads), "1,2"])
    assert tuple(rows[0]) == COLUMNS
    assert [row["line"] for row in rows] == ["2", "3", "4", "5"]
    for row, (P, phi, theta) in zip(rows[::2], loads[::2], strict=False):
        values = [float(row[name]) for name in ("P_N", "phi_deg", "theta_deg")]
        assert values == pytest.approx([P, phi, theta], rel=1e-6)
        assert 0.005 < float(row["u_P_N"]) < 0.02
        assert float(row["u_phi_deg"]) == pytest.approx(np.degrees(0.01 / P), rel=0.6)
        assert row["status"] == "ok"
    # The file says pull: pushing at 90 degrees is a pull from the other side of the tip.
    assert rows[1]["status"] == "outside_pad"
    assert float(rows[1]["theta_deg"]) == pytest.approx(-90, abs=1e-4)
    assert list(rows[3].values()) == ["5", "", "", "", "", "", "", "bad: 2 cells, the header has 3"]
    assert "1 of 4 rows are bad: line 5: 2 cells" in err
    assert "no [fit] table" in err


def test_several_nodes_in_one_file_are_refused(estimated: Estimated) -> None:
    """What `decode` writes of a hand: one calibration can't be of all its fingers."""
    load = microstrain(2.0, 30.0, 50.0)
    rows, _ = estimated([f"0,5,{load}", f"1,5,{load}"], "t_s,node,SG1,SG2,SG3")
    assert [row["status"] for row in rows] == ["ok", "ok"]
    cases = (("node", ("5", "6"), "(5, 6)"), ("channel,node", ("can0,5", "can1,5"), "(can0 5, can1 5)"))
    for head, keys, nodes in cases:
        rows, err = estimated([f"{key},{load}" for key in keys], f"{head},SG1,SG2,SG3", code=2)
        assert rows == []
        assert f"readings of 2 nodes {nodes}" in err
        assert "--nodes 5 " in err


def test_the_mode_of_a_row_selects_the_branch(estimated: Estimated) -> None:
    load = microstrain(2.0, -70.0, 90.0)
    rows, _ = estimated([f"{load},{mode}" for mode in ("push", "pull", "", "tear")], "SG1,SG2,SG3,mode")
    assert [float(row["theta_deg"] or "nan") for row in rows[:3]] == pytest.approx([90.0, -50.0, -50.0], abs=1e-4)
    assert [row["status"] for row in rows[:3]] == ["ok", "outside_pad", "outside_pad"]
    assert rows[3]["status"] == "bad: mode is 'tear', allowed: push, pull, tare or blank"
    assert "columns that are not used: Mode\n" in estimated([f"{load},push"], "SG1,SG2,SG3,Mode")[1]


def test_tares_take_drift_off_by_time(estimated: Estimated) -> None:
    drift = np.array([40e-6, 10e-6, -30e-6])
    lines = []
    for t, mode in ((0, "tare"), (25, ""), (50, ""), (100, "tare"), (100, "tare"), (150, "")):
        load = (0.0, 0.0, 0.0) if mode else (1.0, 45.0, 60.0)
        lines.append(f"{t},{microstrain(*load, OFFSET + drift * min(t, 100) / 100)},{mode}")
    rows, err = estimated(lines, "t_s,SG1,SG2,SG3,mode")
    assert [row["status"] for row in rows] == ["tare", "ok", "ok", "tare", "tare", "ok"]
    assert all(row["P_N"] == "" for row in rows if row["status"] == "tare")
    loaded = [rows[1], rows[2], rows[5]]
    values = [float(row[name]) for row in loaded for name in ("P_N", "theta_deg")]
    assert values == pytest.approx([1.0, 60.0] * 3, rel=1e-6)
    # The tares' own noise counts: a mean of two after the last, one and two weighted by distance between.
    noise = [float(row["u_P_N"]) ** 2 for row in loaded]
    expected = [1 + 0.75**2 + 0.25**2 / 2, 1 + 0.5**2 + 0.5**2 / 2, 1 + 1 / 2]
    np.testing.assert_allclose(np.array(noise) / noise[2], np.array(expected) / expected[2], rtol=1e-4)
    rows, err = estimated([line.split(",", 1)[1] for line in lines], "SG1,SG2,SG3,mode")
    assert "interpolated between tares by row" in err
    assert rows[1]["P_N"] != "1"


def test_a_saturated_tare_is_no_reference(estimated: Estimated) -> None:
    load, zero = microstrain(2.0, 30.0, 50.0), microstrain(0.0, 0.0, 0.0)
    lines = [f"900.5,{zero.split(',', 1)[1]},tare", f"{load},pull", f"{zero},tare", f"{load},pull"]
    for count, status in ((4, "ok"), (2, "saturated")):
        rows, _ = estimated(lines[:count], "SG1,SG2,SG3,mode", "--saturation 900")
        assert [row["status"] for row in rows] == ["tare", status] * (count // 2)
        assert [row["P_N"] for row in rows[1::2]] == (["2", "2"] if count == 4 else [""])


def test_means_of_many_readings_do_not_contradict(calibration: Path, fitted: Fitted, estimated: Estimated) -> None:
    sim = simulate(("K_H", "S_H", "U", "T"), np.random.default_rng(7), Faults(outlier_share=0.0, saturation=None))
    write_readings(calibration.with_name("data.csv"), sim)
    fitted(calibration.with_name("data.csv"), "-o", calibration)
    F = force_vector(3.0, np.radians(np.arange(30.0, 150.0)), np.radians(90.0))
    readings = 1e6 * (F @ sim.true_A.T + sim.true_offset_strain[-1])
    rows, _ = estimated([f"{','.join(map(str, row))},10000" for row in readings.tolist()], "SG1,SG2,SG3,SG4,weight")
    assert {row["status"] for row in rows} == {"ok"}


def test_a_gauge_that_stands_still_is_frozen(estimated: Estimated) -> None:
    """By the node's rule: 32 repetitions, of a gauge whose noise is at least the resolution of the table."""
    rng = np.random.default_rng(14)
    V = 1e6 * (A @ force_vector(2.0, np.radians(30.0), np.radians(50.0)) + OFFSET)
    readings = np.round(V + rng.normal(size=(200, 3)), 1)
    readings[50:82, 0] = readings[49, 0] + 7.0  # 32 equal readings: 31 repetitions
    readings[100:133, 1] = readings[99, 1] + 7.0
    coarse = np.round(readings / 50.0) * 50.0  # a resolution above the noise repeats readings by itself
    for values, expected in ((readings, [(k, "") for k in range(100, 133)]), (coarse, [])):
        rows, _ = estimated([",".join(map(str, row)) for row in values.tolist()])
        assert [(k, row["P_N"]) for k, row in enumerate(rows) if row["status"] == "frozen"] == expected


def test_a_parameter_covariance_that_is_none_is_refused(calibration: Path, estimated: Estimated) -> None:
    indefinite = np.eye(12)
    indefinite[0, 5] = indefinite[5, 0] = 1.1
    calibration.write_text(
        calibration.read_text() + f"\n[fit]\nparameter_covariance_microstrain2 = {indefinite.tolist()}\n"
    )
    error = estimated(["1,2,3"], code=2)[1]
    assert "parameter covariance: not positive semi-definite; no correlation may be over 1" in error


def test_a_tare_ages(calibration: Path, estimated: Estimated) -> None:
    """u(P) grows with the time to the nearest tare, or without one since the first row, by the stated rate."""
    load = microstrain(2.0, 30.0, 50.0)
    tared = ["0,tare,20,-30,5", f"1,,{load}", f"90,,{load}", "100,tare,20,-30,5", f"300,,{load}"]
    bare = [f"{t_s},,{load}" for t_s in (5, 6, 205)]

    def u_P(lines: list[str]) -> FloatArray:
        rows, _ = estimated(lines, "t_s,mode,SG1,SG2,SG3")
        return np.array([float(row["u_P_N"]) for row in rows if row["status"] != "tare"])

    def set_drift(rate: float) -> None:
        calibration.write_text(content.replace("serial =", f"tare_drift_microstrain_per_s = {rate}\nserial =", 1))

    before = u_P(tared), u_P(bare)
    content = calibration.read_text()
    set_drift(0.1)
    after = u_P(tared), u_P(bare)
    one_microstrain = before[1][0]  # the noise of each gauge is 1 microstrain
    for old, new, ages in zip(before, after, ([1, 10, 200], [0, 1, 200]), strict=True):
        added = np.sqrt(np.maximum(new**2 - old**2, 0.0))
        np.testing.assert_allclose(added, 0.1 * np.array(ages) * one_microstrain, rtol=1e-4, atol=1e-6)
    Calibration.read(calibration).write(calibration)
    assert Calibration.read(calibration).tare_drift_strain_per_s == pytest.approx(1e-7)
    set_drift(-1.0)
    assert "tare_drift: -1 microstrain/s, allowed is 0" in estimated([load], code=2)[1]
    set_drift(0.1)
    assert "no t_s: the tare's age is unknown" in estimated([load])[1]


def test_status_words_and_what_they_make_unknown(estimated: Estimated) -> None:
    missing = ",".join(str(value * 1e6) for value in A @ np.array([1.0, 1.5, 0.0]) + OFFSET)
    weak, low = microstrain(0.01, 30.0, 50.0), microstrain(0.08, 30.0 + 88.0, 30.0)
    texts = [weak, low, missing, microstrain(2.0, 60.0 + 89.0, 60.0), "900.1,0,0"]
    rows, _ = estimated(texts, words="--saturation 900")
    words = ("no_contact", "beyond_first_order", "misses_tip", "beyond_first_order", "saturated")
    assert all(word in row["status"].split() for row, word in zip(rows, words, strict=True))
    shown = [[name for name in ("P_N", "phi_deg", "theta_deg", "u_theta_deg") if rows[k][name]] for k in (0, 2, 4)]
    assert shown == [["P_N"], ["P_N", "phi_deg"], []]


def test_the_fit_table_widens_the_uncertainty(calibration: Path, fitted: Fitted, estimated: Estimated) -> None:
    sim = simulate("I", np.random.default_rng(3), Faults(outlier_share=0.0, saturation=None))
    data = calibration.with_name("data.csv")
    write_readings(data, sim)
    fitted(data, "-o", calibration)
    table = [",".join(str(value * 1e6) for value in sim.strain[3])]
    with_fit, err = estimated(table)
    assert err == ""
    calibration.write_text(calibration.read_text().split("[fit]")[0])
    without, _ = estimated(table)
    assert float(with_fit[0]["u_P_N"]) > 1.05 * float(without[0]["u_P_N"])
    assert with_fit[0]["P_N"] == without[0]["P_N"]


def test_chunks_carry_the_hysteresis(estimated: Estimated, monkeypatch: pytest.MonkeyPatch) -> None:
    loads = np.abs(np.random.default_rng(1).normal(size=200)) * 0.05
    lines = [microstrain(float(P), 30.0, 50.0) for P in loads]
    whole, _ = estimated(lines)
    monkeypatch.setattr(estimator, "BLOCK", 7)
    parts, _ = estimated(lines)
    assert parts == whole
    assert {"no_contact" in row["status"].split() for row in whole} == {True, False}


def test_json_and_output_file(calibration: Path, tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / "gauges.csv"
    path.write_text(f'SG1,SG2,SG3\n{microstrain(2.0, 30.0, 50.0)}\n"a,b",2,3\n')
    out, estimate = tmp_path / "out.jsonl", ["estimate", calibration, path, "-q"]
    assert printed(1, [*estimate, "--json", "-o", out, "--strict"]) == ("", "")
    first, second = (json.loads(line) for line in out.read_text().splitlines())
    assert (first["P_N"], first["status"]) == (pytest.approx(2.0), "ok")
    assert (second["P_N"], second["status"]) == (None, "bad: SG1 is 'a,b', not a number")
    rows = list(csv.reader(io.StringIO(printed(0, estimate).out)))
    assert rows[2][-1] == "bad: SG1 is 'a,b', not a number"
