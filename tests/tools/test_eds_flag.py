"""`--eds`: sdo and decode on a device of any manufacturer, by the names of its file."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import tipforce
from eds.samples import text, var
from tipforce.machine import shipped_eds
from tipforce_tools.cli.main import main

LOG = """\
(1.000000) can0 000#0105
(1.010000) can0 185#500200
(1.020000) can0 205#0F0001
(1.030000) can0 285#E8030000FEFFFFFF
"""


@pytest.fixture
def eds(tmp_path: Path) -> str:
    return shutil.copy(str(shipped_eds("cia402")), str(tmp_path / "drive.eds"))


def test_sdo_by_the_names_of_the_file(eds: str, capsys: pytest.CaptureFixture[str]) -> None:
    bus = ("-i", "virtual", "-c", "eds-flag")
    with tipforce.simulated_device("cia402", 5, {"interface": "virtual", "channel": "eds-flag"}) as drive:
        drive["Home offset"] = -7
        for words, shown in (
            (("read", "5", "Home offset"), "-7"), (("read", "5", "0x607C", "0"), "-7"),
            (("read", "5", "Software position limit/Maximum position limit"), "1000000"),
            (("read", "5", "1008h"), "tipforce CiA 402 drive"),
        ):  # fmt: skip
            assert main(["sdo", *words, "--eds", eds, *bus]) == 0
            assert capsys.readouterr().out.strip() == shown
        assert main(["sdo", "write", "5", "Profile velocity", "2000", "--eds", eds, *bus]) == 0
        assert drive["Profile velocity"] == 2000
        capsys.readouterr()
        assert main(["sdo", "dump", "5", "--eds", eds, "--json", *bus]) == 0
        rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        by_name = {row["name"]: row["value"] for row in rows}
        assert by_name["Profile velocity"] == 2000
        assert by_name["Identity/Product code"] == 0x402
        assert len(rows) > 80
        assert main(["sdo", "read", "5", "Position", "--eds", eds, *bus]) == 2
        assert "'Position actual value' (0x6064:00)" in capsys.readouterr().err


def test_decode_by_the_names_of_the_file(eds: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run.log").write_text(LOG)
    assert main(["decode", str(tmp_path / "run.log"), "--eds", f"5={eds}", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["node"] for row in rows] == [5, 5, 5]
    assert rows[0]["Statusword"] == 0x250
    assert (rows[1]["Controlword"], rows[1]["Modes_of_operation"]) == (15, 1)
    assert (rows[2]["Position_actual_value"], rows[2]["Velocity_actual_value"]) == (1000, -2)
    for words, said in (
        (["--eds", eds], "the form is ID=FILE"),
        (["--eds", f"5={eds}", "--eds", f"5={eds}"], "node 5 has a file already"),
        (["--eds", "5=none.eds"], "No such file"), (["--eds", f"5={eds}", "--gauges", "4"], "leave out --dbc"),
    ):  # fmt: skip
        assert main(["decode", str(tmp_path / "run.log"), *words]) == 2
        assert said in capsys.readouterr().err


def test_dump_by_the_names_of_the_file(eds: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sdo = "(1.040000) can0 605#40FF600000000000\n(1.041000) can0 585#43FF6000D0070000\n"
    (tmp_path / "run.log").write_text(LOG + sdo)
    assert main(["dump", str(tmp_path / "run.log"), "--decode", "--eds", f"5={eds}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "TPDO1  Statusword=592 Modes_of_operation_display=0" in lines[1]
    assert "RPDO1  Controlword=15 Modes_of_operation=1" in lines[2]
    assert "TPDO2  Position_actual_value=1000 Velocity_actual_value=-2" in lines[3]
    assert "Target velocity" in lines[5]
    assert "2000" in lines[5]


def test_the_eds_that_a_node_stores(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "lamp.eds"
    path.write_text(text(var("1021", 0xF, "ro"), var("2000", 6, "rw", "500", ParameterName="Brightness")))
    bus = ("-i", "virtual", "-c", "stored-eds", "--json")
    with tipforce.simulated_device(path, 5, {"interface": "virtual", "channel": "stored-eds"}) as lamp:
        assert main(["sdo", "dump", "5", *bus]) == 0
        rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert ("Brightness", 500) in [(row["name"], row["value"]) for row in rows]
        assert main(["config", "show", "5", *bus]) == 0
        assert capsys.readouterr().out == ""
        lamp["Brightness"] = 7
        for eds in ((), ("--eds", str(path))):
            assert main(["config", "show", "5", *eds, *bus]) == 0
            (row,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
            assert (row["index"], row["name"], row["value"], row["default"]) == ("0x2000", "Brightness", 7, 500)
        assert main(["config", "verify", "5", str(path), "--eds", str(path), *bus]) == 2
