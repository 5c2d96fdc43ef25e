"""`tipforce calibrate fit`: what it prints, what it writes, and when it refuses."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tipforce.host.configuration.calibration import read_calibration, read_fit
from tipforce.host.configuration.measurements import Measurements, write_measurements
from tipforce.sensor.calibration.fit import covariance_of_estimate
from tipforce.sensor.calibration.simulation import Simulated, simulate
from tipforce_tools.cli.main import main
from tools.rig import Printed


def measured(sim: Simulated) -> Measurements:
    m = len(sim.strain)
    return Measurements(
        np.arange(m) + 2, sim.strain, sim.P_newtons, sim.phi_rad, sim.theta_rad, sim.t_s, None, None, None, (), ()
    )


@pytest.fixture
def sim() -> Simulated:
    return simulate("I", np.random.default_rng(4))


@pytest.fixture
def data(sim: Simulated, tmp_path: Path) -> Path:
    path = tmp_path / "grooves.csv"
    write_measurements(path, measured(sim))
    return path


LIMIT = ("--saturation", "853.85")
"""Of the simulated converter, just below the value that it clips to."""


def fitted(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    assert main(["calibrate", "fit", *map(str, words), "--json"]) == 0
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    record: dict[str, Any] = json.loads(out)
    return record


def test_text_tells_all(data: Path, sim: Simulated, printed: Printed) -> None:
    limit = (sim.saturation_strain or 0.0) * 1e6
    out, err = printed(0, ["calibrate", "fit", str(data), "--layout", "I", "--saturation", f"{limit * 0.9999999}"])
    assert "57 loaded and 20 unloaded rows, 3 gauges" in out
    assert "drift tare, loss huber, load directions 0.5 degree" in out
    assert "condition number 2.4" in out
    assert len([line for line in out.splitlines() if line.startswith("   4.400")]) >= 17
    for row in np.flatnonzero(sim.true_outlier):
        assert f"outlier: line {row + 2}: " in out
    assert "saturated: line 17: SG2 is left out" in out
    assert "1 degree costs about 1 % of P and 1 degree of phi or theta" in out
    assert err == ""


def test_the_file_has_the_digits_that_were_told_and_gives_the_covariance_again(
    data: Path, sim: Simulated, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cal.toml"
    limit = (sim.saturation_strain or 0.0) * 0.9999999e6
    words = (data, "-o", path, "--layout", "I", "--serial", 7, "--date", "2025-12-31", "--saturation", limit)
    record = fitted(capsys, *words)
    calibration, fit = read_calibration(path), read_fit(path)
    assert fit is not None
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
    covariance = covariance_of_estimate(
        calibration.C, calibration.covariance_strain2, fit.parameter_covariance(), [1.0, 0.0, -2.0]
    )
    assert 0.005 < np.sqrt(covariance[0, 0]) < 0.05
    table = tomllib.loads(path.read_text())["fit"]
    assert (table["rows"], table["unloaded_rows"], table["drift"], table["bad_lines"]) == (77, 20, "tare", [])
    assert table["outlier_lines"] == [int(row) + 2 for row in np.flatnonzero(sim.true_outlier)]
    # S and N alone give nearly the same.
    short = replace_in(path, "parameter_covariance_microstrain2")
    again = read_fit(short)
    assert again is not None
    assert again.parameter_covariance().shape == (3, 4, 3, 4)


def test_the_last_bits_of_the_arithmetic_change_no_file(
    sim: Simulated, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another numpy gives other last bits. Here they come with the data: 1e-14 of each reading."""
    disturbed = np.random.default_rng(1).uniform(-1e-14, 1e-14, sim.strain.shape)
    files = []
    for name, strain in (("one", sim.strain), ("other", sim.strain * (1.0 + disturbed))):
        folder = tmp_path / name
        folder.mkdir()
        write_measurements(folder / "grooves.csv", measured(replace(sim, strain=strain)))
        fitted(capsys, folder / "grooves.csv", "-o", folder / "cal.toml", "--date", "2025-12-31", *LIMIT)
        files.append(read_calibration(folder / "cal.toml"))
    assert not np.array_equal(sim.strain, sim.strain * (1.0 + disturbed))
    assert files[0].record() == files[1].record()
    for part in ("C", "offset_strain", "covariance_strain2"):
        assert np.array_equal(getattr(files[0], part), getattr(files[1], part)), part


def replace_in(path: Path, name: str) -> Path:
    """The same file without one key of [fit]."""
    import msgspec

    content = tomllib.loads(path.read_text())
    del content["fit"][name]
    other = path.with_name("other.toml")
    other.write_bytes(msgspec.toml.encode(content))
    return other


