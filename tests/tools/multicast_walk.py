"""Two nodes, a hand, a page and the commands between them on udp_multicast; run by test_udp_multicast.py.

It runs in a network namespace of its own, with loopback as the only interface, so that no frame leaves the machine."""

import json
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import can
from websockets.sync.client import connect

from canopen_device.running.udp_multicast import DEFAULT_GROUP
from tipforce.host.configuration.calibration import write_calibration
from tipforce.scene import beam_calibration
from tipforce_tools.cli.main import main

TIPFORCE = (sys.executable, "-m", "tipforce_tools.cli.main")
FLAGS = ("-i", "udp_multicast", "-c", DEFAULT_GROUP)
LOAD = (4.4, 90.0, 45.0)
HAND = f"""
[bus]
interface = "udp_multicast"
channel = "{DEFAULT_GROUP}"
[hand]
sync_hz = 50
[[finger]]
node_id = 1
calibration = "cal.toml"
[[finger]]
node_id = 2
calibration = "cal.toml"
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


if __name__ == "__main__":
    walk(Path(sys.argv[1]))
