"""nmt, lss and tare, run in this process against nodes on the in-process bus."""

import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from canopen_device.running.store import FileStore
from host.bus_with_nodes import apply_load, beam_calibration, connected, finger, new_channel, running
from tipforce.dictionary import objects as od
from tipforce.fingertip.node import fingertip_node
from tipforce.host.network.bus import Bus
from tipforce.host.network.finger import FingertipClient
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.strain import strain_matrix
from tipforce.sources.simulated import SimulatedSource
from tipforce_tools.cli.main import main
from tools.rig import Tipforce


@pytest.fixture
def bench() -> Iterator[tuple[Bus, str]]:
    """Nodes 5 and 6, and the name of their bus."""
    channel = new_channel()
    with connected(finger(5), finger(6), channel=channel) as (connection, _):
        for node_id in (5, 6):
            connection.sdo(node_id).write(od.HEARTBEAT_PRODUCER_MS, 20)
        yield connection, channel


@pytest.fixture
def bus_words(request: pytest.FixtureRequest) -> tuple[str, ...]:
    """The bus of ``bench`` or ``unconfigured``."""
    name = "unconfigured" if "unconfigured" in request.fixturenames else "bench"
    return ("-i", "virtual", "-c", request.getfixturevalue(name)[1])


@pytest.fixture
def unconfigured(tmp_path: Path) -> Iterator[tuple[Bus, str]]:
    """Three nodes without a node-id, serials 7, 0x80000001 and 9, and node 20; they can store."""
    devices = []
    rows = strain_matrix(FABRICATED, "I").tolist()
    for serial in (7, 0x80000001, 9):
        store = FileStore(tmp_path / f"{serial}.json")
        devices.append(fingertip_node(255, SimulatedSource(rows), serial=serial, save=store.save, load=store.load))
    channel = new_channel()
    with connected(finger(20), channel=channel) as (connection, _), running(devices, channel):
        yield connection, channel


