"""Datasets: what is there is left alone, what is new is added, and the rows are those of one decode."""

import contextlib
import gzip
import os
import random
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path
from unittest.mock import Mock

import pyarrow.parquet as pq
import pytest

import tipforce
from tipforce.host.dataset import manifest as manifests
from tipforce.host.dataset.reader import opened, tally
from tipforce.host.dataset.store import FOLDER, Store, is_dataset
from tipforce_tools.cli.main import main
from tipforce_tools.decode import dataset_run, session
from tools.decode.logs import decode, globbed, log_lines, rows_of, rows_of_dataset, rows_of_logs, write_log
from tools.rig import Printed, until

COMMAND = [sys.executable, "-m", "tipforce_tools.cli.main"]


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "_DATASET_PIECE_BYTES", 100_000)


@pytest.fixture
def lines() -> list[str]:
    return log_lines(2500, (1, 5), health=300)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_log_that_grows(tmp_path: Path, lines: list[str], jobs: int) -> None:
    log, data = tmp_path / "run.log", tmp_path / "data"
    for share in (0.2, 0.2, 0.55, 1.0):
        text = "".join(line + "\n" for line in lines[: int(share * len(lines))])
        log.write_text(text if share == 1.0 else text[:-20])  # the last line is half
        assert decode(log, "-j", jobs, "-o", f"{data}/") == 0
        manifest = opened(str(data))[1]
        assert {file.path for file in manifest.files()} == globbed(data)
        assert manifest.sources[0].size == log.stat().st_size
    before = manifest.generation
    assert rows_of_dataset(data) == rows_of_logs(log)
    assert decode(log, "-o", f"{data}/") == 0
    assert opened(str(data))[1].generation == before  # the same log again is a no-op
    assert sum(tally(manifest).lost().values()) == sum(tipforce.read_log(log).lost.values())


def test_a_day_is_added_and_counters_go_on(tmp_path: Path, lines: list[str]) -> None:
    cut = len(lines) // 2 + 3  # within a sample
    first, second = write_log(tmp_path / "run-1.log", lines[:cut]), write_log(tmp_path / "run-2.log", lines[cut:])
    data = tmp_path / "data"
    assert decode(first, "-o", f"{data}/") == 0
    files = globbed(data)
    assert decode(first, second, "-o", f"{data}/", "-j", 2) == 0
    assert rows_of_dataset(data) == rows_of_logs(first, second)
    assert len(globbed(data) & files) >= len(files) - 2  # of the first log only the last part came again
    other = write_log(tmp_path / "other.log", [line.replace("(17000", "(17001") for line in lines[:500]])
    assert decode(other, "-o", f"{data}/", "--hand", "vcan0") == 0
    assert {path.split("/")[2] for path in globbed(data)} == {"date=2023-11-14", "date=2023-11-16"}


def test_many_logs_are_known_again_in_few_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = log_lines(8, (1, 5))
    logs = [write_log(tmp_path / f"run-{k:02d}.log", lines[k % 3 :]) for k in range(3)]
    logs += [write_log(tmp_path / f"late-{k:02d}.log", [f"({k}.5) can0 185#{k:04X}", *lines]) for k in range(30)]
    assert decode(*logs, "-j", 1, "-o", f"{tmp_path}/data/") == 0
    counted = Mock(side_effect=dataset_run.hash_of)
    monkeypatch.setattr(dataset_run, "hash_of", counted)
    assert decode(*logs, "-j", 1, "-o", f"{tmp_path}/data/") == 0
    assert 0 < counted.call_count < 20 * len(logs)


def test_readers(tmp_path: Path, lines: list[str], printed: Printed) -> None:
    log, data = write_log(tmp_path / "run.log", [*lines, "bad"]), tmp_path / "data"
    assert decode(log, "-o", f"{data}/") == 0
    one, other = tipforce.read_log(log), tipforce.read_log(data)
    assert other.lost == one.lost
    for node in one:
        assert other[node].counter.tolist() == one[node].counter.tolist()
        assert [str(v) for v in other[node].P_newtons] == [str(v) for v in one[node].P_newtons]
        assert other[node].status.tolist() == one[node].status.tolist()
    words = ["--from", "0.7", "--to", "0.9", "--nodes", "5", "--signals", "P,SG1"]
    assert decode(data, *words, "-o", tmp_path / "a.csv") == decode(log, *words, "-o", tmp_path / "b.csv") == 0
    found, expected = rows_of(tmp_path / "a.csv"), rows_of(tmp_path / "b.csv")
    steps = {int(one["counter"]) - int(other["counter"]) for one, other in zip(found, expected, strict=True)}
    assert len(steps) == 1  # a dataset's counters begin with the log, not with the slice
    assert [{**row, "counter": ""} for row in found] == [{**row, "counter": ""} for row in expected]
    printed(0, f"plot {data} -o {tmp_path}/a.svg -q")
    assert f"{data}: bad lines: 1 not a candump line\n" in printed(0, f"decode {data} --summary").err


