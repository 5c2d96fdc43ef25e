"""The commands of the host, each in a process of its own, against a node in another; tests/tools has their words."""

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
OK, DIFFERENT, ABORT, REFUSED = 0, 1, 11, 12
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


def test_sdo_reads_and_writes_by_numbers_and_by_name(run: Run) -> None:
    # The first one as from a shell: a fresh interpreter.
    assert run("sdo", "read", ID, "0x1018", "4", "u32", fresh=True).stdout == f"{NODE_ID}\n"
    assert run("sdo", "write", ID, "0x1017", "0", "u16", "500").stdout == ""
    (record,) = records(run("sdo", "read", ID, "heartbeat.producer_ms", "--json"))
    assert (record["index"], record["value"]) == ("0x1017", 500)
    assert "0x06010002" in run("sdo", "write", ID, "0x1000", "0", "u32", "1", code=ABORT).stderr


def test_scan_lists_the_node_and_no_other(run: Run) -> None:
    (record,) = records(run("scan", "--wait", "0.3", "--json"))
    assert (record["node_id"], record["serial"], record["eds"]) == (NODE_ID, NODE_ID, "match")


def test_a_calibration_is_applied_verified_or_refused(run: Run, active: Callable[[], int], tmp_path: Path) -> None:
    ours, other = case_calibration("I", pull=True), case_calibration("II", pull=True)
    files = written(tmp_path, ours), written(tmp_path, other)
    (applied,) = records(run("calibrate", "apply", files[0], "--node", ID, "--json"))
    assert (applied["crc32"], active()) == (f"0x{ours.crc32():08X}", ours.crc32())
    assert run("calibrate", "verify", files[0], "--node", ID).stdout == "equal byte for byte\n"
    run("calibrate", "verify", files[1], "--node", ID, code=DIFFERENT)
    poor = written(tmp_path, replace(ours, C=ours.C * [1.0, 1.0, 1e-5]))
    assert "condition number" in run("calibrate", "apply", poor, "--node", ID, code=REFUSED).stderr
    assert active() == ours.crc32()


def test_config_apply_and_verify_of_a_dcf(run: Run, host: Bus, tmp_path: Path) -> None:
    path = tmp_path / "finger.dcf"
    path.write_text(dcf_text(3, NODE_ID, {(0x1017, 0): 700, (0x6114, 1): 2000, (0x2105, 1): 5000.0}))
    run("config", "apply", ID, str(path), "--store")
    assert run("config", "verify", ID, str(path)).stdout == ""
    host.sdo(NODE_ID).write(od.CALIBRATION_CONDITION_LIMIT, 1e4)
    run("config", "verify", ID, str(path), code=DIFFERENT)
