"""What Wireshark's CANopen dissector says of a session of the canopen library with our node.

    python -m bench.tshark [-o SESSION.log]

Needs tshark (apt-get install tshark). The session has every transfer that the library knows: SDO expedited, segmented
and block both ways, NMT, heartbeat, LSS fastscan and configuration, PDO read, remap and save, SYNC, EMCY. Exit code 1
if a frame is malformed or the dissector reports an error.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import can
import canopen

from tipforce.dictionary.eds import eds_text
from tipforce.dictionary.table import product_code
from tipforce.fingertip.node import fingertip_node
from tipforce.running import loop
from tipforce.running.ports import PythonCanPort
from tipforce.sources.simulated import SimulatedSource

ROOT = Path(__file__).parents[1]
STRAIN_PER_NEWTON = [[1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0], [0.0, 0.0, 1e-4]]
NODE = 5


class CandumpLog(can.Listener):
    """Writes each frame as `candump -L` does: tshark opens that, and not what python-can itself writes."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="ascii")
        self._lock = threading.Lock()
        self.frames = 0

    def on_message_received(self, msg: can.Message) -> None:
        with self._lock:
            self.frames += 1
            data = "R" if msg.is_remote_frame else msg.data.hex().upper()
            self._file.write(f"({msg.timestamp:.6f}) can0 {msg.arbitration_id:03X}#{data}\n")

    def stop(self) -> None:
        self._file.close()


def session(log: Path) -> int:
    """Run the session and write the log; returns the number of frames."""
    store: dict[str, bytes] = {}
    source = SimulatedSource(STRAIN_PER_NEWTON)
    device = fingertip_node(
        255,
        source,
        serial=0x1234,
        save=lambda group, data: not store.update({group: data}),
        load=store.get,
        eds=eds_text(3, simulated=True).encode(),
    )
    stopped = threading.Event()
    recorder = CandumpLog(log)
    with (
        can.Bus(interface="virtual", channel="tshark") as node_bus,
        can.Bus(interface="virtual", channel="tshark") as log_bus,
    ):
        notifier = can.Notifier(log_bus, [recorder])
        thread = threading.Thread(target=loop.run, args=([device], PythonCanPort(node_bus), stopped.is_set))
        thread.start()
        try:
            with canopen.Network() as network:
                network.connect(interface="virtual", channel="tshark")
                _configure_by_lss(network)
                _transfer(network, source)
        finally:
            stopped.set()
            thread.join()
            time.sleep(0.2)  # the last frames reach the log
            notifier.stop()
    return recorder.frames


def _configure_by_lss(network: canopen.Network) -> None:
    found, identity = network.lss.fast_scan()
    if not found or identity[1] != product_code(3, True):
        raise SystemExit(f"fastscan did not find the node: {identity}")
    network.lss.configure_node_id(NODE)
    network.lss.configure_bit_timing(0)
    network.lss.store_configuration()
    if network.lss.inquire_lss_address(0x5B) != product_code(3, True):
        raise SystemExit("the product code by LSS is another one")
    network.lss.send_switch_state_global(network.lss.WAITING_STATE)


def _transfer(network: canopen.Network, source: SimulatedSource) -> None:
    node = network.add_node(NODE, str(ROOT / "eds" / "tipforce-3.eds"))
    node.sdo.RESPONSE_TIMEOUT = 2.0
    node.nmt.wait_for_heartbeat(timeout=5) if node.nmt.state == "INITIALISING" else None
    node.sdo["Producer heartbeat time"].raw = 50
    _ = node.sdo["Manufacturer device name"].raw
    record = node.sdo.upload(0x2141, 0)
    node.sdo.download(0x2141, 0, record)
    with node.sdo.open(0x2141, 0, "rb", block_transfer=True) as file:
        if file.read() != record:
            raise SystemExit("block upload gave other bytes")
    with node.sdo.open(0x2141, 0, "wb", size=len(record), block_transfer=True) as file:
        file.write(record)
    with node.sdo.open(0x1021, 0, "rb", block_transfer=True) as file:
        if file.read() != eds_text(3, simulated=True).encode():
            raise SystemExit("block upload of the EDS gave other bytes")
    node.tpdo.read()
    node.tpdo[2].clear()
    node.tpdo[2].add_variable(0x7130, 1)
    node.tpdo[2].add_variable(0x2120)
    node.tpdo[2].save()
    node.nmt.state = "OPERATIONAL"
    for _ in range(20):
        network.sync.transmit()
        time.sleep(0.005)
    source.fault = 3  # a saturated gauge: EMCY
    network.sync.transmit()
    time.sleep(0.05)
    source.fault = 0
    network.sync.transmit()
    time.sleep(0.05)
    node.nmt.state = "STOPPED"
    node.nmt.state = "RESET"
    time.sleep(0.3)


def complaints(log: Path) -> list[str]:
    """What the dissector does not like: malformed frames, and its own warnings and errors."""
    fields = ["-T", "fields", "-e", "frame.number", "-e", "_ws.expert.message", "-e", "_ws.col.Info"]
    command = ["tshark", "-r", str(log), "-d", "can.subdissector,canopen", *fields]
    bad = "_ws.malformed || _ws.expert.severity >= 0x600000"  # warnings and errors
    done = subprocess.run([*command, "-Y", bad], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def dissected(log: Path) -> int:
    """How many frames the dissector took for CANopen."""
    command = ["tshark", "-r", str(log), "-d", "can.subdissector,canopen", "-Y", "canopen"]
    return len(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines())


def main() -> int:
    parser = argparse.ArgumentParser(description="a session with the canopen library, judged by Wireshark's dissector")
    parser.add_argument("-o", "--output", metavar="LOG", help="keep the recording")
    args = parser.parse_args()
    if shutil.which("tshark") is None:
        print("tshark is missing: apt-get install -y --no-install-recommends tshark", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        log = Path(args.output) if args.output else Path(folder) / "session.log"
        frames = session(log)
        bad, known = complaints(log), dissected(log)
    print(f"{frames} frames, {known} dissected as CANopen, {len(bad)} with a complaint")
    for line in bad[:10]:
        print(f"  {line}")
    return 1 if bad or known < frames else 0


if __name__ == "__main__":
    sys.exit(main())