def test_bad_rows_are_told_and_strict_refuses(data: Path, tmp_path: Path, printed: Printed) -> None:
    lines = data.read_text().splitlines()
    lines[9] = lines[9].replace(",", ",x", 1)
    data.write_text("\n".join(lines))
    path = tmp_path / "cal.toml"
    out, err = printed(0, ["calibrate", "fit", str(data), "-o", str(path), *LIMIT])
    assert "bad: line 10: SG1 is 'x" in out
    assert "1 bad rows were not used" in err
    path.unlink()
    assert "no file is written" in printed(1, ["calibrate", "fit", str(data), "-o", str(path), "--strict", *LIMIT]).err
    assert not path.exists()
    data.write_text(lines[0] + "\n" + lines[9])
    assert "no row can be used; the first: line 2: SG1 is 'x" in printed(2, ["calibrate", "fit", str(data)]).err


def test_what_cannot_be_seen_is_refused(data: Path, sim: Simulated, capsys: pytest.CaptureFixture[str]) -> None:
    heavy = (sim.P_newtons == 4.4) & (sim.theta_rad < 1.6) & (sim.phi_rad < 1.6) & ~sim.true_outlier
    some = measured(sim)
    names = ("strain", "P_newtons", "phi_rad", "theta_rad", "t_s", "line")
    write_measurements(data, replace(some, **{name: getattr(some, name)[heavy] for name in names}))
    assert main(["calibrate", "fit", str(data)]) == 2
    assert "F1 + F3 is 4.4 N in every row, so that an offset cannot be told" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("strain", "load", "text"),
    [(1e-6, 1.0, "(multiply SG1.. by 1e6)"), (1.0, 1000.0 / 9.80665, "(multiply P_N by 0.00980665)")],
)
def test_strain_in_si_units_and_loads_in_grams_are_refused_with_the_factor(
    strain: float, load: float, text: str, data: Path, sim: Simulated, printed: Printed
) -> None:
    given = replace(measured(sim), strain=strain * sim.strain, P_newtons=load * sim.P_newtons)
    write_measurements(data, given)
    assert text in printed(2, ["calibrate", "fit", str(data), "--saturation", str(strain * 853.85)]).err


def test_load_sense_layout_and_notes(sim: Simulated, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = tmp_path / "push.csv"
    mode = np.where(sim.P_newtons > 0.0, 0, 2).astype(np.int8)
    write_measurements(data, replace(measured(sim), mode=mode, temperature_degC=np.full(77, 23.0)))
    path = tmp_path / "cal.toml"
    record = fitted(capsys, data, "-o", path, "--layout", "II'", *LIMIT)
    assert record["load_sense"] == "push"
    assert (read_calibration(path).reference_temperature_degC, read_calibration(path).layout_code) == (23.0, 255)
    assert any("opposite to beam theory" in note for note in record["notes"])
    assert "all rows at 23 degC: what a warm finger reads is not known" in record["notes"]
    assert fitted(capsys, data, "--sense", "pull", *LIMIT)["load_sense"] == "pull"


def test_a_fit_table_of_somebody_else_does_not_hinder(data: Path, tmp_path: Path) -> None:
    from tipforce.errors import InputError

    path = tmp_path / "cal.toml"
    assert main(["calibrate", "fit", str(data), "-o", str(path), "-q", *LIMIT]) == 0
    text = path.read_text()
    path.write_text(text.replace("normal_matrix = ", "matrix = ").replace("parameter_covariance_", "covariance_"))
    assert read_calibration(path).gauges == 3
    with pytest.raises(InputError, match=r"cal\.toml: fit: parameter_covariance_microstrain2 is missing"):
        read_fit(path)
    path.write_text(text.replace("condition_number = ", "condition_number = inf\nof_somebody_else = nan #", 1))
    record = read_fit(path)
    assert record is not None
    assert record.condition_number == math.inf
    path.write_text(text[: text.index("[fit]")])
    assert read_fit(path) is None
    path.write_text(text[: text.index("[fit]")] + "[fit]\ndof = 1.0\nresidual_covariance_microstrain2 = [[1.0]]\n"
                    "normal_matrix = [[1.0]]\n")  # fmt: skip
    with pytest.raises(InputError, match=r"residual_covariance_microstrain2 must be \(3, 3\)"):
        read_fit(path)


def test_prior_for_few_loads(sim: Simulated, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some = measured(sim)
    names = ("strain", "P_newtons", "phi_rad", "theta_rad", "t_s", "line")
    data = tmp_path / "few.csv"
    write_measurements(data, replace(some, **{name: getattr(some, name)[:8] for name in names}))
    words = (data, "--prior", "beam", "--layout", "I", "--noise", 1, "--drift", "none")
    record = fitted(capsys, *words)
    C = np.array(record["matrix_newtons_per_strain"])
    assert np.abs(C @ sim.true_A - np.eye(3)).max() < 0.3
    assert main(["calibrate", "fit", *map(str, words)]) == 0
    assert "prior: beam theory within 10%" in capsys.readouterr().out