def test_what_it_holds(tmp_path: Path, lines: list[str], printed: Printed) -> None:
    log, data = write_log(tmp_path / "run.log", [*lines, "bad"]), tmp_path / "data"
    assert decode(log, "-o", f"{data}/") == 0
    out = printed(0, f"dataset verify {data}").out
    assert "vcan0 node 5 (0x05):" in out
    assert "1 bad lines" in out
    file = data / next(iter(globbed(data)))
    file.write_bytes(file.read_bytes()[:-9] + b"x" + file.read_bytes()[-8:])
    printed(0, f"dataset show {data}")
    assert "differs" in printed(1, f"dataset verify {data}").out


def test_two_writers(tmp_path: Path, lines: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    log, other, data = tmp_path / "run.log", tmp_path / "other.log", tmp_path / "data"
    write_log(log, lines)
    write_log(other, [line.replace("(170000", "(170100") for line in lines])
    committed = manifests.commit

    def interrupted(store: Store, change: manifests.Change) -> manifests.Manifest:
        monkeypatch.undo()
        assert decode(other if first else log, "-j", 1, "-o", f"{data}/") == 0
        return committed(store, change)

    first = True
    monkeypatch.setattr("tipforce_tools.decode.dataset_run.commit", interrupted)
    assert decode(log, "-j", 1, "-o", f"{data}/") == 0  # another log was added meanwhile: both are there
    assert len(opened(str(data))[1].sources) == 2
    log.write_text(log.read_text() + "".join(line.replace("(170000", "(170001") + "\n" for line in lines))
    first = False
    monkeypatch.setattr("tipforce_tools.decode.dataset_run.commit", interrupted)
    assert decode(log, "-j", 1, "-o", f"{data}/") != 0  # the same log was
    assert globbed(data) == {file.path for file in opened(str(data))[1].files()}
    assert decode(log, "-j", 1, "-o", f"{data}/") == 0
    assert rows_of_dataset(data) == sorted(rows_of_logs(log) + rows_of_logs(other))


def test_a_log_is_followed(tmp_path: Path, lines: list[str]) -> None:
    log, data = write_log(tmp_path / "run.log", lines[:2000]), tmp_path / "data"
    words = ["decode", "-q", "--follow", str(tmp_path / "run*.log"), "-o", f"{data}/"]
    with subprocess.Popen([*COMMAND, *words]) as process, contextlib.ExitStack() as at_end:
        at_end.callback(process.kill)
        until(lambda: is_dataset(data))
        with log.open("a") as stream:
            stream.write("".join(line + "\n" for line in lines[2000:]))
        until(lambda: opened(str(data))[1].sources[0].size == log.stat().st_size)
        assert rows_of_dataset(data) == rows_of_logs(log)
        more = write_log(tmp_path / "run-2.log", [line.replace("(170000", "(170001") for line in lines])
        until(lambda: len(opened(str(data))[1].sources) == 2)  # the file that a rotation begins
        (tmp_path / "packed.log.gz").write_bytes(gzip.compress(log.read_bytes()))
        for name in ("run*.log", "packed.log.gz"):
            assert decode(tmp_path / name, "--follow", "-o", tmp_path / "run.csv") == 2
        assert rows_of_dataset(data) == sorted(rows_of_logs(log) + rows_of_logs(more))
        process.terminate()
        assert process.wait(30) == 130
    assert sorted(name for name in os.listdir(data / FOLDER) if "manifest" not in name) == []


def test_behind_a_url(tmp_path: Path, lines: list[str]) -> None:
    log = write_log(tmp_path / "run.log", lines[:3000])
    url = f"memory://data-{tmp_path.name}/"
    for count in (3000, 6000):
        write_log(log, lines[:count])
        assert decode(log, "-j", 1, "-o", url) == 0
    one, other = tipforce.read_log(log), tipforce.read_log(url)
    assert [other[node].counter.tolist() for node in one] == [one[node].counter.tolist() for node in one]
    assert main(["dataset", "verify", url, "--json"]) == 0
    assert not Path("memory:").exists()
    files = pytest.importorskip("fsspec").filesystem("memory")
    files.pipe_file(f"/logs-{tmp_path.name}/run.log", log.read_bytes())
    copied, output = f"memory://logs-{tmp_path.name}/run.log", tmp_path / "copied"
    assert decode(copied, "-j", 1, "-o", f"{output}/") == 0
    assert rows_of_dataset(output) == rows_of_logs(log)
    assert opened(str(output))[1].sources[0].name == copied
    assert tipforce.read_log(copied)[5].counter.tolist() == one[5].counter.tolist()
    for words in ([f"{copied}.gone", "-o", f"{output}/"], [copied, "--follow", "-o", f"{output}/"]):
        assert decode(*words) == 2


def test_a_cluster_whose_worker_is_killed(tmp_path: Path, lines: list[str]) -> None:
    """Four workers, one of which ends in the middle: the rows are those of one decode."""
    distributed = pytest.importorskip("distributed")
    log = write_log(tmp_path / "run.log", lines)
    count = int(os.environ.get("TIPFORCE_CLUSTER", "2"))
    with (
        warnings.catch_warnings(),
        distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
        ) as cluster,
    ):
        warnings.simplefilter("ignore")
        first = next(iter(cluster.workers.values()))
        killer = threading.Timer(0.3, lambda: os.kill(first.process.pid, signal.SIGKILL))
        killer.start()
        for output in (tmp_path / "one.parquet", f"{tmp_path}/data/"):
            assert decode(log, "-o", output, "--scheduler", cluster.scheduler_address) == 0
        killer.join()
    assert rows_of_dataset(tmp_path / "data") == rows_of_logs(log)
    assert pq.read_table(tmp_path / "one.parquet").num_rows == len(rows_of_logs(log))


