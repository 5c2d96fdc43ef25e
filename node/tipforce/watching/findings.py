"""What stands between a bus and values of force: observations in, findings with their remedies out; no bus inside."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from canopen_device.core import codes
from canopen_device.core.emcy import COB_ID_COLLISION, SYNC_LENGTH
from tipforce.dictionary.service_texts import emcy_text
from tipforce.host.decoding.duplicates import DuplicateNodes, of_product
from tipforce.host.decoding.service_frames import find_duplicates
from tipforce.host.frames.frame_array import FrameArray
from tipforce.samples.reasons import NOT_CALIBRATED

if TYPE_CHECKING:
    from tipforce.host.hand.file import FingerPlan
    from tipforce.host.network.find import FoundNode
    from tipforce.host.network.interfaces import Link

SILENT_S = 1.2
"""A bus without a frame for so long is silent: nodes send a heartbeat each second."""
_NO_SYNC_S = 1.0
MISSING = "fingers"
"""Topic of the fingers of a hand file that do not respond."""
RATE = 1_000_000
"""The bit rate of nodes as delivered, bit/s."""
SEND_SYNC = "`tipforce monitor --sync 100` sends it, and `tipforce hand run`"
OWN_SYNC = "--sync 100 sends it"
"""The remedy where the command itself listens."""
_FLAGS = np.uint32(codes.EXTENDED_FLAG | codes.REMOTE_FLAG | codes.ERROR_FLAG)
_CONTACT = codes.TPDO_BASES[1]  # P, phi, theta, 2120h
_UNKNOWN, _STATUS, _CALIBRATED = b"\x00\x80\x00\x80\x00\x80", 6, 0x02

State = Literal["ok", "note", "fail"]
"""ok; note: works, with a remark; fail: the requested function will not work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """``next_step`` is a command or a sentence, "" if none is needed. As text: one line."""

    topic: str
    state: State
    finding: str
    next_step: str = ""

    def __str__(self) -> str:
        return f"{self.finding}: {self.next_step}" if self.next_step else self.finding


