"""What Wireshark's CANopen dissector says of a session of the canopen library with our node.

    python -m bench.tshark

Needs tshark (apt-get install tshark). The session has every transfer that the library knows: SDO expedited, segmented
and block both ways, NMT, heartbeat, LSS fastscan and configuration, PDO read, remap and save, SYNC, EMCY. Exit code 1
if a frame is malformed or the dissector reports an error.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import can
import canopen
from bench.decode import write_log
from bench.fuzz import STRAIN_PER_NEWTON
from bench.measure import ROOT, arguments

from canopen_device.running import loop
from canopen_device.running.ports import PythonCanPort
from canopen_device.running.store import MemoryStore
from tipforce.dictionary.eds import eds_text
from tipforce.dictionary.table import product_code
from tipforce.fingertip.node import fingertip_node
from tipforce.host.frames.frame_array import frame_array, raw_frame
from tipforce.sources.simulated import SimulatedSource

NODE = 5
COMPLAINTS = "_ws.malformed || _ws.expert.severity >= 0x600000"
"""Of the dissector: malformed frames, and its own warnings and errors."""


def session(log: Path) -> int:
    """Run the session and write the log; returns the number of frames."""
    store = MemoryStore()
    source = SimulatedSource(STRAIN_PER_NEWTON)
    eds = eds_text(3, simulated=True).encode()
    device = fingertip_node(255, source, serial=0x1234, save=store.save, load=store.load, eds=eds)
    recorded: list[can.Message] = []
    with (
        can.Bus(interface="virtual", channel="tshark") as node_bus,
        can.Bus(interface="virtual", channel="tshark") as log_bus,
    ):
        notifier = can.Notifier(log_bus, [recorded.append])
        port = PythonCanPort(node_bus)
        with loop.running([device], port), canopen.Network() as network:
            network.connect(interface="virtual", channel="tshark")
            heard, identity = network.lss.fast_scan()
            if not heard or identity[1] != product_code(3, True):
                raise SystemExit(f"fastscan did not find the node: {identity}")
            network.lss.configure_node_id(NODE)
            network.lss.configure_bit_timing(0)
            network.lss.store_configuration()
            if network.lss.inquire_lss_address(0x5B) != product_code(3, True):
                raise SystemExit("the product code by LSS is another one")
            network.lss.send_switch_state_global(network.lss.WAITING_STATE)
            _transfer(network, source)
        time.sleep(0.2)  # the last frames reach the log
        notifier.stop()
    # As `candump -L` does: tshark opens that, and not what python-can itself writes.
    write_log(log, frame_array(map(raw_frame, recorded)))
    return len(recorded)


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
    for fault in (*[0] * 20, 3, 0):  # 3 is a saturated gauge: EMCY
        source.fault = fault
        network.sync.transmit()
        time.sleep(0.05)
    node.nmt.state = "STOPPED"
    node.nmt.state = "RESET"
    time.sleep(0.3)


def dissected(log: Path, wanted: str, *fields: str) -> list[str]:
    """Lines of the frames that Wireshark's filter ``wanted`` chooses."""
    chosen = [word for field in fields for word in ("-e", field)]
    command = ["tshark", "-r", str(log), "-d", "can.subdissector,canopen", "-Y", wanted]
    command += ["-T", "fields", *chosen] if fields else []
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


def main() -> int:
    """Run the session; 1 where the dissector has a complaint, 2 without tshark."""
    arguments(__doc__).parse_args()
    if shutil.which("tshark") is None:
        print("tshark is missing: apt-get install -y --no-install-recommends tshark", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "session.log"
        frames = session(log)
        known = len(dissected(log, "canopen"))
        bad = dissected(log, COMPLAINTS, "frame.number", "_ws.expert.message", "_ws.col.Info")
    print(f"{frames} frames, {known} dissected as CANopen, {len(bad)} with a complaint")
    for line in bad[:10]:
        print(f"  {line}")
    return 1 if bad or known < frames else 0


if __name__ == "__main__":
    sys.exit(main())