def test_a_run_that_is_killed_is_completed(tmp_path: Path, lines: list[str]) -> None:
    """Append to a dataset in a process that is killed; then look at it, and complete it. Many instants: `make long`."""
    order = random.Random(5)
    log = write_log(tmp_path / "run.log", lines)
    expected = rows_of_logs(log)
    code = (
        "import sys\nfrom tipforce.host.dataset import manifest\n"
        "from tipforce_tools.decode import dataset_run, session\n"
        "from tipforce_tools.cli.main import main\n"
        "session._DATASET_PIECE_BYTES = 60_000\ndataset_run._COMMIT_S = 0.0\nmanifest._PARTS_PER_CHANGE = 1\n"
        "print('ready', flush=True)\nsys.stdin.readline()\nmain(sys.argv[1:])\nprint('done', flush=True)\n"
    )
    for number in range(int(os.environ.get("TIPFORCE_KILLS", "2"))):
        data = tmp_path / f"data-{number}"
        words = ["decode", "-q", str(log), "-o", f"{data}/", "-j", str(order.choice([1, 2]))]
        with subprocess.Popen(
            [sys.executable, "-c", code, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdout.readline()
            process.stdin.write("\n")
            process.stdin.flush()
            time.sleep(order.uniform(0.0, 1.2))
            os.kill(process.pid, signal.SIGKILL)
        if is_dataset(data):
            assert set(rows_of_dataset(data)) <= set(expected)
        assert decode(log, "-o", f"{data}/", "-j", 1) == 0
        assert rows_of_dataset(data) == expected
        deadline = time.monotonic() + 60
        while globbed(data) != {file.path for file in opened(str(data))[1].files()} and time.monotonic() < deadline:
            time.sleep(0.2)  # a worker of the killed run writes its last file
            assert decode(log, "-o", f"{data}/", "-j", 1) == 0


def test_two_calibrations(tmp_path: Path, lines: list[str], printed: Printed) -> None:
    """Reads of 2103h:3 tell them, the same one several times; how logs are cut changes nothing."""
    told = [f"585#43032103{crc}" for crc in ("44332211", "44332211", "78563412", "78563412")]
    whole = list(lines)
    for place, frame in zip((1000, 5000, 9000, 9500), told, strict=True):
        whole.insert(place, f"{whole[place - 1].rsplit(' ', 1)[0]} {frame}")
    logs = [write_log(tmp_path / "run-1.log", whole[:7000]), write_log(tmp_path / "run-2.log", whole[7000:])]
    for data, steps in ((tmp_path / "one", [logs]), (tmp_path / "two", [logs[:1], logs])):
        for names in steps:
            assert decode(*names, "-j", 2, "-o", f"{data}/") == 0
        found = printed(0, f"dataset show {data} --json").records[0]["calibrations"]
        assert [(one["node"], one["crc"]) for one in found] == [(5, 0x11223344), (5, 0x12345678)]
    out = printed(0, f"dataset show {data}").out
    assert "vcan0 node 5: rows of 2 calibrations: 0x11223344 from 2023-11-14T22:13:20" in out
    query = """select code, count(*) as n from samples asof join (select t_s as since, node, code from events where
               event = 'calibration') told on samples.node = told.node and samples.t_s >= since group by code"""
    rows = {row["code"]: row["n"] for row in printed(0, ["dataset", "sql", data, "--json", query]).records}
    assert rows.keys() == {"0x11223344", "0x12345678"}
