"""scan, sdo, config, calibrate and export, run in this process against nodes on the in-process bus."""

import io
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from canopen_device import types
from host.bus_with_nodes import beam_calibration, connected, finger, new_channel
from tipforce.dictionary import objects as od
from tipforce.dictionary.names import entries
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.network.bus import Bus
from tools.rig import Printed, Tipforce

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Bus, str]]:
    """Nodes 5 (with a store) and 6 (without), and the name of their bus."""
    store = tmp_path_factory.mktemp("store") / "node.json"
    channel = new_channel()
    with connected(finger(5, store=store), finger(6), channel=channel) as (connection, _):
        for node_id in (5, 6):
            connection.sdo(node_id).write(od.HEARTBEAT_PRODUCER_MS, 20)
        yield connection, channel


@pytest.fixture
def bus_words(bench: tuple[Bus, str]) -> tuple[str, ...]:
    return ("-i", "virtual", "-c", bench[1])


def test_scan(tipforce: Tipforce) -> None:
    code, out, err = tipforce("scan --wait 0.3")
    hint = "node {0} (0x0{0}): not calibrated: tipforce calibrate guide --node {0}, or apply CAL.toml\n"
    started = "nodes 5-6: not started: tipforce nmt start 5-6 --wait\n"
    assert (code, err) == (0, started + hint.format(5) + hint.format(6))
    lines = out.splitlines()
    assert len(lines) == 2
    assert lines[0].split() == [
        "5", "(0x05)", "pre-operational", "simulated", "fingertip,", "3", "gauges", "serial", "1005", "not",
        "calibrated", "EDS", "match",
    ]  # fmt: skip


def test_scan_as_json(tipforce: Tipforce) -> None:
    (record,) = tipforce("scan --wait 0.3 --nodes 6,10-12 --json", code=0).records
    assert record == {
        "node_id": 6, "state": "pre-operational", "device": "simulated fingertip, 3 gauges", "serial": 1006,
        "calibration": "not calibrated", "faults": "", "eds": "match", "duplicate": "", "product": 0x54500103,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("0x1018 2 u32", "1414529283"), ("0x1018 0x02", "1414529283"), ("4120 2", "1414529283"),
        ("identity.product", "1414529283"), ("0x1018:02", "1414529283"), ("1018h:02", "1414529283"),
        ("0x1018 4 u32", "1005"), ("calibration.generation", "0"), ("calibration.matrix:3", "0.0"),
        ("0x2100:03 ", "0.0"), ("0x1017 0 d", "14 00"), ("heartbeat.producer_ms", "20"), ("P", "nan"), ("SG2", "0.0"),
    ],
)  # fmt: skip
def test_sdo_read(tipforce: Tipforce, words: str, shown: str) -> None:
    assert tipforce("sdo", "read", "0x05", *words.split()) == (0, shown + "\n", "")


def test_sdo_read_as_json(tipforce: Tipforce) -> None:
    (record,) = tipforce("sdo read 5 identity.serial --json", code=0).records
    assert record == {"node": 5, "index": "0x1018", "sub": 4, "name": "identity.serial", "value": 1005}
    assert tipforce("sdo read 5 0x1018 4 d --json").records[0]["value"] == "ED 03 00 00"


@pytest.mark.parametrize(
    ("words", "value", "shown"),
    [
        ("simulation.P", "-1.5e-3", "-0.0015"), ("simulation.phi", "-90", "-90.0"), ("0x2101 2 r32", "nan", "nan"),
        ("0x1800 3", "0x64", "100"), ("tpdo1.inhibit_100us", "7", "7"),
    ],
)  # fmt: skip
def test_sdo_write_then_read(tipforce: Tipforce, words: str, value: str, shown: str) -> None:
    tipforce("sdo write 5 tpdo1.cob_id 0xC0000185")  # an inhibit time changes in an invalid PDO only
    code, out, err = tipforce("sdo", "write", 5, *words.split(), value)
    assert (code, out) == (0, "")
    assert err.startswith("node 5 (0x05) 0x")
    assert tipforce("sdo", "read", 5, *words.split())[1] == shown + "\n"


