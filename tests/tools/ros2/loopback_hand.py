"""A process of test_loopback: a simulated hand and `tipforce ros2` on its bus; commands come on stdin.

fault NODE NAME | end"""

import signal
import sys
import threading
from pathlib import Path

import tipforce
from tipforce_tools.cli.main import main

NAMES = ("thumb", "index")
LOADS = {1: (4.4, -90.0, 80.0), 2: (2.2, -100.0, 70.0)}
SYNC_HZ = 50


def run(folder: Path) -> int:
    """Publish until stdin says end."""
    with tipforce.simulated_hand(len(NAMES), LOADS, interface="virtual", channel="ros2") as bus:
        text = f'[bus]\ninterface = "virtual"\nchannel = "ros2"\n[hand]\nsync_hz = {SYNC_HZ}\n'
        for node_id, name in enumerate(NAMES, 1):
            text += f'[[finger]]\nname = "{name}"\nnode_id = {node_id}\n'
        Path(folder, "hand.toml").write_text(text)
        threading.Thread(target=_obey, args=(bus,), daemon=True).start()
        return main(["ros2", str(folder / "hand.toml"), "--allow-tare", "--namespace", "left", "--seconds", "300"])


def _obey(bus: tipforce.SimulatedBus) -> None:
    for line in sys.stdin:
        what, *rest = line.split()
        if what == "fault":
            bus.inject_fault(int(rest[0]), rest[1])
        elif what == "end":
            signal.raise_signal(signal.SIGTERM)  # SIGINT is ignored in what a shell runs in the background


if __name__ == "__main__":
    sys.exit(run(Path(sys.argv[1])))
