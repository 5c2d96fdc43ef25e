"""Calibration files and files of measurements: read, written, refused with the place."""

import binascii
import itertools
import struct
import tomllib
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from host.bus_with_nodes import ROUNDING_STRAIN2, beam_calibration
from tipforce.dictionary import table, table_objects
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration, read_calibration, write_calibration
from tipforce.host.configuration.measurements import MODES, BadRow, Measurements, read_measurements

UNCHECKED = patch.object(Calibration, "check", lambda _self: None)
"""Any numbers survive a file and a record, those that no sensor can have too."""
REAL32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
U32 = st.integers(0, 0xFFFFFFFF)
DATE = st.one_of(st.just(0), st.dates().map(lambda d: d.year * 10000 + d.month * 100 + d.day))
MATRIX = "[[1e4, 0, 0], [0, 2e4, 0], [0, 0, 3e4]]"
GOOD = f"""[calibration]
matrix_newtons_per_strain = {MATRIX}
offset_microstrain = [1, 2.5, -3]
covariance_microstrain2 = [[0.25, 0, 0], [0, 0.25, 0], [0, 0, 0.25]]
load_sense = "pull"
"""
HEADER = "SG1,SG2,SG3,P_N,phi_deg,theta_deg"


@st.composite
def records(draw: st.DrawFn) -> bytes:
    """Any record of finite numbers that a file has words for, n = 3 to 8."""
    n = draw(st.integers(table.MIN_GAUGES, table.MAX_GAUGES))
    fields: list[float] = []
    for index, sub, kind in table_objects.staged(n):
        if kind == "f":
            fields.append(draw(REAL32))
        elif index == 0x2102:
            fields.append(draw({1: U32, 2: DATE, 4: st.sampled_from([1, 2, 3, 255])}[sub]))
        else:
            fields.append(draw(st.integers(0, 1)))
    return struct.pack("<" + "".join(kind for _, _, kind in table_objects.staged(n)), *fields)


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(records())
def test_a_record_survives_numbers_and_a_file(tmp_path: Path, record: bytes) -> None:
    found = Calibration.from_record(record)
    assert (found.record(), found.crc32()) == (record, binascii.crc32(record))
    path = tmp_path / "cal.toml"
    write_calibration(path, found)
    with UNCHECKED:
        assert read_calibration(path).record() == record


def test_an_offset_between_two_real32_survives_a_file(tmp_path: Path) -> None:
    """Half way between two REAL32 numbers the scaling to microstrain would decide: the CRC-32 must not depend on it."""
    ties = [struct.unpack("<f", struct.pack("<I", 0x358637BD + k))[0] for k in range(100)]
    for low, high in itertools.pairwise(ties):
        tie = (low + high) / 2
        calibration = beam_calibration(offset_strain=np.array([tie, np.nextafter(tie, 0), np.nextafter(tie, 1)]))
        path = tmp_path / "cal.toml"
        write_calibration(path, calibration)
        assert read_calibration(path).record() == calibration.record()


def test_its_arrays_are_its_own() -> None:
    """What is prepared from a calibration, as by ``estimate``, stays true."""
    C = np.array(beam_calibration().C)
    calibration = beam_calibration(C=C)
    with pytest.raises(ValueError, match="read-only"):
        calibration.C[0, 0] = 1.0
    before = calibration.C.copy()
    C *= 2.0
    np.testing.assert_array_equal(calibration.C, before)


def test_covariance_of_force() -> None:
    calibration = beam_calibration()
    np.testing.assert_allclose(calibration.covariance_F, ROUNDING_STRAIN2 * calibration.C @ calibration.C.T)


@pytest.mark.parametrize("length", [0, 105, 106, 157, 159, 1000])
def test_a_record_of_no_length(length: int) -> None:
    allowed = "is of version 1: allowed is version 2" if length == 106 else ": with 3 gauges it has 158"
    with pytest.raises(InputError, match=rf"a calibration record of {length} bytes ?{allowed}"):
        Calibration.from_record(bytes(length))


def read_text(tmp_path: Path, text: str) -> Calibration:
    path = tmp_path / "cal.toml"
    path.write_text(text, encoding="utf-8")
    return read_calibration(path)


def test_a_short_file_by_hand(tmp_path: Path) -> None:
    found = read_text(tmp_path, GOOD + 'date = 2026-01-02\nlayout = "II"\nserial = 5\ntip_radius_m = 0.01\n')
    np.testing.assert_array_equal(found.C, np.diag([1e4, 2e4, 3e4]))
    np.testing.assert_allclose(found.offset_strain, [1e-6, 2.5e-6, -3e-6])
    np.testing.assert_allclose(found.covariance_strain2, np.eye(3) * 0.25e-12)
    assert (found.serial, found.date, found.layout_code, found.pull) == (5, 20260102, 2, True)
    assert read_text(tmp_path, GOOD).layout_code == table.CUSTOM_LAYOUT