def test_sdo_dump_is_all_that_can_be_read(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    readable = {place: row for place, row in entries(3, True).items() if row.access != "wo" and row.index != 0x1021}
    code, out, err = tipforce("sdo dump 5 --json")
    records = {(int(r["index"], 16), r["sub"]): r for r in map(json.loads, out.splitlines())}
    # This node was given no EDS, and 1022h says how one is packed.
    assert (code, set(readable) - set(records), set(records) - set(readable)) == (0, {(0x1022, 0)}, set())
    assert f"{len(records)} entries, 1 of the dictionary it does not have" in err
    for place, record in records.items():
        assert (record["node"], record["name"], record["unit"]) == (5, readable[place].name, readable[place].unit)
    assert records[0x1018, 4]["value"] == 1005
    assert records[0x2140, 0]["value"] == types.format_value("D", bench[0].sdo(5).upload(0x2140, 0))
    lines = tipforce("sdo dump 5 -q")[1].splitlines()
    assert len(lines) == len(records)
    assert any(line.split() == ["0x1017:00", "heartbeat.producer_ms", "20", "ms"] for line in lines)


def test_sdo_dump_of_a_node_that_has_less(tipforce: Tipforce) -> None:
    """Asked for four gauges, a node of three leaves out what it does not have."""
    code, out, err = tipforce("sdo dump 5 --gauges 4 --json")
    three = {(r["index"], r["sub"]) for r in map(json.loads, out.splitlines())}
    assert code == 0
    assert 0 < len(three) < len([row for row in entries(4, True).values() if row.access != "wo"]) - 1
    assert "of the dictionary it does not have" in err


@pytest.mark.parametrize(("name", "what"), [("store:1", "stores parameters"), ("restore:4", "restores defaults")])
def test_sdo_asks_before_something_persists(
    printed: Printed, monkeypatch: pytest.MonkeyPatch, name: str, what: str
) -> None:
    """On a bus that counts as real; nobody is there to say yes."""
    monkeypatch.setattr("tipforce_tools.cli.bus_flags.open_connection", lambda _args: pytest.fail("the bus was opened"))
    monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
    assert what in printed(2, f"sdo write 5 {name} 0x65766173 -i socketcan -c can0").err


@pytest.fixture
def cal(tmp_path: Path) -> Path:
    path = tmp_path / "cal.toml"
    write_calibration(path, beam_calibration())
    return path


def test_calibrate_apply_then_verify(tipforce: Tipforce, cal: Path, tmp_path: Path) -> None:
    _, out, err = tipforce(f"calibrate apply {cal} --node 5", code=0)
    assert out.endswith(f", CRC-32 0x{beam_calibration().crc32():08X}\n")
    assert [line.split(": ")[0] for line in err.splitlines()] == ["node 5 (0x05)"] * 4
    equal = {"node": 5, "equal": True, "differences": []}
    assert tipforce(f"calibrate verify {cal} --node 5 --json").records == [equal]

    write_calibration(tmp_path / "other.toml", beam_calibration(serial=8))
    for words, difference in (
        (f"{tmp_path}/other.toml --node 5", "0x2102:01: expected 8, the node has 7\n"),
        (f"{cal} --node 6", "the node has no active calibration\n"),
    ):
        assert tipforce(f"calibrate verify {words}", code=1).out == difference


def test_calibrate_where_storing_is_refused(tipforce: Tipforce, cal: Path) -> None:
    err = tipforce(f"calibrate apply {cal} --node 6", code=11).err
    assert re.search("write of 0x1010:04.*has no store.*until its next reset.*--store FILE", err)
    assert tipforce(f"calibrate apply {cal} --node 6 --no-store --json -q")[0] == 0


def test_config_apply_then_verify(tipforce: Tipforce, tmp_path: Path) -> None:
    path = tmp_path / "finger.toml"
    path.write_text('[objects]\n"interrupt_delta:1" = 2.5\n"tpdo1.mapping" = ["status", "counter"]\n')
    _, out, err = tipforce(f"config verify 5 {path}", code=1)
    assert "interrupt_delta:1 (0x6133:01): expected 2.5, the node has 0.0\n" in out
    assert err == "node 5 (0x05): 4 objects, 4 different\n"
    assert tipforce(f"config apply 5 {path} --store -q") == (0, "", "")
    assert tipforce(f"config verify 5 {path} --json -q") == (0, "", "")
    expected = {"object": "interrupt_delta:1 (0x6133:01)", "expected": "2.5", "found": "0.0"}
    assert tipforce(f"config verify 6 {path} --json -q", code=1).records[-1] == expected


@pytest.mark.parametrize(("kind", "committed"), [("eds", "eds/tipforce-3.eds"), ("dbc", "dbc/tipforce.dbc")])
def test_export_is_the_committed_file(printed: Printed, tmp_path: Path, kind: str, committed: str) -> None:
    expected, path = (ROOT / committed).read_bytes(), tmp_path / "file"
    assert printed(0, f"export {kind}") == printed(0, f"export {kind} -o -") == (expected.decode(), "")
    assert printed(0, f"export {kind} -o {path}") == ("", f"{path}: {len(expected.splitlines())} lines\n")
    assert path.read_bytes() == expected
