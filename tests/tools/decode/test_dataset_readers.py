"""Other programs and queries read a dataset: the rows are those of the logs, and a query reads the dataset alone."""

import json
import os
import resource
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
from tipforce_tools import dataset as command
from tipforce_tools.cli.main import main
from tools.decode.logs import decode, globbed, log_lines, rows_of_dataset, rows_of_logs, write_log
from tools.rig import Printed

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


REFUSED = """\
select * from read_csv('OUTSIDE/secret.csv')
select * from 'OUTSIDE/secret.csv'
select * from read_text('OUTSIDE/secret.csv')
select * from read_text('DATA/../secret.csv')
select * from read_text('OUTSIDE/link.parquet')
select * from read_text('/proc/self/environ')
select * from read_json('OUTSIDE/secret.json')
select * from read_parquet('OUTSIDE/other.parquet')
select * from parquet_metadata('OUTSIDE/other.parquet')
select * from glob('OUTSIDE/*')
select (select content from read_text('OUTSIDE/secret.csv'))
select * from query('select * from read_text(''OUTSIDE/secret.csv'')')
select * from read_duckdb('OUTSIDE/x.db')
select * from 'http://127.0.0.1:9/x.parquet'
select * from 's3://bucket/x.parquet'
select getenv('HOME')
select * from args
select 1 from nothing
copy samples to 'OUTSIDE/new.csv'
copy (select 1) to 'FILE' (format parquet, use_tmp_file false)
explain analyze copy (select 1) to 'FILE' (format parquet, use_tmp_file false)
copy samples from 'OUTSIDE/secret.csv'
select 1; copy (select 1) to 'OUTSIDE/new.csv'
export database 'OUTSIDE/exported'
attach 'OUTSIDE/new.db'
install httpfs
load httpfs
set enable_external_access = true
set lock_configuration = false
set memory_limit = '100GB'
pragma memory_limit = '100GB'
pragma profile_output = 'OUTSIDE/profile'
call enable_logging(storage = 'file', storage_config = {'path': 'OUTSIDE/log'})
create secret (type s3)
create table t as select 1
prepare p as select 1
checkpoint
select 1; select 2
-- nothing

select list(range) from range(400000000)
select repeat('x', 8000000000)
select range, repeat('x', 1000000) from range(20000) order by 2
select string_agg(repeat('x', 1000000), '') from range(20000)
""".removesuffix("\n").split("\n")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a dataset, data, and of files beside it."""
    folder = tmp_path_factory.mktemp("sql")
    assert decode(write_log(folder / "run.log", log_lines(500, (1, 5), health=100)), "-o", f"{folder}/data/") == 0
    (folder / "secret.csv").write_text("a,b\n1,SECRET\n")
    (folder / "secret.json").write_text('{"a": "SECRET"}\n')
    (folder / "other.parquet").write_bytes(next(folder.glob("data/**/*.parquet")).read_bytes())
    (folder / "link.parquet").symlink_to(folder / "secret.csv")
    return folder


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("query", REFUSED)
def test_what_is_not_of_the_dataset_is_refused(
    query: str, dataset: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    (dataset / "home").mkdir(exist_ok=True)
    monkeypatch.chdir(dataset)
    monkeypatch.setattr(command, "MEMORY_MIB", 200)
    monkeypatch.setenv("HOME", str(dataset / "home"))
    before, limit = contents(dataset), resource.getrlimit(resource.RLIMIT_AS)
    for name, path in (
        ("OUTSIDE", dataset),
        ("DATA", dataset / "data"),
        ("FILE", next(dataset.glob("data/**/*.parquet"))),
    ):
        query = query.replace(name, str(path))
    for words in ([], ["--json"]):
        out, err = printed(2, ["dataset", "sql", "data", *words, query])
        assert out == ""
        assert err.startswith("tipforce: dataset sql: ")
        assert len(err.splitlines()) == 1
        assert "SECRET" not in err
    assert contents(dataset) == before
    assert resource.getrlimit(resource.RLIMIT_AS) == limit


QUERIES = {
    "select count(*) as n from samples": {"n": 1010},
    "from samples select count(*) as n; ": {"n": 1010},
    "with x as (select node from samples) select max(node) as n from x -- the last": {"n": 5},
    "select 1 as a, [1, 2] as b, timestamptz '2026-01-02 03:04:05Z' as c, 1.5 as d, null as e":
        {"a": 1, "b": "[1, 2]", "c": "2026-01-02 03:04:05+00", "d": "1.5", "e": None},
    "select column_name as x from (describe samples) where column_name = 'P_N'": {"x": "P_N"},
    "select count(*) as n from events where false": {"n": 0},
    "select count(*) > 0 as n from parts": {"n": True},
    "select sum(range) as n from range(100000)": {"n": 4999950000},
}  # fmt: skip


@pytest.mark.parametrize("query", QUERIES)
def test_what_a_query_may_do(query: str, dataset: Path, printed: Printed) -> None:
    assert printed(0, ["dataset", "sql", f"{dataset}/data", "--json", query]).records == [QUERIES[query]]
    printed(0, ["dataset", "sql", f"{dataset}/data", query])


def test_no_column_is_lost_in_an_object(dataset: Path, printed: Printed) -> None:
    for words in ([], ["--unrestricted"]):
        err = printed(2, ["dataset", "sql", f"{dataset}/data", "--json", *words, "select 1 as a, 2 as a"]).err
        assert "2 columns are called a: rename one" in err


def test_show_and_a_query_have_the_same_times(tmp_path: Path, printed: Printed) -> None:
    """1700000000.002 as a double, in milliseconds, is below ...002."""
    frames = [f"({1700000000.002 + 0.01 * k:.6f}) can0 285#F401E803008003{k:02X}" for k in range(3)]
    assert decode(write_log(tmp_path / "run.log", frames), "-o", f"{tmp_path}/data/") == 0
    out = printed(0, f"dataset show {tmp_path}/data").out
    assert "2023-11-14T22:13:20.002 to 2023-11-14T22:13:20.022" in out


def test_rows_keep_their_order_and_are_printed_in_parts(dataset: Path, printed: Printed) -> None:
    query = "select range as n from range(25000) order by n desc"
    records = printed(0, ["dataset", "sql", f"{dataset}/data", "--json", query]).records
    assert [record["n"] for record in records] == list(range(24999, -1, -1))


def test_unrestricted(dataset: Path, printed: Printed) -> None:
    words = ["dataset", "sql", f"{dataset}/data", "--json", "--unrestricted"]
    assert printed(0, [*words, f"select b from read_csv('{dataset}/secret.csv')"]).records == [{"b": "SECRET"}]
    printed(0, [*words, f"copy (select 1 as a) to '{dataset}/new.csv'"])
    assert (dataset / "new.csv").read_text() == "a\n1\n"
    (dataset / "new.csv").unlink()
