"""What `tipforce decode` writes equals what cantools reads, in every format."""

import math
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pyarrow.parquet as pq
import pytest
from cantools.database.can import Database

from tools.decode.logs import decode, log_lines, number, rows_of, write_log
from tools.rig import Printed

DBC = Path(__file__).parents[3] / "dbc" / "tipforce.dbc"
UNITS = {"N": "_N", "degree": "_deg", "microstrain": "_ue", "degC": "_degC"}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "run.log", log_lines(400, (1, 5, 15), health=50))


def expected(log: Path) -> dict[tuple[str, int, str], float | None]:
    """(time, node, column) -> value, by cantools, of the frame that has this time. None: unknown."""
    database = cantools.database.load_file(DBC)
    assert isinstance(database, Database)
    found: dict[tuple[str, int, str], float | None] = {}
    for line in log.read_text().splitlines():
        stamp, _, frame = line.split()
        identifier, data = frame.split("#")
        if identifier == "080":
            continue
        message = database.get_message_by_frame_id(int(identifier, 16))
        decoded = message.decode(bytes.fromhex(data))
        assert isinstance(decoded, dict)
        for signal in message.signals:
            value = decoded[signal.name]
            digits = max(-math.floor(math.log10(float(signal.scale))), 0)
            name = signal.name + UNITS.get(signal.unit or "", "")
            known = None if str(value) == "unknown" else round(float(value), digits)  # type: ignore[arg-type]
            found[stamp.strip("()"), int(message.name[3:5]), name] = known
    return found


def assert_agrees(log: Path, rows: list[dict[str, Any]]) -> None:
    """Each value of cantools is in the row of its sample, and nothing else is."""
    by_cantools = expected(log)
    named: dict[tuple[int, str, float], int] = {}
    for (_, node, name), value in by_cantools.items():
        if value is not None and name != "counter":
            named[node, name, value] = named.get((node, name, value), 0) + 1
    for row in rows:
        for name, value in row.items():
            if name not in {"t_s", "node", "counter"} and value is not None:
                # Flags come with each PDO of a sample and stand once in its row.
                key = int(row["node"]), name, float(value)
                assert named.get(key, 0) > 0, key
                if not _is_flag(name):
                    named[key] -= 1
    left = [key for key, count in named.items() if count and not _is_flag(key[1])]
    assert left == []


def _is_flag(name: str) -> bool:
    """Flags of TPDO4 hold for the samples that follow."""
    return name.islower() or name.endswith("_fault")


def test_csv_equals_cantools(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.csv"
    assert decode(log, "-o", out) == 0
    rows = [{name: number(text) for name, text in row.items()} for row in rows_of(out)]
    assert len(rows) > 1100
    assert_agrees(log, rows)


def test_parquet_equals_csv(log: Path, tmp_path: Path) -> None:
    assert decode(log, "-o", tmp_path / "run.csv") == 0
    assert decode(log, "-o", tmp_path / "run.parquet") == 0
    table = pq.read_table(tmp_path / "run.parquet")
    rows = rows_of(tmp_path / "run.csv")
    assert table.column_names == list(rows[0])
    assert str(table.schema.field("t_s").type) == "timestamp[us, tz=UTC]"
    times = table["t_s"].cast("int64").to_pylist()
    for name in table.column_names[1:]:
        values = [None if value is None else float(value) for value in table[name].to_pylist()]
        assert values == [number(row[name]) for row in rows], name
    assert [f"{t // 10**6}.{t % 10**6:06d}" for t in times] == [row["t_s"] for row in rows]


def test_json_lines_equal_csv(log: Path, tmp_path: Path, printed: Printed) -> None:
    assert decode(log, "-o", tmp_path / "run.csv") == 0
    rows = rows_of(tmp_path / "run.csv")
    records = printed(0, f"decode {log} --json").records
    assert len(records) == len(rows)
    for record, row in zip(records, rows, strict=True):
        for name, value in record.items():
            assert (None if value is None else float(value)) == number(row[name]), name


def test_counter_is_unwrapped_and_losses_are_told(tmp_path: Path, printed: Printed) -> None:
    lines = [line for k, line in enumerate(log_lines(600, (5,), loss=0.0)) if not 900 <= k < 912]  # four samples
    log = write_log(tmp_path / "run.log", lines)
    (summary,) = printed(0, f"decode {log} -o {tmp_path}/run.csv --json").records
    counters = [int(row["counter"]) for row in rows_of(tmp_path / "run.csv")]
    assert counters == [k for k in range(5, 605) if not 305 <= k < 309]
    assert [node["lost"] for node in summary["nodes"]] == [4]
    assert summary["samples"] == summary["nodes"][0]["samples"] == 596


def test_missing_values_are_told_by_reason(tmp_path: Path, printed: Printed) -> None:
    frames = ["285#0080008000800204", "285#0000008000800205", "285#0080008000800A06", "285#E80300800080030A"]
    lines = [f"(1700000000.{k:06d}) can0 {frame}" for k, frame in enumerate(frames)]
    lines.append("(1700000000.000010) can0 185#0100010001000310")
    log = write_log(tmp_path / "a.log", lines)
    node = printed(0, f"decode {log} --summary --json").records[0]["nodes"][0]
    assert node["missing"]["P_N"] == {"stale": 1, "unknown": 1, "no_frame": 1}
    assert node["missing"]["phi_deg"] == {"no_frame": 1, "stale": 1, "no_contact": 2, "unknown": 1}
    assert node["missing"]["SG1_ue"] == {"no_frame": 4}


def test_nothing_else_is_decoded(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.csv"
    assert decode(log, "--signals", "theta_deg,P", "--nodes", "5", "-o", out) == 0
    rows = rows_of(out)
    assert list(rows[0]) == ["t_s", "node", "counter", "theta_deg", "P_N"]
    assert {row["node"] for row in rows} == {"5"}


@pytest.mark.parametrize("value", [0, 1, -1, 9, 10, -10, 4400, -4400, 32767, -32767, 999, -999])
def test_text_of_numbers_is_exact(value: int) -> None:
    from tipforce_tools.writing import text_rows

    for digits in range(4):
        made = text_rows.real_cells(np.array([value / 10**digits, np.nan, 12345.0]), digits)
        text = text_rows.rows_text([made, b"\n"], 3).decode().split("\n")
        assert text[:3] == [f"{value / 10**digits:.{digits}f}", "", f"{12345:.{digits}f}"]


def test_text_of_any_double() -> None:
    from tipforce_tools.writing import text_rows

    values = np.random.default_rng(3).standard_normal(500) * 10.0 ** np.random.default_rng(4).integers(-30, 30, 500)
    text = text_rows.rows_text([text_rows.real_cells(values, None), b"\n"], 500).decode().split()
    assert [float(cell) for cell in text] == values.tolist()
    small = values[np.abs(values) < 1e9]
    fixed = text_rows.rows_text([text_rows.real_cells(small, 6), b"\n"], len(small))
    for cell, value in zip(fixed.decode().split(), small.tolist(), strict=True):
        assert abs(float(cell) - value) <= 0.5000001e-6 + 1e-15 * abs(value)
