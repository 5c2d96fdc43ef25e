"""What is chosen of a log: times, layouts, grids, calibrations."""

import csv
import io
import os
from datetime import datetime
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from host.bus_with_nodes import beam_calibration, connected, finger, new_channel
from tipforce.host.configuration.calibration import Calibration, write_calibration
from tipforce.host.decoding.log import read_log
from tipforce.host.decoding.pdo_layout import node_layout
from tipforce.host.decoding.sample_table import Column, Table
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix
from tipforce_tools.decode.resample import Resampler
from tools.decode.logs import decode, log_lines, number, rows_of, write_log
from tools.rig import Printed

P = Column("P_N", "P", "real", 3, "N", 0)
PHI = Column("phi_deg", "phi", "real", 2, "degree", 1)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "run.log", log_lines(200, (1, 5), loss=0.0))


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ("0.05", "0.1"),
        ("1700000000.05", "1700000000.1"),
        ("2023-11-14T22:13:20.050Z", "2023-11-14T22:13:20.100+00:00"),
        (datetime.fromtimestamp(1_700_000_000.05).isoformat(), "0.1"),
    ],
)
def test_part_of_the_time(log: Path, tmp_path: Path, start: str, end: str) -> None:
    assert decode(log, "-o", tmp_path / "all.csv") == 0
    assert decode(log, "--from", start, "--to", end, "-o", tmp_path / "part.csv") == 0
    chosen = [row for row in rows_of(tmp_path / "all.csv") if 0.05 <= float(row["t_s"]) - 1_700_000_000 < 0.1]
    found = rows_of(tmp_path / "part.csv")
    assert len(found) == 100
    assert [row["t_s"] for row in found] == [row["t_s"] for row in chosen]


def test_relative_time_counts_from_the_first_log(tmp_path: Path) -> None:
    lines = log_lines(200, (5,), loss=0.0)
    names = [write_log(tmp_path / f"{k}.log", lines[k * 300 : (k + 1) * 300]) for k in range(2)]
    read, write = os.pipe()
    os.close(write)
    for first in (names[0], write_log(tmp_path / "empty.log", []), f"/dev/fd/{read}"):
        assert decode(first, *names, "--from", "0.15", "-j", 2, "-o", tmp_path / "part.csv") == 0
        assert len(rows_of(tmp_path / "part.csv")) == 50


def test_a_log_without_times(tmp_path: Path, printed: Printed) -> None:
    log = write_log(tmp_path / "screen.log", ["  can0  285   [8]  E8 03 64 00 C8 00 03 01", "  can0  705   [1]  00"])
    assert decode(log, "-o", tmp_path / "a.csv") == decode(log, "-o", f"{tmp_path}/data/") == 0
    assert {row["t_s"] for name in ("a.csv", "a.events.csv") for row in rows_of(tmp_path / name)} == {""}
    assert pq.read_table(tmp_path / "data" / "events")["t_s"].to_pylist() == [None]
    assert "an unknown time to an unknown time" in printed(0, f"dataset show {tmp_path}/data").out
    for name in (log, tmp_path / "data"):
        samples = read_log(name)[5]
        assert (str(samples.t_s), samples.to_arrow()["t_s"].null_count) == ("[nan]", 1)


def table_of(t_s: list[float], key: list[int], force: list[float], phi: list[float]) -> Table:
    count = len(t_s)
    return Table(
        np.rint(np.array(t_s) * 1e9).astype(np.int64), np.array(key, dtype=np.uint16), np.zeros(count, dtype=np.int64),
        np.ones(count, dtype=np.bool_), (P, PHI), {"P_N": np.array(force), "phi_deg": np.array(phi)}, {}, ("can0",),
    )  # fmt: skip


def resampled(tables: list[Table], rate_hz: float) -> list[tuple[float, int, int, float, int, float]]:
    found = []
    for table in Resampler(rate_hz).tables(tables):
        v = table.values
        columns = (v["count"], v["P_N"], v["n_P_N"], v["phi_deg"])
        found += [
            (t / 1e9, int(key), int(c), float(p), int(n), float(phi))
            for t, key, c, p, n, phi in zip(table.t_ns.tolist(), table.key, *columns, strict=True)
        ]
    return found