@dataclass(slots=True)
class Observed:
    """What was seen of one bus so far; what is not known is left out. Node-ids are the keys."""

    heard_s: float = 0.0
    """How long it was listened to."""
    frames: int = 0
    errors: int = 0
    """Error frames."""
    syncs: int = 0
    """Batches of frames with a SYNC."""
    states: dict[int, int] = field(default_factory=dict)
    """NMT states by the last heartbeats."""
    sampled: set[int] = field(default_factory=set)
    """Nodes that sent a PDO."""
    calibrated: dict[int, bool] = field(default_factory=dict)
    serials: dict[int, int] = field(default_factory=dict)
    faults: dict[int, str] = field(default_factory=dict)
    """2124h in words."""
    emergencies: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Code and error register of the last EMCY that was no reset."""
    products: dict[int, int] = field(default_factory=dict)
    duplicates: DuplicateNodes = field(default_factory=DuplicateNodes)
    link: Link | None = None
    """The interface, where the kernel describes it."""

    def take(self, frames: FrameArray) -> None:
        """Take frames, FRAME (n,), in the order of reception."""
        find_duplicates(self.duplicates, frames)
        self.count(frames)

    def count(self, frames: FrameArray) -> None:
        """Take frames that ``duplicates`` has had."""
        error = int(((frames["can_id"] & np.uint32(codes.ERROR_FLAG)) != 0).sum())
        self.errors += error
        self.frames += len(frames) - error
        plain = frames[(frames["can_id"] & _FLAGS) == 0]
        last = {can_id: row for row, can_id in enumerate(plain["can_id"].tolist())}
        self.syncs += codes.SYNC_COB_ID in last
        for can_id, row in last.items():
            node_id, base = can_id & codes.NODE_ID_MASK, can_id & codes.FUNCTION_MASK
            data = plain["data"][row].tobytes()[: int(plain["length"][row])]
            if base == codes.HEARTBEAT_BASE and len(data) == 1 and node_id:
                self.states[node_id] = data[0] & 0x7F
            elif base == codes.EMCY_BASE and len(data) == 8 and node_id:
                self.emergencies[node_id] = int.from_bytes(data[:2], "little"), data[2]
                if data[:2] == b"\0\0":
                    del self.emergencies[node_id]
            elif base in codes.TPDO_BASES and node_id:
                self.sampled.add(node_id)
                # Another device may send anything in TPDO2: only a sample without any value says "not calibrated".
                if base == _CONTACT and len(data) == 8 and (data[_STATUS] & _CALIBRATED or data[:_STATUS] == _UNKNOWN):
                    self.calibrated[node_id] = bool(data[_STATUS] & _CALIBRATED)

    def add_nodes(self, nodes: Iterable[FoundNode]) -> None:
        """Take what a scan returned."""
        for node in nodes:
            if node.product:
                self.serials[node.node_id], self.products[node.node_id] = node.serial, node.product
            if node.calibration == NOT_CALIBRATED or node.calibration.startswith("0x"):
                self.calibrated[node.node_id] = node.calibration != NOT_CALIBRATED
            if node.faults:
                self.faults[node.node_id] = node.faults


def findings(seen: Observed, sync: str = SEND_SYNC, wanted: Sequence[FingerPlan] = ()) -> list[Finding]:
    """Return what is missing on a bus, the most fundamental first; ``sync``: the remedy of a missing SYNC. ``wanted``:
    the fingers of a hand file, to compare serial numbers with."""
    return [*of_the_wire(seen), *_of_the_nodes(seen, sync), *_of_the_hand(wanted, seen)]


def of_the_wire(seen: Observed) -> Iterator[Finding]:
    """Yield what is wrong below the nodes: bit rate, errors, silence."""
    link, name = seen.link, "can0" if seen.link is None else seen.link.name
    if link is not None and link.state == "BUS-OFF":
        step = f"sudo ip link set {name} type can restart; restart-ms 100 restarts automatically"
        yield Finding("traffic", "fail", f"{name} is bus-off", step)
    elif not seen.frames and (seen.errors or (link is not None and link.disturbed)):
        counted = f"{seen.errors} error frames"
        if link is not None and not seen.errors:
            counted = f"{link.state.lower()}, errors sent {link.errors_sent}, received {link.errors_received}"
        at = f" ({link.bit_rate} bit/s here)" if link is not None and link.bit_rate else ""
        cause = f"another bit rate than that of the nodes{at}, or no node acknowledges: {counted}, and no other frame"
        step = f"`sudo ip link set {name} down && sudo ip link set {name} up type can bitrate {RATE}`"
        yield Finding("traffic", "fail", cause, f"-b {RATE}" if link is None else step)
    elif seen.errors:
        step = f"compare bit rates, wires, 120 ohm at both ends; `tipforce dump -e {name},#FFFFFFFF` shows them"
        yield Finding("traffic", "fail", f"{seen.errors} error frames beside {seen.frames} frames", step)
    elif not seen.frames and seen.heard_s >= SILENT_S:
        step = f"power the nodes; check CAN_H, CAN_L, 120 ohm at both ends, and the bit rate ({RATE} as delivered)"
        yield Finding("traffic", "note", f"nothing received for {seen.heard_s:.1f} s", step)


def _of_the_nodes(seen: Observed, sync: str) -> Iterator[Finding]:
    for _, duplicate in sorted(seen.duplicates.found.items()):
        cause, _, step = str(duplicate).partition(": ")
        yield Finding("nodes", "fail", cause, step)
    numbered = [node_id for node_id, (code, _) in seen.emergencies.items() if code == SYNC_LENGTH]
    if numbered:
        finding = f"{shown(numbered)}: the SYNC does not fit 1019h and is rejected (EMCY 8240h)"
        step = f"after a killed hand: `tipforce sdo write {min(numbered)} 0x1019 0 u8 0`, or reset the node"
        yield Finding("nodes", "fail", finding, step)
    idle = [node_id for node_id, state in seen.states.items() if state in (codes.PRE_OPERATIONAL, codes.STOPPED)]
    if idle:
        yield Finding("nodes", "note", f"{shown(idle)}: not started", f"tipforce nmt start {ids(idle)} --wait")
    waiting = [node_id for node_id, state in seen.states.items() if state == codes.OPERATIONAL]
    if waiting and not seen.syncs and not seen.sampled and seen.heard_s >= _NO_SYNC_S:
        yield Finding("nodes", "note", "no SYNC on this bus", sync)
    for node_id in sorted(node_id for node_id, known in seen.calibrated.items() if not known):
        yield not_calibrated(node_id)
    for node_id, words in sorted(seen.faults.items()):
        yield Finding("faults", "note", f"{shown([node_id])}: {words}", f"`tipforce sdo read {node_id} faults` (2124h)")
    for node_id, (code, register) in sorted(seen.emergencies.items()):
        said = code == SYNC_LENGTH or (code == COB_ID_COLLISION and node_id in seen.duplicates.found)
        if node_id not in seen.faults and not said:
            finding = f"{shown([node_id])}: EMCY {emcy_text(code, register)}"
            topic, step = "nodes" if code == COB_ID_COLLISION else "faults", f"`tipforce sdo dump {node_id}`"
            yield Finding(topic, "note", finding, step)


def not_calibrated(node_id: int) -> Finding:
    """Return the finding of a node without a calibration."""
    step = f"tipforce calibrate guide --node {node_id}, or apply CAL.toml"
    return Finding("nodes", "fail", f"{shown([node_id])}: not calibrated", step)


def _of_the_hand(wanted: Sequence[FingerPlan], seen: Observed) -> Iterator[Finding]:
    """Yield the fingers that do not respond, or with another serial number than the hand file states."""
    known = {*seen.serials, *seen.duplicates.found}
    if missing := ", ".join(plan.label for plan in wanted if plan.node_id not in known):
        step = "check power and cables; `tipforce lss scan` finds a node without a node-id"
        yield Finding(MISSING, "fail", f"no identity on the bus: {missing}", step)
    owners = {plan.serial: plan for plan in wanted if plan.serial}
    labels, commands = [], []
    for plan in wanted:
        serial = seen.serials.get(plan.node_id, plan.serial)
        if not plan.serial or serial == plan.serial:
            continue
        if serial not in owners:
            cause = f"{plan.label}: serial number {serial}, the hand file has {plan.serial}"
            yield Finding("hand", "fail", cause, f"write serial = {serial}, or connect the finger {plan.serial}")
            continue
        product = of_product(seen.products.get(plan.node_id, 0))
        labels.append(f"{plan.label} has {serial}")
        commands.append(f"`tipforce lss assign {owners[serial].node_id} --serial {serial}{product}`")
    if labels:
        steps = f"swap node_id in the hand file, or {', '.join(commands)}, then `tipforce nmt reset-comm all`"
        yield Finding("hand", "fail", f"swapped serial numbers: {', '.join(labels)}", steps)


def shown(node_ids: Iterable[int]) -> str:
    """Return `node 10 (0x0A)`, or `nodes 1-3,7`."""
    known = sorted(node_ids)
    return f"node {known[0]} (0x{known[0]:02X})" if len(known) == 1 else f"nodes {ids(known)}"


def ids(node_ids: Iterable[int]) -> str:
    """Return a set of node-ids as a command line takes it: `1-3,7`."""
    runs: list[list[int]] = []
    for node_id in sorted(node_ids):
        if runs and node_id == runs[-1][-1] + 1:
            runs[-1].append(node_id)
        else:
            runs.append([node_id])
    return ",".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)
