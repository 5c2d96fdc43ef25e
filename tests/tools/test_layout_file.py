"""Layout files with gauges anywhere, and `tipforce calibrate budget`: read, written, used, refused."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from canopen_device.core.node import Device
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration, write_calibration
from tipforce.sensor.contact.redundancy import weighted_inverse
from tipforce.sensor.structure.layouts import LAYOUTS
from tipforce.sensor.structure.strain import FABRICATED, Gauge, GaugePosition, Geometry, gauge_matrix, strain_matrix
from tipforce.sources import layout_file
from tipforce.sources.layout_file import layout_text, read_layout, write_layout
from tools.rig import Printed, run_node, source_of

Budget = Callable[[str], dict[str, dict[str, Any]]]
ODD = Geometry(0.011, 0.017, 0.019, 0.0005, 0.0007, 0.009, 2.0e11)
PLACES: tuple[Gauge, ...] = (
    GaugePosition("H", "left", 1.08e-3),
    GaugePosition("H", "right", 7.123456789e-3, "upper"),
    "U",
    GaugePosition("V", "left", 16.5e-3),
)
CAUSES = [
    "gauge noise", "quantisation", "gain", "offset", "temperature, common", "temperature, mismatch",
    "hysteresis", "creep", "calibration noise", "load angle", "gravity", "gauge position", "off-axis load", "total",
]  # fmt: skip
A = strain_matrix(FABRICATED, "II")
CASE_II = Calibration(weighted_inverse(A, np.eye(3)), np.zeros(3), 4e-12 * np.eye(3), layout_code=2, pull=True)


@pytest.mark.parametrize("geometry", [FABRICATED, ODD])
@pytest.mark.parametrize("gauges", [PLACES[:3], PLACES[1:], tuple(LAYOUTS["II"])])
def test_what_is_written_reads_back(tmp_path: Path, geometry: Geometry, gauges: tuple[Gauge, ...]) -> None:
    geometry = replace(geometry, d_m=17e-3)
    path = tmp_path / "layout.toml"
    write_layout(path, geometry, gauges, gauge_length_m=1e-3, comment="one\ntwo")
    assert path.read_text().startswith("# one\n# two\npoints = [")
    found_geometry, found = read_layout(str(path))
    assert found_geometry == geometry
    np.testing.assert_allclose(
        gauge_matrix(found_geometry, found), gauge_matrix(geometry, gauges), rtol=1e-13, atol=0.0
    )
    assert [isinstance(gauge, str) for gauge in found] == [isinstance(gauge, str) for gauge in gauges]


def test_the_examples_of_the_documentation(tmp_path: Path) -> None:
    blocks = [block for block in (layout_file.__doc__ or "").split("\n\n") if block.startswith("    ")]
    texts = [blocks[0], "\n\n".join(blocks[1:])]
    for number, text in enumerate(texts):
        path = tmp_path / f"{number}.toml"
        path.write_text(text)
        geometry, gauges = read_layout(str(path))
        assert geometry == FABRICATED
        assert len(gauges) == 3
    assert gauges == (GaugePosition("H", "left", 1.08e-3), GaugePosition("H", "right", 1.08e-3), "U")


WRONG_PLACES = [
    ('{ beam = "X", side = "left", position_mm = 1 }', "points[3].beam is 'X': invalid enum value 'X'; allowed: H, V"),
    (
        '{ beam = "H", side = "up", position_mm = 1 }',
        "points[3].side is 'up': invalid enum value 'up'; allowed: left, right",
    ),
    ('{ beam = "H", side = "left" }', "points[3].position_mm is missing"),
    ('{ beam = "H", side = "left", position_mm = 1, at = 2 }', "points[3].at: no such key; allowed: beam, side"),
    ('{ beam = "H", side = "left", position_mm = 15.1 }', "allowed is 0 to 0.015 m from the joint"),
    ('{ beam = "V", side = "left", position_mm = -0.1 }', "allowed is 0 to 0.015 m from the joint"),
    ('{ beam = "V", side = "left", position_mm = nan }', "allowed is 0 to 0.015 m from the joint"),
    ('{ beam = "V", side = "left", position_mm = 1, face = "upper" }', "face = 'upper' on beam V: allowed on beam H"),
    ('{ beam = "V", side = "right", position_mm = 15 }', "V right 15.00 is given more than once"),
    ('"X"', "gauge point 'X' is not known"),
]


def test_the_node_reads_what_the_layout_says(tmp_path: Path, devices: list[Device]) -> None:
    path = tmp_path / "layout.toml"
    write_layout(path, ODD, PLACES)
    assert run_node("-q", "--layout", path) == 0
    (device,) = devices
    assert device.od.get(0x1018, 2) == 0x54500104, "a product code for four gauges"
    source = source_of(device)
    np.testing.assert_allclose(source.rows, gauge_matrix(ODD, PLACES), rtol=1e-13)


def test_a_layout_with_a_geometry(tmp_path: Path) -> None:
    path = tmp_path / "layout.toml"
    wanted = replace(FABRICATED, r_m=0.02)
    lines = "\n".join(f"{name} = {value}" for name, value in asdict(wanted).items())
    path.write_text(f'points = ["L", "R", "U"]\n[geometry]\n{lines}\ndrawing = "A-12"\n')
    assert read_layout(str(path)) == (wanted, ("L", "R", "U")), "and may say more"


WRONG_TEXTS = [
    ("", "layout.toml: points is missing"),
    ('points = ["K_H"]', "a layout of 1 gauge points: allowed are 3 to 8"),
    ('points = ["K_H", "S_H", "X"]', "gauge point X is not known: allowed are L, R"),
    ('points = ["K_H", "S_H", "K_H"]', "K_H is given more than once"),
    ("points = 5", "points is 5: allowed is a list"),
    ('points = ["L", "R", "U"]\ngauges = 3', "gauges: no such key; allowed: points, gauge_length_mm, geometry, bridge"),
    ('points = ["L", "R", "U"]\n[geometry]\nr_m = "x"', "geometry.a_m is missing"),
    ('points = ["L", "R", 5]', "points[3] is 5: expected str | table, got int"),
    ('points = ["L", "R", "U"]\ngeometry = 5', "geometry is 5: allowed is a table"),
    (
        'points = ["L", "R", "U"]\n[geometry]\nr_mm = 0.01',
        "geometry.r_mm: no such key; did you mean r_m? allowed: a_m, d_m",
    ),
    ("points = [", "layout "),
    *(
        (f'points = ["K_H", "S_H", "U"]\ngauge_length_mm = {length}', "positive length")
        for length in (0, -1, "nan", "inf")
    ),
    *(
        (
            layout_text(FABRICATED, ("K_H", "S_H", "U")).replace("width_m = 0.01", f"width_m = {width}"),
            f"geometry width_m = {width}: allowed is 1e-06 to 10 m",
        )
        for width in ("0.0", "-1.0", "nan", "1e+300")
    ),
    *((f'points = ["U", {{ beam = "H", side = "right", position_mm = 2 }}, {point}]', m) for point, m in WRONG_PLACES),
]


@pytest.mark.parametrize(("text", "message"), WRONG_TEXTS)
def test_a_layout_file_that_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "layout.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_layout(str(path))
    assert message.replace("'", "") in str(caught.value).replace("'", "")
    assert str(path) in str(caught.value)


@pytest.fixture
def budget(printed: Printed) -> Budget:
    """The records of `calibrate budget` with these words, by their cause."""
    return lambda words: {one["cause"]: one for one in printed(0, f"calibrate budget {words} --json").records}


def test_the_papers_case_over_the_pad(budget: Budget) -> None:
    found = budget("")
    assert list(found) == CAUSES
    total = found["total"]
    assert total["share_P_percent"] == pytest.approx(100.0)
    assert total["share_theta_percent"] == pytest.approx(100.0)
    assert 0.02 < total["u_P_N"] < total["u_P_N_max"] < 0.1
    assert sum(found[cause]["share_P_percent"] for cause in CAUSES[:-1]) == pytest.approx(100.0, abs=0.1)
    assert found["gauge position"]["u_P_N"] == 0.0
    assert budget("--gravity 1")["gravity"]["u_phi_deg_max"] == pytest.approx(1.0, abs=0.01)


def test_each_flag_moves_its_row_alone(budget: Budget) -> None:
    load = "--uncalibrated --load 2 --phi -80 --theta 100"
    before = budget(load)
    for flag, cause in (
        ("noise", "gauge noise"), ("resolution", "quantisation"), ("gain", "gain"), ("offset", "offset"),
        ("hysteresis", "hysteresis"), ("creep", "creep"), ("gauge-shift", "gauge position"),
        ("off-axis", "off-axis load"),
    ):  # fmt: skip
        after = budget(f"{load} --{flag} 0")
        assert [name for name in CAUSES[:-1] if after[name]["u_P_N"] != before[name]["u_P_N"]] == [cause]
        assert after[cause]["u_P_N"] == after[cause]["u_theta_deg"] == 0.0
    warm = budget(f"{load} --temperature 2")
    assert warm["temperature, common"]["u_P_N"] == pytest.approx(2.0 * before["temperature, common"]["u_P_N"])
    assert budget("--load-angle 0")["load angle"]["u_P_N"] == 0.0


def test_a_calibration_file(budget: Budget, tmp_path: Path) -> None:
    path, load = tmp_path / "cal.toml", "--load 2 --phi 80 --theta 100"
    write_calibration(path, CASE_II)
    found = budget(f"{path} {load}")
    P_variance = np.array([1.0, 0.0, 0.0]) @ CASE_II.covariance_F @ np.array([1.0, 0.0, 0.0])
    assert found["gauge noise"]["u_P_N"] == pytest.approx(np.sqrt(P_variance), rel=0.05)  # phi is nearly 90 degrees
    assert list(found) == CAUSES
    by_name = budget(f"--layout II --noise 2 {load}")
    assert by_name["gauge noise"]["u_P_N"] == pytest.approx(found["gauge noise"]["u_P_N"], rel=1e-6)
    # REAL32 in the file, the load sense in theta alone.
    pushed = budget(f"{path} --sense push {load}")
    assert pushed["gauge noise"]["u_P_N"] == found["gauge noise"]["u_P_N"]
    assert pushed["gauge noise"]["u_theta_deg"] != found["gauge noise"]["u_theta_deg"]


def test_five_gauges_of_which_only_the_calibration_is_known(budget: Budget, printed: Printed, tmp_path: Path) -> None:
    five = strain_matrix(FABRICATED, ("K_H", "S_H", "U", "L", "T"))
    calibration = Calibration(weighted_inverse(five, np.eye(5)), np.zeros(5), 1e-12 * np.eye(5))
    path = str(tmp_path / "cal.toml")
    write_calibration(path, calibration)
    captured = printed(0, f"calibrate budget {path} --noise 1")
    assert "no row for off-axis load: the positions of the gauges are unknown" in captured.err
    assert "off-axis" not in captured.out
    layout = tmp_path / "five.toml"
    layout.write_text('points = ["K_H", "S_H", "U", "L", "T"]\n')
    assert "off-axis load" in budget(f"{path} --layout {layout}")
    assert "it has 3 gauges, the calibration 5" in printed(2, f"calibrate budget {path} --layout I").err


def test_text_tells_where_first_order_does_not_hold(printed: Printed) -> None:
    captured = printed(0, "calibrate budget --load 1 --phi 0 --theta 91")
    lines = captured.out.splitlines()
    assert lines[0].split() == ["cause", "u(P)", "N", "share", "u(phi)", "deg", "share", "u(theta)", "deg", "share"]
    assert lines[-1].startswith("total")
    assert len(lines) == 1 + len(CAUSES)
    assert "first order does not hold for theta at 1 of 1 loads" in captured.err
    assert "opposite to theta" not in captured.err
    assert "or --sense pull" in printed(0, "calibrate budget --phi 0 --theta 0").err
    assert "opposite to theta" not in printed(0, "calibrate budget --phi 90 --theta 0 --sense pull").err
    captured = printed(0, "calibrate budget -q")
    assert captured.err == ""
    assert captured.out.splitlines()[0].split().count("max") == 3


@pytest.mark.parametrize(("name", "head"), [("b.png", b"\x89PNG"), ("b.svg", b"<?xml")])
def test_plot(printed: Printed, tmp_path: Path, name: str, head: bytes) -> None:
    path = tmp_path / name
    printed(0, f"calibrate budget -o {path}")
    assert path.read_bytes().startswith(head)
