"""python-can's udp_multicast as a bus without kernel CAN, in a network namespace with loopback only, so that no frame
leaves the machine."""

import json
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import can
import pytest
from websockets.sync.client import connect

from canopen_device.running.udp_multicast import DEFAULT_GROUP
from tipforce.host.configuration.calibration import write_calibration
from tipforce.scene import beam_calibration
from tipforce_tools.cli.main import main
from tools.rig import TIPFORCE, Printed, in_namespace

ROUTE = "ip link set lo up && ip route add 239.0.0.0/8 dev lo && "
RUN = 'exec python "$@"'
FLAGS = ("-i", "udp_multicast", "-c", DEFAULT_GROUP)
LOAD = (4.4, 90.0, 45.0)
HAND = f"""
bus = {{ interface = "udp_multicast", channel = "{DEFAULT_GROUP}" }}
hand = {{ sync_hz = 50 }}
finger = [{{ node_id = 1, calibration = "cal.toml" }}, {{ node_id = 2, calibration = "cal.toml" }}]
"""


def start(opened: ExitStack, *words: str) -> subprocess.Popen[str]:
    """A command that runs until the end of the walk."""
    process = subprocess.Popen([*TIPFORCE, *words, *FLAGS], stdout=subprocess.PIPE, text=True)
    opened.callback(process.wait, timeout=30)
    opened.callback(process.terminate)
    return process


def page_message(process: subprocess.Popen[str]) -> dict[str, Any]:
    """The first message of the page in which both fingers are live."""
    assert process.stdout is not None
    port = json.loads(process.stdout.readline())["url"].rstrip("/").rpartition(":")[2]
    with connect(f"ws://127.0.0.1:{port}/live") as socket:
        socket.send('{"do": "stream"}')
        while True:
            message: dict[str, Any] = json.loads(socket.recv(30))["answer"]
            if [finger["w"] for finger in message["fingers"]] == ["live", "live"]:
                return message


def walk(folder: Path) -> None:
    """Two nodes, a hand, a page and the commands between them."""
    write_calibration(folder / "cal.toml", beam_calibration("I", pull=True))
    (folder / "hand.toml").write_text(HAND)
    emergencies = can.BufferedReader()
    with ExitStack() as opened:
        # python-can's own bus: it shows that other programs receive these frames.
        bus = opened.enter_context(can.Bus(interface="udp_multicast", channel=DEFAULT_GROUP))
        bus.set_filters([{"can_id": 0x80, "can_mask": 0x780, "extended": False}])
        opened.callback(can.Notifier(bus, [emergencies], timeout=0.05).stop)
        for node_id in ("1", "2"):
            start(opened, "node", "--node-id", node_id, "--load", ",".join(map(str, LOAD)), "--noise", "0.5", "-q")
        assert main(["nmt", "preop", "1,2", "--wait", *FLAGS]) == 0
        assert main(["scan", "--nodes", "1-3", "--json", *FLAGS]) == 0
        assert main(["hand", "run", str(folder / "hand.toml"), "--seconds", "0.3", "--json"]) == 0
        listening = start(opened, "view", "--port", "0", "--json")
        hand = start(opened, "view", str(folder / "hand.toml"), "--port", "0", "--json")
        for page in (hand, listening):
            print(json.dumps({"page": page_message(page)["fingers"]}))
        hand.terminate()
        assert hand.wait(30.0) == 0  # it stops the fingers as it ends
        assert main(["read", "1,2", "--json", *FLAGS]) == 0
    heard = []
    while (message := emergencies.get_message(0.0)) is not None:
        heard.append(message)
    emcy = [bytes(message.data).hex() for message in heard if message.arbitration_id != 0x80]
    print(json.dumps({"emcy": emcy, "syncs": len(heard) - len(emcy)}))


def test_nodes_a_hand_a_page_and_commands(tmp_path: Path) -> None:
    done = in_namespace(ROUTE + RUN, __file__, str(tmp_path))
    assert done.returncode == 0, done.stderr
    records = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    scanned = [record for record in records if "device" in record]
    assert [(record["node_id"], record["eds"]) for record in scanned] == [(1, "match"), (2, "match")]
    rows = [[record[name].get("P") for name in "12"] for record in records if "row" in record]  # late: no P
    assert [P for P in rows if None not in P][-1] == pytest.approx([4.4, 4.4], abs=0.1)
    pages = [record["page"] for record in records if "page" in record]
    read = [record for record in records if "P_newtons" in record]
    contacts = [[record["P_newtons"], record["phi_deg"], record["theta_deg"]] for record in read]
    for contact in (*contacts, *(finger["c"] for page in pages for finger in page)):
        assert contact == [
            pytest.approx(4.4, abs=0.1), pytest.approx(90.0, abs=1.5), pytest.approx(45.0, abs=1.5),
        ]  # fmt: skip
    assert (len(read), len(pages)) == (2, 2)
    assert records[-1]["emcy"] == []  # own frames would be reported as a collision of COB-IDs
    assert records[-1]["syncs"] > 5


def test_a_bus_hears_others_but_not_itself_and_survives_foreign_datagrams() -> None:
    done = in_namespace(ROUTE + RUN, "-c", """if True:
        import socket
        import can
        from tipforce.host.network.interfaces import open_bus
        from canopen_device.running.udp_multicast import DEFAULT_GROUP as group
        frame = can.Message(arbitration_id=0x123, data=b"own", is_extended_id=False)
        with open_bus(interface="udp_multicast", channel=group) as one, open_bus(interface="udp_multicast") as other:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
                for noise in (b"", b"rubbish", bytes(300)):
                    stranger.sendto(noise, (group, 43113))
            one.send(frame)
            other.send(can.Message(arbitration_id=0x124, is_extended_id=False))
            print([hex(one.recv(2.0).arbitration_id), one.recv(0.0)])
            print([hex(other.recv(2.0).arbitration_id), other.recv(0.0)], frame.timestamp)
    """)  # fmt: skip
    assert done.stderr == ""
    assert done.stdout.splitlines() == ["['0x124', None]", "['0x123', None] 0.0"]


def test_a_machine_without_a_route() -> None:
    done = in_namespace(RUN, "-m", "tipforce_tools.cli.main", "scan", "-i", "udp_multicast", "-c", "239.74.163.2")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("tipforce: udp_multicast, group 239.74.163.2: [Errno 19] No such device; without a network")
    assert "ip route add 239.0.0.0/8 dev lo" in line


def test_doctor_opens_it() -> None:
    words = ("-c", "import tipforce_tools.doctor.machine as v; print(*map(repr, v.multicast_checks()))")
    assert "state='ok'" in in_namespace(ROUTE + RUN, *words).stdout
    assert "ip route add" in in_namespace(RUN, *words).stdout


@pytest.mark.parametrize(
    ("interface", "module", "package"),
    [("udp_multicast", "udp_multicast.utils.msgpack", "msgpack"), ("slcan", "slcan.serial", "pyserial")],
)
def test_a_missing_package_is_named(
    interface: str, module: str, package: str, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    monkeypatch.setattr(f"can.interfaces.{module}", None)
    err = printed(2, f"scan -i {interface} -c /dev/none").err
    assert err == f"tipforce: {interface} needs {package}: pip install {package}\n"


if __name__ == "__main__":
    walk(Path(sys.argv[1]))
