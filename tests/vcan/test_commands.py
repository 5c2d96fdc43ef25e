"""The commands of the host, each in a process of its own, against a node in another; tests/tools has their words."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tipforce.dictionary import objects as od
from tipforce.dictionary.eds import dcf_text
from tipforce.host.configuration.calibration import Calibration, write_calibration
from tipforce.host.network.bus import Bus
from tipforce_tools.demo.job import case_calibration
from vcan.support import BUS, HEARTBEAT, NODE_ID, Command, Launch, RawBus, wait_until

pytestmark = pytest.mark.usefixtures("node")
OK, DIFFERENT, USAGE, ABORT, REFUSED = 0, 1, 2, 11, 12
ID = str(NODE_ID)
NOBODY = 127

Run = Callable[..., Command]


@pytest.fixture
def run(launch: Launch, host: Bus, bus: RawBus) -> Run:
    """Run a command on the bus to its end, and hold it to its exit code."""

    def heard_all() -> bool:
        """What the node said to the command has passed by the host, too, and can't be taken for an answer to it."""
        since_s = time.monotonic()
        bus.send(HEARTBEAT + NOBODY, b"\x7f")
        return host.heartbeats.wait(NOBODY, 0x7F, since_s, 1.0)

    def to_the_end(*words: str, code: int = OK, fresh: bool = False) -> Command:
        command = launch(*words, *BUS, fresh=fresh)
        assert command.wait() == code, command.stderr
        assert "Traceback" not in command.stderr
        wait_until(heard_all, "the host should hear the bus")
        return command

    return to_the_end


@pytest.fixture
def active(host: Bus) -> Callable[[], int]:
    """Reads the active CRC-32 (2103h:3) of the node, by the host library in this process."""
    return lambda: host.sdo(NODE_ID).read(od.CALIBRATION_ACTIVE_CRC)


def records(command: Command) -> list[dict[str, object]]:
    """What `--json` printed: every line is a JSON object."""
    found = [json.loads(line) for line in command.stdout.splitlines()]
    assert all(isinstance(record, dict) for record in found)
    return found


def written(folder: Path, calibration: Calibration) -> str:
    path = folder / f"{calibration.crc32():08X}.toml"
    write_calibration(path, calibration)
    return str(path)


# sdo


def test_sdo_read_by_numbers_by_name_and_as_json(run: Run) -> None:
    # The first one as from a shell: a fresh interpreter.
    assert run("sdo", "read", ID, "0x1018", "4", "u32", fresh=True).stdout == f"{NODE_ID}\n"
    assert run("sdo", "read", ID, "heartbeat.producer_ms").stdout == "1000\n"
    assert records(run("sdo", "read", ID, "0x1017", "0", "--json")) == [
        {"node": NODE_ID, "index": "0x1017", "sub": 0, "name": "heartbeat.producer_ms", "value": 1000}
    ]


def test_sdo_write_by_numbers_and_by_name(run: Run, host: Bus) -> None:
    assert run("sdo", "write", ID, "0x1017", "0", "u16", "500").stdout == ""
    assert host.sdo(NODE_ID).read(od.HEARTBEAT_PRODUCER_MS) == 500
    run("sdo", "write", ID, "heartbeat.producer_ms", "0x3E8")
    assert host.sdo(NODE_ID).read(od.HEARTBEAT_PRODUCER_MS) == 1000
    run("sdo", "write", ID, "calibration.matrix:3", "-1.5")
    assert host.sdo(NODE_ID).read(od.CALIBRATION_MATRIX[3]) == -1.5


def test_sdo_abort_is_named(run: Run) -> None:
    command = run("sdo", "write", ID, "0x1000", "0", "u32", "1", code=ABORT)
    assert "0x06010002" in command.stderr
    assert command.stdout == ""


def test_no_such_interface_is_said_without_a_traceback(launch: Launch) -> None:
    command = launch("sdo", "read", ID, "0x1000", "0", "-i", "socketcan", "-c", "nosuchbus0")
    assert command.wait() == USAGE
    assert "nosuchbus0" in command.stderr
    assert "Traceback" not in command.stderr