def test_nmt_waits_for_each_heartbeat(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    assert tipforce("nmt", "start", "5,6", "--wait") == (0, "   5 (0x05)  operational\n   6 (0x06)  operational\n", "")
    code, out, _ = tipforce("nmt", "stop", "0x06", "--wait", "--json")
    assert (code, json.loads(out)) == (0, {"node_id": 6, "state": "stopped"})
    for command in ("reset-node", "reset-comm"):
        assert tipforce("nmt", command, "6", "--wait") == (0, "   6 (0x06)  boot-up\n", "")
    assert bench[0].sdo(6).read(od.HEARTBEAT_PRODUCER_MS) == 1000


def test_nmt_to_all_is_one_frame(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    bench[0].buffer.clear()
    assert tipforce("nmt", "start", "all") == (0, "", "")
    bench[0].wait_for({0x705, 0x706})
    code, _, err = tipforce("nmt", "start", "all", "--wait")
    assert code == 2
    assert "needs node-ids" in err


def test_a_node_that_does_not_say_so_is_named(tipforce: Tipforce) -> None:
    code, out, err = tipforce("nmt", "start", "5,9", "--wait", "0.2")
    assert (code, out) == (5, "   5 (0x05)  operational\n")  # the one that did is named, too
    assert "from node 9 (silent)" in err
    code, out, err = tipforce("nmt", "stop", "5,9", "--wait", "0.2", "--json")
    assert (code, json.loads(out)) == (5, {"node_id": 5, "state": "stopped"})


def test_nmt_start_is_repeated_until_the_node_has_booted(capsys: pytest.CaptureFixture[str]) -> None:
    """The order in which a person pastes two lines does not matter."""
    channel = new_channel()
    device = finger(7)
    codes: list[int] = []
    words = ["nmt", "start", "7", "--wait", "-i", "virtual", "-c", channel]
    with Bus.open(channel, "virtual") as listener:
        thread = threading.Thread(target=lambda: codes.append(main(words)))
        thread.start()
        listener.wait_for({0x000}, timeout_s=20.0)  # it has sent the command once, to nobody
        with running([device], channel):
            thread.join()
    assert codes == [0]
    assert capsys.readouterr().out == "   7 (0x07)  operational\n"


def test_read_prints_the_contact_of_each_finger(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    connection = bench[0]
    FingertipClient(connection.sdo(5)).apply_calibration(beam_calibration(), store=False)
    apply_load(connection, 5, 4.4, 90.0, 45.0)
    code, out, err = tipforce("read", "5")
    assert (code, err) == (0, "")
    assert re.fullmatch(
        r"   5 \(0x05\)  4\.4\d\d N, phi (89|90)\.\d\d deg, theta 4[45]\.\d\d deg  u\(P\) 0\.\d{3} N\n", out
    )
    code, out, err = tipforce("read", "6", "-n", "2", "--json")
    assert err == "node 6 (0x06): not calibrated: tipforce calibrate guide --node 6, or apply CAL.toml\n", "once"
    first, second = map(json.loads, out.splitlines())
    assert (code, first["node_id"], first["P_newtons"], first["reason"]) == (0, 6, None, "not calibrated")
    assert first["counter"] != second["counter"]
    code, out, err = tipforce("read", "9", "--wait", "0.2", "--timeout", "0.05", "--retries", "0")
    assert (code, out) == (5, "")
    assert "node 9" in err


def test_lss_scan_finds_one_without_a_node_id(tipforce: Tipforce, unconfigured: tuple[Bus, str]) -> None:
    code, out, err = tipforce("lss", "scan", "--lss-timeout", "0.05", "--json")
    assert code == 0
    assert json.loads(out) == {
        "vendor": 0, "product": 0x54500103, "revision": 0x00020000, "serial": 7, "node_id": None, "stored": False,
    }  # fmt: skip
    assert "finds one at a time" in err
    assert unconfigured[0].sdo(20).read(od.IDENTITY_SERIAL) == 1020


def test_lss_assign_numbers_all(tipforce: Tipforce, unconfigured: tuple[Bus, str], tmp_path: Path) -> None:
    connection = unconfigured[0]
    code, out, _ = tipforce("lss", "assign", "1-3", "--store", "--lss-timeout", "0.05")
    assert code == 0
    assert [line.split("serial ")[1] for line in out.splitlines()] == [
        "7: node-id 1 (0x01), stored", "9: node-id 2 (0x02), stored", "2147483649: node-id 3 (0x03), stored",
    ]  # fmt: skip
    assert [connection.sdo(n).read(od.IDENTITY_SERIAL) for n in (1, 2, 3)] == [7, 9, 0x80000001]
    stored = FileStore(tmp_path / "9.json").load("lss")
    assert stored is not None
    assert stored.endswith(bytes((2, 0)))
    code, _, err = tipforce("lss", "assign", "4", "--lss-timeout", "0.05")
    assert code == 5
    assert "Configured nodes take no part" in err


def test_lss_renumbers_a_configured_node(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    code, out, err = tipforce("lss", "assign", "9", *("--serial", "1005", "--product", "0x54500103"))
    assert code == 0
    assert out.endswith("serial 1005: node-id 9 (0x09)\n")
    assert "node-id 5 (0x05) remains active" in err
    assert tipforce("nmt", "reset-comm", "5")[0] == 0
    bench[0].wait_for({0x709})
    assert bench[0].sdo(9).read(od.IDENTITY_SERIAL) == 1005


def test_tare_shows_and_clears(tipforce: Tipforce, bench: tuple[Bus, str]) -> None:
    connection = bench[0]
    FingertipClient(connection.sdo(5)).apply_calibration(beam_calibration(), store=False)
    apply_load(connection, 5, 2.0, 0.0, 0.0)
    code, out, _ = tipforce("tare", "5", "--json")
    record = json.loads(out)
    assert code == 0
    assert record["F3_N"] == pytest.approx(2.0, abs=5e-3)
    assert record["node_id"] == 5
    assert tipforce("tare", "5", "--show")[1].startswith("   5 (0x05)  F1 ")
    assert "no tare" in tipforce("tare", "5", "--clear")[1]