def test_resample_means() -> None:
    nan = float("nan")
    times = [10.01, 10.02, 10.09, 10.11, 10.45]
    found = resampled([table_of(times, [5] * 5, [1.0, 2.0, nan, 4.0, 8.0], [179.0, -179.0, 10.0, nan, 3.0])], 10.0)
    assert [row[0] for row in found] == [10.0, 10.1, 10.2, 10.3, 10.4]
    assert [row[2] for row in found] == [3, 1, 0, 0, 1]
    assert [row[4] for row in found] == [2, 1, 0, 0, 1]
    np.testing.assert_allclose([row[3] for row in found], [1.5, 4.0, nan, nan, 8.0])
    angles = np.radians([179.0, -179.0, 10.0])
    mean = np.degrees(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean()))
    np.testing.assert_allclose([row[5] for row in found], [mean, nan, nan, nan, 3.0])
    opposite = resampled([table_of([1.0, 1.01], [5, 5], [1.0, 1.0], [0.0, 180.0])], 1.0)
    assert np.isnan(opposite[0][5])
    now = table_of([1_700_000_000.5], [5], [1.0], [0.0])
    assert [table.t_ns.tolist() for table in Resampler(3.0).tables([now])] == [[1_700_000_000_333_333_333]]


@given(
    st.lists(st.tuples(st.integers(0, 3000), st.sampled_from([1, 2]), st.floats(-9, 9)), min_size=1, max_size=60),
    st.integers(1, 20),
    st.sampled_from([1.0, 3.0, 7.5, 100.0]),
)
@settings(max_examples=100, deadline=None)
def test_resample_does_not_see_blocks(made: list[tuple[int, int, float]], size: int, rate_hz: float) -> None:
    made = sorted(made, key=lambda row: row[0])
    t_s, key, force = ([row[k] for row in made] for k in range(3))
    times, keys = [t / 1000 for t in t_s], [int(k) for k in key]
    values = [float(f) for f in force]
    whole = resampled([table_of(times, keys, values, values)], rate_hz)
    pieces = [
        table_of(times[k : k + size], keys[k : k + size], values[k : k + size], values[k : k + size])
        for k in range(0, len(made), size)
    ]
    parts = sorted(resampled(pieces, rate_hz))
    assert [row[:3] for row in parts] == [row[:3] for row in sorted(whole)]
    np.testing.assert_allclose([row[3] for row in parts], [row[3] for row in sorted(whole)], atol=1e-12)
    assert sum(row[2] for row in whole) == len(made)
    for node in {1, 2} & set(keys):
        grid = [row[0] for row in whole if row[1] == node]
        np.testing.assert_allclose(np.diff(grid), 1 / rate_hz, atol=2e-9)


def test_calibration_equals_estimate(tmp_path: Path, printed: Printed) -> None:
    A = strain_matrix(FABRICATED, "I")
    offset = np.array([20e-6, -30e-6, 5e-6])
    cal = tmp_path / "cal.toml"
    calibration = Calibration(calibration_matrix(FABRICATED, "I"), offset, 1e-12 * np.eye(3), layout_code=1, pull=True)
    write_calibration(cal, calibration)
    random = np.random.default_rng(7)
    lines, gauges = [], ["SG1,SG2,SG3"]
    for k in range(200):
        load = random.uniform(0.0, 3.0), random.uniform(-3, 3), random.uniform(0.0, 1.5)
        raw = np.rint((A @ force_vector(*load) + offset) * 1e7).astype("<i2")
        lines.append(f"(1700000000.{k:06d}) can0 185#{raw.tobytes().hex().upper()}03{k & 0xFF:02X}")
        gauges.append(",".join(f"{value / 10:.1f}" for value in raw))
    log = write_log(tmp_path / "run.log", lines)
    write_log(tmp_path / "gauges.csv", gauges)
    expected = list(csv.DictReader(io.StringIO(printed(0, f"estimate {cal} {tmp_path}/gauges.csv -q").out)))
    assert decode(log, "--calibration", f"5={cal}", "-o", tmp_path / "contact.csv") == 0
    found = rows_of(tmp_path / "contact.csv")
    assert len(found) == len(expected) == 200
    for ours, theirs in zip(found, expected, strict=True):
        for name in ("P_N", "phi_deg", "theta_deg", "u_P_N", "u_phi_deg", "u_theta_deg"):
            a, b = number(ours[name]), number(theirs[name])
            assert (a is None) == (b is None), name
            if a is not None and b is not None:
                assert a == pytest.approx(b, abs=1e-6, rel=1e-8), name
        words = {} if theirs["status"] == "ok" else set(theirs["status"].split())
        assert (ours["contact"] == "0") == ("no_contact" in words)
        assert (ours["beyond_first_order"] == "1") == ("beyond_first_order" in words)
    assert decode(log, "--calibration", cal, "--signals", "P,u_P_N", "-o", tmp_path / "few.csv") == 0
    few = rows_of(tmp_path / "few.csv")
    assert list(few[0]) == ["t_s", "node", "counter", "P_N", "u_P_N"]
    assert [row["P_N"] for row in few] == [row["P_N"] for row in found]


