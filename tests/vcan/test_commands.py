"""Commands of the host, each in a process of its own, against a node in another; tests/tools has their words."""

import json
from collections.abc import Callable

import pytest

from vcan.support import BUS, NODE_ID, Command, Launch

pytestmark = pytest.mark.usefixtures("node")
ABORT = 11
ID = str(NODE_ID)


@pytest.fixture
def run(launch: Launch) -> Callable[..., Command]:
    """Run a command on the bus to its end, and hold it to its exit code."""

    def to_the_end(*words: str, code: int = 0) -> Command:
        command = launch(*words, *BUS)
        assert command.wait() == code, command.stderr
        assert "Traceback" not in command.stderr
        return command

    return to_the_end


def test_sdo_reads_and_writes_by_numbers_and_by_name(run: Callable[..., Command]) -> None:
    assert run("sdo", "read", ID, "0x1018", "4", "u32").stdout == f"{NODE_ID}\n"
    assert run("sdo", "write", ID, "0x1017", "0", "u16", "500").stdout == ""
    record = json.loads(run("sdo", "read", ID, "heartbeat.producer_ms", "--json").stdout)
    assert (record["index"], record["value"]) == ("0x1017", 500)
    assert "0x06010002" in run("sdo", "write", ID, "0x1000", "0", "u32", "1", code=ABORT).stderr
    record = json.loads(run("scan", "--wait", "0.3", "--json").stdout)
    assert (record["node_id"], record["serial"], record["eds"]) == (NODE_ID, NODE_ID, "match")
