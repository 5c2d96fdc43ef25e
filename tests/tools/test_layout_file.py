"""Layout files with gauges anywhere along the beams: read, written, and used by the node and by the calibration."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from canopen_device.core.node import Device
from tipforce.errors import InputError
from tipforce.sensor.structure.gauges import Gauge, GaugePosition, gauge_matrix
from tipforce.sensor.structure.geometry import FABRICATED, Geometry
from tipforce.sensor.structure.layouts import LAYOUTS
from tipforce.sources import layout_file
from tipforce.sources.layout_file import layout_text, read_layout, write_layout
from tipforce.sources.simulated import SimulatedSource
from tools.rig import run_node, source_of

ODD = Geometry(0.011, 0.017, 0.019, 0.0005, 0.0007, 0.009, 2.0e11)
PLACES: tuple[Gauge, ...] = (
    GaugePosition("H", "left", 1.08e-3),
    GaugePosition("H", "right", 7.123456789e-3, "upper"),
    "U",
    GaugePosition("V", "left", 16.5e-3),
)


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


def test_the_old_form_is_read_as_before(tmp_path: Path) -> None:
    path = tmp_path / "layout.toml"
    path.write_text('points = ["K_H", "S_H", "U"]\n')
    assert read_layout(str(path)) == (FABRICATED, ("K_H", "S_H", "U"))


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


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="allowed are 3 to 8"):
        layout_text(FABRICATED, PLACES[:2])
    with pytest.raises(InputError, match="absent does not exist; create it first"):
        write_layout(tmp_path / "absent" / "layout.toml", FABRICATED, PLACES[:3])


def test_the_node_reads_what_the_layout_says(tmp_path: Path, devices: list[Device]) -> None:
    path = tmp_path / "layout.toml"
    write_layout(path, ODD, PLACES)
    assert run_node("-q", "--layout", path) == 0
    (device,) = devices
    assert device.od.get(0x1018, 2) == 0x54500104, "a product code for four gauges"
    source = source_of(device)
    assert isinstance(source, SimulatedSource)
    np.testing.assert_allclose(source.rows, gauge_matrix(ODD, PLACES), rtol=1e-13)


def test_a_layout_with_a_geometry(tmp_path: Path) -> None:
    path = tmp_path / "layout.toml"
    wanted = replace(FABRICATED, r_m=0.02)
    lines = "\n".join(f"{name} = {value}" for name, value in asdict(wanted).items())
    path.write_text(f'points = ["L", "R", "U"]\n[geometry]\n{lines}\ndrawing = "A-12"\n')
    assert read_layout(str(path)) == (wanted, ("L", "R", "U")), "and may say more"
    path.write_text(path.read_text().replace("r_m = 0.02", "r_m = -1"))
    with pytest.raises(InputError, match=r"layout .*layout\.toml: geometry r_m = -1\.0: allowed is 1e-06 to 10 m"):
        read_layout(str(path))


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
        (layout_text(FABRICATED, ("K_H", "S_H", "U")).replace("width_m = 0.01", f"width_m = {width}"), "1e-06 to 10 m")
        for width in ("0.0", "-1.0", "nan", "1e300")
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


def test_a_layout_that_is_a_directory(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"layout .*Is a directory"):
        read_layout(str(tmp_path))
