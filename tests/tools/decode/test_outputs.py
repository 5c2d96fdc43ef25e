"""Where `tipforce decode` writes, and what is there when it fails."""

import gzip
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from subprocess import PIPE

import pyarrow.parquet as pq
import pytest

from tools.decode.logs import decode, log_lines, rows_of, write_log
from tools.rig import Printed

DECODE = [sys.executable, "-m", "tipforce_tools.cli.main", "decode"]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "run.log", log_lines(200, (1, 5, 9), health=40))


def test_columns_that_come_late(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tipforce_tools.decode import session

    monkeypatch.setattr(session, "_FIRST_ROWS", 1)
    lines = [line for line in log_lines(100, (5,), loss=0.0) if " 285#" in line]
    later = [line.replace("170000000", "170000001") for line in log_lines(100, (5,), loss=0.0, bus="vcan1")]
    names = [write_log(tmp_path / "a.log", lines), write_log(tmp_path / "b.log", later)]
    for output in ("run.csv", "run.parquet"):
        assert decode(*names, "-j", 1, "-o", f"{tmp_path}/{output}") == 0
    rows = rows_of(tmp_path / "run.csv")
    assert [row["channel"] for row in rows] == ["vcan0"] * 100 + ["vcan1"] * 100
    assert [bool(row["SG1_ue"]) for row in rows[:100]] == [False] * 100
    table = pq.read_table(tmp_path / "run.parquet")
    assert table.column_names == list(rows[0])
    assert table["channel"].to_pylist() == [row["channel"] for row in rows]
    assert [value is None for value in table["SG2_ue"].to_pylist()] == [not row["SG2_ue"] for row in rows]


def test_strict_tells_what_was_lost_before_the_bad_line(tmp_path: Path, printed: Printed) -> None:
    lines = log_lines(9, (5,), loss=0.0)
    bad = write_log(tmp_path / "bad.log", [*lines[:12], *lines[15:], "nonsense"])  # without the fifth sample
    (record,) = printed(1, f"decode {bad} --strict --summary --json").records
    assert record["lost"] == record["nodes"][0]["lost"] == 1


def test_strict_ends_at_the_first_bad_line(log: Path, tmp_path: Path, printed: Printed) -> None:
    lines = log.read_text().splitlines()
    lines[40:40] = ["(1700000000.9) nonsense"]
    lines[90:90] = ["(1700000000.900000) can0 28Z#00", "more nonsense"]
    bad = write_log(tmp_path / "bad.log", lines)
    out = tmp_path / "bad.csv"
    assert f"{bad}: line 41:" in printed(1, f"decode {bad} --strict -o {out}").err
    assert not out.exists()
    err = printed(0, f"decode {bad} -o {out}").err
    assert "1 identifier" in err
    assert "2 not a candump line" in err
    assert decode(log, "-o", tmp_path / "good.csv") == 0
    assert out.read_bytes() == (tmp_path / "good.csv").read_bytes()


def test_packed_logs_and_stdin(log: Path, tmp_path: Path) -> None:
    assert decode(log, "-o", tmp_path / "a.csv") == 0
    packed = tmp_path / "run.log.gz"
    packed.write_bytes(gzip.compress(log.read_bytes()))
    assert decode(packed, "-o", tmp_path / "b.csv") == 0
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "a.csv").read_bytes()
    piped = subprocess.run(
        [*DECODE, "-", "--format", "csv"], input=log.read_bytes(), capture_output=True, timeout=60, check=True
    )
    refused = subprocess.run([*DECODE, "-"], input=packed.read_bytes(), capture_output=True, timeout=60, check=False)
    assert (refused.returncode, refused.stdout) == (2, b"")
    assert refused.stderr.startswith(b"tipforce: stdin: gzip or zstd in a pipe: unpack it first")
    by_cell = [line.split(b",")[:6] for line in piped.stdout.splitlines()]
    assert by_cell[1:] == [line.split(b",")[:6] for line in (tmp_path / "a.csv").read_bytes().splitlines()][1:]


def test_head_ends_quietly(log: Path) -> None:
    for words in ([], ["--json"], ["--format", "csv"]):
        # More than a pipe holds: else all may be written, and told of, before head is gone.
        text = " ".join([*DECODE, *[str(log)] * 8, *words]) + " | head -1"
        done = subprocess.run(["bash", "-o", "pipefail", "-c", text], capture_output=True, timeout=60, check=False)
        assert done.returncode == 0
        assert len(done.stdout.splitlines()) == 1
        assert done.stderr == b""


def test_a_growing_log_is_followed(tmp_path: Path) -> None:
    lines = log_lines(40, (5,), loss=0.0)
    log = write_log(tmp_path / "run.log", lines[:60])
    with subprocess.Popen([*DECODE, "--follow", "--json", str(log)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = [json.loads(process.stdout.readline()) for _ in range(19)]
        with log.open("a") as stream:
            stream.write("".join(line + "\n" for line in lines[60:]))
        more = [json.loads(process.stdout.readline()) for _ in range(20)]
        process.terminate()
        assert process.wait(30) == 130
    assert [record["counter"] for record in first + more] == list(range(5, 44))


@pytest.mark.parametrize("follow", [True, False], ids=["a growing file", "stdin"])
def test_ctrl_c_completes_the_output_of_what_has_no_end(follow: bool, tmp_path: Path) -> None:
    """As `tipforce log`: what was read is in the file, and the report says it; the second Ctrl-C would interrupt."""
    lines = log_lines(40, (5,), loss=0.0)
    log, output = write_log(tmp_path / "run.log", lines[:60] if follow else lines), tmp_path / "run.csv"
    words = [*DECODE, "--follow", str(log)] if follow else [*DECODE, "-"]
    with subprocess.Popen([*words, "-o", str(output)], stdin=PIPE, stderr=PIPE) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        process.stdin.write(b"" if follow else log.read_bytes())
        process.stdin.flush()
        while not any(tmp_path.glob(".run.csv.*")):  # until it runs
            assert process.poll() is None
            time.sleep(0.01)
        if follow:
            with log.open("a") as stream:
                stream.write("".join(line + "\n" for line in lines[60:]))
        process.send_signal(signal.SIGINT)
        assert b"run.csv: 40 samples of 1 node" in process.stderr.read()
        assert process.wait(30) == 130
    rows = output.read_text()
    assert decode(write_log(tmp_path / "all.log", lines), "-q", "-o", output) == 0
    assert rows == output.read_text()


def test_text_for_people(tmp_path: Path, printed: Printed) -> None:
    frames = ["285#2E1129239A110303", "285#0080008000800204", "28F#E803008000800104"]
    log = write_log(tmp_path / "a.log", [f"(1700000000.00000{k}) can0 {frame}" for k, frame in enumerate(frames)])
    assert printed(0, f"decode {log}").out.splitlines() == [
        "(1700000000.000000)  node   5 (0x05)  P   4.398 N  phi   90.01 deg  theta   45.06 deg  #3  "
        "contact, calibrated",
        "(1700000000.000001)  node   5 (0x05)  P unknown    phi unknown      theta unknown      #4  calibrated",
        "(1700000000.000002)  node  15 (0x0F)  P   1.000 N  phi unknown      theta unknown      #4  contact",
    ]


def test_a_device_is_written_to(log: Path) -> None:
    assert decode(log, "-o", "/dev/null", "--format", "csv") == 0
    assert os.path.exists("/dev/null")
    assert not list(Path("/dev").glob(".null*"))