def test_a_number_edited_by_hand_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "cal.toml"
    write_calibration(path, beam_calibration())
    text = path.read_text().replace("serial = 7", "serial = 8")
    with pytest.raises(InputError) as caught:
        read_text(tmp_path, text)
    assert f"crc32 is 0x{beam_calibration().crc32():08X}" in str(caught.value)
    assert f"0x{beam_calibration(serial=8).crc32():08X}" in str(caught.value)
    assert "take out the crc32 line" in str(caught.value)
    without = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("crc32"))
    assert read_text(tmp_path, without).serial == 8
    assert read_text(tmp_path, path.read_text().replace("crc32 = ", "#").replace("serial = 8", "serial = 7"))


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (MATRIX, "[[1, 0], [0, 2.0], [0, 0]]", r"matrix: shape \(3, 2\), allowed \(3, 3\)"),
        (MATRIX, "[[1, 0, 0], [0, 2], [0]]", r"the rows of matrix_\w+ differ in length"),
        (MATRIX, '[["a"]]', r"matrix_newtons_per_strain is \[\['a'\]\]: expected float, got str at \[0\]\[0\]"),
        ("[1, 2.5, -3]", "3", r"calibration\.offset_microstrain is 3: expected array, got int"),
        ('"pull"', '"sideways"', r"load_sense is 'sideways', allowed: push, pull"),
        ("load_sense", "sense", r"calibration\.sense: no such key; did you mean load_sense\? allowed"),
        ('"pull"', '"pull"\nlayout = "IV"', r"layout is 'IV', allowed: I, II, III, custom"),
        ('"pull"', '"pull"\nserial = -4', r"0x2102:01: -4 does not fit UNSIGNED32"),
        ('"pull"', '"pull"\nserial = 1.5', r"calibration\.serial is 1\.5: expected int, got float"),
        ('"pull"', '"pull"\ntip_radius_m = 1e300', r"0x2110:01: 1e\+300 does not fit REAL32"),
        ('"pull"', '"pull"\ndate = "today"', r"calibration\.date is 'today': expected date, got str"),
        ('"pull"', '"pull"\ndate = 2026-01-02T03:04:05', r"date is 2026-01-02T03:04:05: expected date, got datetime"),
        ('"pull"', '"pull"\ncrc32 = "0x0"', r"crc32 is 0x0, but the numbers give 0x[0-9A-F]{8}"),
        ("[calibration]", "[calibration", r"cal\.toml: "),
        ("[calibration]", "[other]", r"cal\.toml: other: no such key; allowed: calibration, fit"),
        ("load_sense", "# \ufffd\nload_sense =", r"cal\.toml: "),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path: Path, old: str, new: str, text: str) -> None:
    assert old in GOOD
    with pytest.raises(InputError, match=text) as caught:
        read_text(tmp_path, GOOD.replace(old, new))
    assert str(caught.value).startswith(f"calibration {tmp_path / 'cal.toml'}: ")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"layout_code": 7}, r"layout code 7, allowed: 1, 2, 3, 255"),
        ({"date": 7}, r"date 7, allowed is YYYYMMDD of a day that there was, or 0"),
        ({"date": 20260230}, r"date 20260230, allowed is YYYYMMDD"),
    ],
)
def test_what_a_file_has_no_words_for_is_not_written(tmp_path: Path, changes: dict[str, int], text: str) -> None:
    """Such numbers may stand in a node: written as something else, the file would not read back."""
    with pytest.raises(InputError, match=text):
        write_calibration(tmp_path / "cal.toml", beam_calibration(**changes))
    assert not (tmp_path / "cal.toml").exists()


VERSION_2: dict[str, Any] = {
    "calibrated_force_newtons": 5.0, "overload_force_newtons": 19.5, "temperature_min_degC": -5.0,
    "temperature_max_degC": 45.0, "model_uncertainty": 0.0025, "converter_limit_strain": np.array([2e-3, 2.5e-3, 3e-3]),
    "offset_temperature_strain_per_K": np.array([1e-6, -2e-6, 0.0]), "gain_temperature_per_K": -3e-4,
    "redundancy_limit": 0.0,
}  # fmt: skip


def test_the_fields_of_version_2_survive_record_and_file(tmp_path: Path) -> None:
    calibration = beam_calibration(**VERSION_2)
    record = calibration.record()
    assert record[:106] == beam_calibration().record()[:106]
    expected = (5.0, 19.5, -5.0, 45.0, 0.0025, 2e-3, 2.5e-3, 3e-3, 1e-6, -2e-6, 0.0, -3e-4, 0.0)
    np.testing.assert_allclose(struct.unpack("<13f", record[106:]), expected, rtol=1e-6)
    write_calibration(tmp_path / "cal.toml", calibration)
    for found in (Calibration.from_record(record), read_calibration(tmp_path / "cal.toml")):
        assert found.record() == record
        for name, value in VERSION_2.items():
            np.testing.assert_allclose(getattr(found, name), value, rtol=1e-6, err_msg=name)


