"""Measurements as CSV: what is read, what is refused, and that no row vanishes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.host.configuration.measurements import MODES, BadRow, Measurements, read_measurements, write_measurements

HEADER = "SG1,SG2,SG3,P_N,phi_deg,theta_deg"


def read(tmp_path: Path, text: str | bytes, loads: bool = True) -> Measurements:
    path = tmp_path / "data.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_measurements(path, loads=loads)


def test_plain_rows(tmp_path: Path) -> None:
    found = read(tmp_path, HEADER + "\n1,-2.5,3e2,4.4,90,45\n0,0,0,0,0,0\n")
    np.testing.assert_allclose(found.strain, np.array([[1, -2.5, 300], [0, 0, 0]]) * 1e-6)
    assert found.P_newtons is not None
    assert found.phi_rad is not None
    assert found.theta_rad is not None
    np.testing.assert_allclose(found.P_newtons, [4.4, 0.0])
    np.testing.assert_allclose(np.degrees(found.phi_rad), [90, 0])
    np.testing.assert_allclose(np.degrees(found.theta_rad), [45, 0])
    assert found.line.tolist() == [2, 3]
    assert found.unloaded.tolist() == [False, True]
    assert (found.t_s, found.temperature_degC, found.weight, found.mode) == (None, None, None, None)
    assert (found.bad, found.ignored_columns) == ((), ())


def test_every_column_in_any_order_with_other_names_and_line_ends(tmp_path: Path) -> None:
    text = (
        "\ufeffmode, t_s ,e2_ue,who,theta_deg,e1_ue,e3_ue,phi_deg,P_N,weight,temperature_degC\r\n"
        "pull,0,2,me,30,1,3,90,2.2,4,21.5\r\n"
        'tare,1,5,"a, b",,4,6,,,1,22\r\n'
        ",1,8,,30,7,9,-90,1,1,22\r\n\r\n"
    )
    found = read(tmp_path, text)
    np.testing.assert_allclose(found.strain * 1e6, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    assert found.mode is not None
    assert [MODES[code] if code >= 0 else "" for code in found.mode] == ["pull", "tare", ""]
    assert found.unloaded.tolist() == [False, True, False]
    assert found.t_s is not None
    assert found.t_s.tolist() == [0, 1, 1]
    assert found.weight is not None
    assert found.weight.tolist() == [4, 1, 1]
    assert found.temperature_degC is not None
    assert found.temperature_degC.tolist() == [21.5, 22, 22]
    assert found.ignored_columns == ("who",)
    assert found.bad == ()


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ("1,2,3,4.4,90", "5 cells, the header has 6"),
        ("1,2,3,4.4,90,45,7", "7 cells, the header has 6"),
        ("1,two,3,4.4,90,45", "SG2 is 'two', not a number"),
        ("1,,3,4.4,90,45", "SG2 is blank"),
        ("1,nan,3,4.4,90,45", "SG2 is 'nan', allowed are finite numbers"),
        ("1,2,inf,4.4,90,45", "SG3 is 'inf', allowed are finite numbers"),
        ("1_0,2,3,4.4,90,45", "SG1 is '1_0', allowed are finite numbers"),
        ("1,2e7,3,4.4,90,45", "SG2 is 2e7, allowed is -1e+06 to 1e+06 microstrain"),
        ("1,2,3,-4.4,90,45", "P_N is -4.4, allowed is 0 to 1e+09 N: turn phi_deg by 180 for the opposite force"),
        ("1,2,3,1e-300,90,45", "P_N is 1e-300, allowed is 0 (unloaded), or 1e-09 N and more"),
        ("1,2,3,4.4,,45", "phi_deg is blank"),
        ("1,2,3,4.4,900,45", "phi_deg is 900, allowed is -720 to 720 degrees"),
        ("1,2,3,4.4,90,N/A", "theta_deg is 'N/A', not a number"),
        ("", "the line is empty"),
        ('1,2,3,4.4,90,"45', "the quotes do not match (unexpected end of data)"),
        ("1,2,3,1,0,0,twist,1", "mode is 'twist', allowed: push, pull, tare or blank"),
        ("1,2,3,1,0,0,tare,1", "mode is tare, an unloaded reading, but P_N is 1"),
        ("1,2,3,1,0,0,pull,0", "weight is 0, allowed is 1e-09 to 1e+09 readings that the row is the mean of"),
    ],
)
def test_a_bad_row_is_named_and_the_others_stay(row: str, reason: str, tmp_path: Path) -> None:
    names, more = (",mode,weight", ",pull,1") if row.count(",") == 7 else ("", "")
    found = read(tmp_path, f"{HEADER}{names}\n1,2,3,4.4,90,45{more}\n{row}\n4,5,6,4.4,90,45{more}\n")
    assert found.bad == (BadRow(3, reason),)
    assert str(found.bad[0]) == f"line 3: {reason}"
    assert found.line.tolist() == [2, 4]


def test_a_clock_that_jumps_costs_one_row(tmp_path: Path) -> None:
    times = [0, 1, 2, 99, 3, 4, 2.5, 5, 5]
    rows = "\n".join(f"1,2,3,{t}" for t in times)
    found = read(tmp_path, f"SG1,SG2,SG3,t_s\n{rows}\n", loads=False)
    assert found.bad == (
        BadRow(5, "t_s is 99, after the 3 of line 6: times must not decrease"),
        BadRow(8, "t_s is 2.5, before the 4 of line 7: times must not decrease"),
    )
    assert found.line.tolist() == [2, 3, 4, 6, 7, 9, 10]


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "the file is empty"),
        (b"\n\n", "the file is empty"),
        (HEADER.encode(), "line 1 is a header without rows"),
        (HEADER.encode() + b"\n\n", "line 1 is a header without rows"),
        ("SG1,SG2".encode("utf-16"), "the text is UTF-16"),
        (HEADER.encode() + b"\n1,2,3,4,5,\xb0\n", "line 2: byte 0xB0 is not UTF-8"),
        (HEADER.encode() + b"\n1,2\0,3,4,5,6\n", "line 2: a NUL byte"),
        (HEADER.replace(",", ";").encode() + b"\n1;2\n", "separate columns by commas"),
        (b"SG1,SG2,SG2,P_N,phi_deg,theta_deg\n1,2,3,4,5,6\n", "the column SG2 occurs more than once"),
        (b"SG1,e1_ue,SG2,SG3,P_N,phi_deg,theta_deg\n1,2,3,4,5,6,7\n", "the column SG1 occurs more than once"),
        (b"SG1,SG2,SG4,P_N,phi_deg,theta_deg\n1,2,3,4,5,6\n", "SG1, SG2, SG4: allowed are SG1 to SGn without a gap"),
        (b"SG1,SG2,P_N,phi_deg,theta_deg\n1,2,3,4,5\n", "n = 3 to 8"),
        (b"P_N,phi_deg,theta_deg\n3,4,5\n", "gauge columns are missing"),
        (b"SG1,SG2,SG3,P_N,theta_deg\n1,2,3,4,5\n", "the column phi_deg is missing; present: SG1"),
    ],
)
def test_files_that_cannot_be_used(content: bytes, text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, content)
    assert text in str(caught.value)
    assert "data.csv" in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: No such file"):
        read_measurements(tmp_path / "none.csv", loads=True)


def test_gauge_readings_alone(tmp_path: Path) -> None:
    found = read(tmp_path, "SG1,SG2,SG3,SG4\n1,2,3,4\n", loads=False)
    assert found.strain.shape == (1, 4)
    assert found.P_newtons is None
    assert not found.unloaded.any()
    with pytest.raises(InputError, match="P_N, phi_deg, theta_deg is missing"):
        read(tmp_path, "SG1,SG2,SG3\n1,2,3\n", loads=True)


def test_written_rows_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    original = Measurements(
        line=np.arange(2, 7),
        strain=rng.normal(size=(5, 4)) * 1e-4,
        P_newtons=np.array([0.0, 1.1, 2.2, 4.4, 0.0]),
        phi_rad=rng.uniform(-3, 3, 5),
        theta_rad=rng.uniform(0, 3, 5),
        t_s=np.cumsum(rng.random(5)),
        temperature_degC=rng.normal(size=5),
        weight=rng.random(5),
        mode=np.array([2, 0, 1, -1, -1], dtype=np.int8),
        bad=(),
        ignored_columns=(),
    )
    path = tmp_path / "out.csv"
    write_measurements(path, original)
    again = read_measurements(path, loads=True)
    assert again.bad == ()
    for name in ("strain", "P_newtons", "phi_rad", "theta_rad", "t_s", "temperature_degC", "weight", "mode", "line"):
        np.testing.assert_allclose(getattr(again, name), getattr(original, name), rtol=1e-14)
    with pytest.raises(InputError, match="does not exist; create it first"):
        write_measurements(tmp_path / "no" / "out.csv", replace(original, P_newtons=None))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.text(alphabet='0123456789.,-e"_nap ;', max_size=25), min_size=1, max_size=12))
def test_each_line_is_a_row_or_a_reason(tmp_path_factory: pytest.TempPathFactory, lines: list[str]) -> None:
    path = tmp_path_factory.mktemp("rows") / "data.csv"
    path.write_text("\n".join(["SG1,SG2,SG3,t_s", "1,2,3,0", *lines, "1,2,3,1e99"]) + "\n")
    found = read_measurements(path, loads=False)
    assert sorted([*found.line.tolist(), *(row.line for row in found.bad)]) == list(range(2, len(lines) + 4))
    assert np.isfinite(found.strain).all()
