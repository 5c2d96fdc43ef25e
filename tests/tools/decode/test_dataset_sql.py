"""A query of a dataset reads the dataset alone: no other file, no network, no extension, and limited memory."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import pytest

from tipforce_tools.cli.main import main
from tipforce_tools.dataset import sql
from tools.decode.logs import decode, log_lines, write_log

pytest.importorskip("duckdb")

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
    """Every file below a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("query", REFUSED)
def test_what_is_not_of_the_dataset_is_refused(
    query: str, dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (dataset / "home").mkdir(exist_ok=True)
    monkeypatch.chdir(dataset)
    monkeypatch.setattr(sql, "MEMORY_MIB", 200)
    monkeypatch.setenv("HOME", str(dataset / "home"))
    before, limit = contents(dataset), resource.getrlimit(resource.RLIMIT_AS)
    for name, path in (
        ("OUTSIDE", dataset),
        ("DATA", dataset / "data"),
        ("FILE", next(dataset.glob("data/**/*.parquet"))),
    ):
        query = query.replace(name, str(path))
    for words in ([], ["--json"]):
        assert main(["dataset", "sql", "data", *words, query]) == 2
        out, err = capsys.readouterr()
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
def test_what_a_query_may_do(query: str, dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "sql", f"{dataset}/data", "--json", query]) == 0
    assert json.loads(capsys.readouterr().out) == QUERIES[query]
    assert main(["dataset", "sql", f"{dataset}/data", query]) == 0


def test_no_column_is_lost_in_an_object(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--unrestricted"]):
        assert main(["dataset", "sql", f"{dataset}/data", "--json", *words, "select 1 as a, 2 as a"]) == 2
        assert "2 columns are called a: rename one" in capsys.readouterr().err


def test_show_and_a_query_have_the_same_times(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """1700000000.002 as a double, in milliseconds, is below ...002."""
    frames = [f"({1700000000.002 + 0.01 * k:.6f}) can0 285#F401E803008003{k:02X}" for k in range(3)]
    assert decode(write_log(tmp_path / "run.log", frames), "-o", f"{tmp_path}/data/") == 0
    assert main(["dataset", "show", f"{tmp_path}/data"]) == 0
    assert "2023-11-14T22:13:20.002 to 2023-11-14T22:13:20.022" in capsys.readouterr().out


def test_rows_keep_their_order_and_are_printed_in_parts(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    query = "select range as n from range(25000) order by n desc"
    assert main(["dataset", "sql", f"{dataset}/data", "--json", query]) == 0
    assert [json.loads(line)["n"] for line in capsys.readouterr().out.splitlines()] == list(range(24999, -1, -1))


def test_unrestricted(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["dataset", "sql", f"{dataset}/data", "--json", "--unrestricted"]
    assert main([*words, f"select b from read_csv('{dataset}/secret.csv')"]) == 0
    assert json.loads(capsys.readouterr().out) == {"b": "SECRET"}
    assert main([*words, f"copy (select 1 as a) to '{dataset}/new.csv'"]) == 0
    assert (dataset / "new.csv").read_text() == "a\n1\n"
    (dataset / "new.csv").unlink()