def test_a_file_of_version_1_is_read_by_its_own_crc(tmp_path: Path) -> None:
    crc = binascii.crc32(beam_calibration().record()[:106])
    write_calibration(tmp_path / "cal.toml", beam_calibration())
    new = {*VERSION_2, "converter_limit_microstrain", "offset_temperature_microstrain_per_K"}
    content = tomllib.loads((tmp_path / "cal.toml").read_text())["calibration"]
    old = {name: value for name, value in content.items() if name not in new} | {"crc32": f"0x{crc:08X}"}
    found = read_text(tmp_path, msgspec.toml.encode({"calibration": old}).decode())
    assert found.record() == beam_calibration().record()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"offset_strain": np.array([0.0, -1e39, 0.0])}, r"0x2101:02: -1e\+39 does not fit REAL32: allowed are"),
        ({"serial": -1}, r"0x2102:01: -1 does not fit UNSIGNED32: allowed are 0 to 4294967295"),
        ({"serial": 1 << 32}, r"0x2102:01: 4294967296 does not fit UNSIGNED32"),
        ({"layout_code": 256}, r"0x2102:04: 256 does not fit UNSIGNED8: allowed are 0 to 255"),
        ({"model_uncertainty": -0.1}, "calibration model_uncertainty: -0.1, allowed is 0"),
        ({"overload_force_newtons": np.nan}, "calibration overload_force_newtons: nan is not finite"),
        ({"converter_limit_strain": np.array([1.0, -1.0, 1.0])}, "calibration converter_limit_strain: -1, allowed"),
        ({"gain_temperature_per_K": np.inf}, "calibration gain_temperature_per_K: inf is not finite"),
        ({"temperature_min_degC": 3.0, "temperature_max_degC": 2.0}, "temperature_min_degC: 3 is above"),
        ({"theta_min_deg": 170.0, "theta_max_deg": 10.0}, "theta_min_deg: 170 is above"),
        ({"converter_limit_strain": np.ones(2)}, r"converter_limit_strain: shape \(2,\), allowed is \(3,\)"),
    ],
)
def test_what_no_record_holds_and_no_node_takes(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        beam_calibration(**changes).check()


def read(tmp_path: Path, text: str | bytes, loads: bool = True) -> Measurements:
    path = tmp_path / "data.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_measurements(path, loads=loads)


def test_plain_rows(tmp_path: Path) -> None:
    found = read(tmp_path, HEADER + "\n1,-2.5,3e2,4.4,90,45\n0,0,0,0,0,0\n")
    np.testing.assert_allclose(found.strain, np.array([[1, -2.5, 300], [0, 0, 0]]) * 1e-6)
    loads = {"P_newtons": np.array([4.4, 0.0]), "phi_rad": np.radians([90, 0]), "theta_rad": np.radians([45, 0])}
    for name, values in loads.items():
        np.testing.assert_allclose(getattr(found, name), values)
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
    for name, values in (("t_s", [0, 1, 1]), ("weight", [4, 1, 1]), ("temperature_degC", [21.5, 22, 22])):
        assert getattr(found, name).tolist() == values
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
    rows = "\n".join(f"1,2,3,{t}" for t in [0, 1, 2, 99, 3, 4, 2.5, 5, 5])
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
        (
            HEADER.encode() + b"," + 200_000 * b"x" + b"\n1,2,3,4,5,6,7\n",
            "line 1: field larger than field limit (131072)",
        ),
        (HEADER.encode() + b',node\n1,2,3,4,5,6,"7' + 30_000 * b"\n1,2,3,4,5,6,7", "do the quotes match?"),
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


def test_gauge_readings_alone(tmp_path: Path) -> None:
    found = read(tmp_path, "SG1,SG2,SG3,SG4\n1,2,3,4\n", loads=False)
    assert found.strain.shape == (1, 4)
    assert found.P_newtons is None
    assert not found.unloaded.any()
    with pytest.raises(InputError, match="P_N, phi_deg, theta_deg is missing"):
        read(tmp_path, "SG1,SG2,SG3\n1,2,3\n", loads=True)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.text(alphabet='0123456789.,-e"_nap ;', max_size=25), min_size=1, max_size=12))
def test_each_line_is_a_row_or_a_reason(tmp_path_factory: pytest.TempPathFactory, lines: list[str]) -> None:
    path = tmp_path_factory.mktemp("rows") / "data.csv"
    path.write_text("\n".join(["SG1,SG2,SG3,t_s", "1,2,3,0", *lines, "1,2,3,1e99"]) + "\n")
    found = read_measurements(path, loads=False)
    assert sorted([*found.line.tolist(), *(row.line for row in found.bad)]) == list(range(2, len(lines) + 4))
    assert np.isfinite(found.strain).all()