# scan


def test_scan_lists_the_node_and_no_other(run: Run) -> None:
    (record,) = records(run("scan", "--wait", "0.3", "--json"))
    assert (record["node_id"], record["serial"], record["eds"]) == (NODE_ID, NODE_ID, "match")
    assert run("scan", "--nodes", "1-8", "--wait", "0.3").stdout.split()[:2] == [ID, f"(0x{NODE_ID:02X})"]


# calibrate


def test_calibrate_apply_then_verify(run: Run, active: Callable[[], int], tmp_path: Path) -> None:
    ours, other = case_calibration("I", pull=True), case_calibration("II", pull=True)
    files = written(tmp_path, ours), written(tmp_path, other)
    (applied,) = records(run("calibrate", "apply", files[0], "--node", ID, "--json"))
    assert applied["crc32"] == f"0x{ours.crc32():08X}"
    assert active() == ours.crc32()
    assert run("calibrate", "verify", files[0], "--node", ID).stdout == "equal byte for byte\n"
    (verified,) = records(run("calibrate", "verify", files[1], "--node", ID, "--json", code=DIFFERENT))
    assert verified["equal"] is False
    assert any(str(line).startswith("0x2100:01") for line in verified["differences"])  # type: ignore[attr-defined]


def test_refused_calibration_leaves_the_active_one(run: Run, active: Callable[[], int], tmp_path: Path) -> None:
    good = case_calibration("III", pull=True)
    run("calibrate", "apply", written(tmp_path, good), "--node", ID)
    poor = written(tmp_path, replace(good, C=good.C * [1.0, 1.0, 1e-5]))
    assert "condition number" in run("calibrate", "apply", poor, "--node", ID, code=REFUSED).stderr
    assert active() == good.crc32()


# config


def test_config_apply_and_verify_of_a_toml_file(run: Run, host: Bus, tmp_path: Path) -> None:
    path = tmp_path / "finger.toml"
    path.write_text(
        "[objects]\n"
        '"heartbeat.producer_ms" = 800\n'
        '"0x6114:01" = 1000\n'
        '"tpdo3.mapping" = ["process_value_int16:7", "status", "counter"]\n'
        f'"tpdo3.cob_id" = 0x{0x40000380 + NODE_ID:08X}\n'
    )
    assert run("config", "verify", ID, str(path), code=DIFFERENT).stdout.count("\n") == 7
    assert run("config", "apply", ID, str(path), "--store").stdout == ""
    run("config", "verify", ID, str(path))
    sdo = host.sdo(NODE_ID)
    assert [sdo.read(od.TPDO3_MAPPED), sdo.read(od.TPDO3_MAPPING[1])] == [3, 0x71300710]
    sdo.write(od.HEARTBEAT_PRODUCER_MS, 900)
    (difference,) = records(run("config", "verify", ID, str(path), "--json", code=DIFFERENT))
    assert (difference["expected"], difference["found"]) == ("800", "900")


def test_config_apply_and_verify_of_a_dcf(run: Run, host: Bus, tmp_path: Path) -> None:
    path = tmp_path / "finger.dcf"
    values = {(0x1017, 0): 700, (0x6114, 1): 2000, (0x2105, 1): 5000.0, (0x1803, 5): 250}
    path.write_text(dcf_text(3, NODE_ID, values))
    run("config", "apply", ID, str(path))
    assert run("config", "verify", ID, str(path)).stdout == ""
    assert host.sdo(NODE_ID).read(od.HEARTBEAT_PRODUCER_MS) == 700
    assert host.sdo(NODE_ID).read(od.CALIBRATION_CONDITION_LIMIT) == 5000.0
    host.sdo(NODE_ID).write(od.CALIBRATION_CONDITION_LIMIT, 1e4)
    run("config", "verify", ID, str(path), code=DIFFERENT)