def test_calibration_without_readings_is_missing(tmp_path: Path) -> None:
    write_calibration(cal := tmp_path / "cal.toml", beam_calibration(pull=True))
    frames = ["185#0080008000800A01", "185#640064006400070A", "186#6400640064000301", "185#640064006400030B"]
    lines = [f"(1700000000.{k:06d}) can0 {frame}" for k, frame in enumerate(frames)]
    assert decode(write_log(tmp_path / "a.log", lines), "--calibration", f"5={cal}", "-o", tmp_path / "a.csv") == 0
    rows = rows_of(tmp_path / "a.csv")
    assert [bool(row["P_N"]) for row in rows] == [False, False, False, True]  # stale, saturated, node 6, good
    assert [row["node"] for row in rows] == ["5", "5", "6", "5"]


def test_layouts_of_a_dbc(tmp_path: Path, log: Path) -> None:
    dbc = Path(__file__).parents[3] / "dbc" / "tipforce.dbc"
    assert decode(log, "--dbc", dbc, "--signals", "P,SG2", "-o", tmp_path / "dbc.csv") == 0
    assert decode(log, "--signals", "P,SG2", "-o", tmp_path / "own.csv") == 0
    foreign, own = rows_of(tmp_path / "dbc.csv"), rows_of(tmp_path / "own.csv")
    theirs = sorted((row["node"], row["P"]) for row in foreign if row.get("P"))
    assert theirs == sorted((row["node"], row["P_N"]) for row in own if row["P_N"])


def test_layout_of_a_dcf(tmp_path: Path) -> None:
    eds = (Path(__file__).parents[3] / "eds" / "tipforce-3.eds").read_text()
    dcf = tmp_path / "node.dcf"
    changed = eds.replace("DefaultValue=$NODEID+0x40000280", "DefaultValue=$NODEID+0x40000280\nParameterValue=0x2F0")
    assert changed != eds
    dcf.write_text(changed + "\n[DeviceComissioning]\nNodeID=5\n")
    lines = ["(1700000000.000000) can0 2F0#E80364006400030A", "(1700000000.001000) can0 285#E80364006400030B"]
    assert decode(write_log(tmp_path / "a.log", lines), "--dcf", dcf, "-o", tmp_path / "a.csv") == 0
    rows = rows_of(tmp_path / "a.csv")
    assert [(row["node"], row["counter"], row["P_N"]) for row in rows] == [("5", "10", "1.000")]


def test_layout_of_a_node_that_is_asked(tmp_path: Path) -> None:
    channel = new_channel()
    with connected(finger(4), channel=channel) as (connection, _):
        sdo = connection.sdo(4)
        sdo.download(0x1801, 1, (0xC0000284).to_bytes(4, "little"))
        sdo.download(0x1801, 1, (0x400003F4).to_bytes(4, "little"))
        log = write_log(tmp_path / "a.log", ["(1700000000.000000) can0 3F4#E80364006400030A"])
        words = ["--ask", "4", "-i", "virtual", "-c", channel, "-o", tmp_path / "a.csv"]
        assert decode(log, *words) == 0
        layout = node_layout(sdo)
    assert [(row["node"], row["P_N"]) for row in rows_of(tmp_path / "a.csv")] == [("4", "1.000")]
    ids = {name: can_id for name, (can_id, _) in layout.pdos.items()}
    assert ids == {"Gauges": 0x184, "Contact": 0x3F4, "Force": 0, "Health": 0}
