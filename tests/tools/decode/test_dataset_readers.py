"""Other programs open the rows and the events of a dataset by the name of their folder, and get what the logs hold."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask.dataframe
import duckdb
import pandas as pd
import polars
import pyarrow.compute as pc
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest
from bench.scale import month

from tipforce.host.dataset.reader import opened, tables
from tipforce.host.decoding.log_part import Reading
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce_tools.cli.main import main
from tools.decode.datasets import globbed, rows_of_dataset, rows_of_logs
from tools.decode.logs import decode, log_lines, write_log

pytestmark = pytest.mark.filterwarnings("ignore:The inplace keyword")  # Dask calls pandas with it

Sums = list[tuple[int, int, float]]
"""Of each node the number of rows, and the sum of P."""


def of_frame(rows: Any) -> Sums:
    sums = rows.groupby("node", observed=True)["P_N"].agg(["size", "sum"])
    sums = sums.compute(scheduler="synchronous") if hasattr(sums, "compute") else sums
    return sorted((int(node), int(size), float(total)) for node, size, total in sums.itertuples())


def of_pandas(folder: Path) -> Sums:
    return of_frame(pd.read_parquet(folder))


def of_dask(folder: Path) -> Sums:
    return of_frame(dask.dataframe.read_parquet(folder, columns=["P_N", "node"]))


def of_pyarrow(folder: Path) -> Sums:
    rows = pyarrow.dataset.dataset(folder, partitioning="hive").to_table(["node", "P_N"])
    found = rows.group_by("node").aggregate([([], "count_all"), ("P_N", "sum")]).to_pylist()
    return sorted((one["node"], one["count_all"], one["P_N_sum"]) for one in found)


def of_polars(folder: Path) -> Sums:
    rows = polars.scan_parquet(folder).group_by("node").agg(polars.len(), polars.col("P_N").sum())
    return sorted(rows.collect().rows())


def of_duckdb(folder: Path) -> Sums:
    rows = f"read_parquet('{folder}/**', hive_partitioning = true)"
    found: Sums = duckdb.sql(f"select node, count(*), sum(P_N) from {rows} group by node order by node").fetchall()
    return found


READERS = [of_pandas, of_dask, of_pyarrow, of_polars, of_duckdb]


@pytest.fixture(scope="module")
def some_days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Days of five nodes in 24 parts each; a month: `TIPFORCE_DAYS=30`."""
    folder = tmp_path_factory.mktemp("month")
    month(folder, int(os.environ.get("TIPFORCE_DAYS", "2")), 60)
    return folder


@pytest.fixture(scope="module")
def two_logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs with events; only the second one has the columns of a health PDO."""
    folder = tmp_path_factory.mktemp("logs")
    lines = log_lines(400, (1, 5), health=50)
    boot = "(1700000000.000001) vcan0 705#00"
    first = write_log(folder / "1.log", [boot, *(line for line in lines if " 48" not in line)])
    later = [line.replace("(170000", "(170010") for line in [boot, *lines]]
    assert decode(first, "-j", 1, "-o", f"{folder}/data/") == 0
    assert decode(write_log(folder / "2.log", later), "-j", 1, "-o", f"{folder}/data/") == 0
    assert len({len(pq.read_schema(path)) for path in folder.glob("data/rows/**/*.parquet")}) == 2
    return folder


@pytest.mark.parametrize("read", READERS)
def test_days_have_equal_sums(some_days: Path, read: Callable[[Path], Sums]) -> None:
    sizes: Counter[int] = Counter()
    totals: Counter[int] = Counter()
    for table in tables(str(some_days), Reading(Layouts())):
        for node in set(table.node.tolist()):
            sizes[node] += int((table.node == node).sum())
            totals[node] += table.values["P_N"][table.node == node].sum()
    expected = sorted((node, count, totals[node]) for node, count in sizes.items())
    assert len(expected) == 5
    found = read(some_days / "rows")
    assert [one[:2] for one in found] == [one[:2] for one in expected]
    assert [one[2] for one in found] == pytest.approx([one[2] for one in expected])


def test_times_are_microseconds_of_utc_in_every_reader(some_days: Path) -> None:
    path = next(some_days.glob("rows/**/*.parquet"))
    assert str(pq.read_schema(path).field("t_s").type) == "timestamp[us, tz=UTC]"
    logical = json.loads(pq.ParquetFile(path).metadata.schema.column(0).logical_type.to_json())
    assert (logical["isAdjustedToUTC"], logical["timeUnit"]) == (True, "microseconds")
    first = pc.min(pq.read_table(some_days / "rows")["t_s"]).as_py()
    assert pd.read_parquet(some_days / "rows")["t_s"].min() == first
    assert polars.scan_parquet(some_days / "rows").select(polars.min("t_s")).collect().item() == first
    rows = f"read_parquet('{some_days}/rows/**')"
    assert duckdb.sql(f"select min(t_s) from {rows}").fetchall() == [(first,)]


def test_the_folders_of_readers_hold_parquet_files_and_nothing_else(two_logs: Path) -> None:
    data = two_logs / "data"
    assert {path.name for path in data.iterdir()} == {"rows", "events", "_tipforce"}
    for name in ("rows", "events"):
        files = [path for path in (data / name).rglob("*") if path.is_file()]
        assert files
        assert {path.suffix for path in files} == {".parquet"}
        assert not [path for path in files if path.name.startswith((".", "_"))]
    events = pd.read_parquet(data / "events")
    assert Counter(events["event"]) == {"boot_up": 2}
    assert str(events["t_s"].dtype) == "datetime64[us, UTC]"


def test_compaction_gives_all_files_the_same_columns(two_logs: Path) -> None:
    data, logs = two_logs / "data", [two_logs / "1.log", two_logs / "2.log"]
    assert rows_of_dataset(data) == sorted(row for log in logs for row in rows_of_logs(log))
    other = [line.replace("(170000", "(170020") for line in log_lines(100, (1, 5))]
    assert decode(write_log(two_logs / "3.log", other), "-j", 1, "-o", f"{data}/") == 0  # the last one stays
    assert main(["dataset", "compact", str(data), "-q"]) == 0
    files = [file.path for file in opened(str(data))[1].files()]
    assert set(files) == globbed(data)
    assert len(files) == 6
    assert len({str(pq.read_schema(data / path).names) for path in files}) == 1
    sizes = Counter(str(dict(row)["node"]) for row in rows_of_dataset(data))
    for read in READERS:
        assert [(str(node), count) for node, count, _ in read(data / "rows")] == sorted(sizes.items()), read
    assert main(["dataset", "verify", str(data)]) == 0
