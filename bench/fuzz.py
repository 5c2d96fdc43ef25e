"""Throw random and mutated frames at fingertip nodes and check invariants after each step.

    python -m bench.fuzz                          200 000 frames
    python -m bench.fuzz --frames 10_000_000      the long run
    python -m bench.fuzz --seed 1 --only 17       round 17 of seed 1 once more
    python -m bench.fuzz --eds 500_000            steps of devices of EDS files: a fingertip's and a drive's

A round is one node from power-on through some thousand frames; it follows from the seed and its number alone. When
an invariant breaks, the frames of that round are reduced to the few that break it and printed."""

import multiprocessing
import os
import struct
import sys
import time
import traceback
import tracemalloc
from pathlib import Path
from random import Random

from bench.fuzz_frames import Frame, Frames, Step, good_record
from bench.measure import ROOT, arguments, machine

from canopen_device.core import codes, emcy, storage
from canopen_device.core.node import Device
from canopen_device.core.sdo_block import MAX_BLOCK
from canopen_device.core.sdo_server import MAX_DOWNLOAD_BYTES
from canopen_device.eds.reader import read_eds
from canopen_device.machine import SimulatedDevice, shipped_eds
from canopen_device.machine.cia402 import Drive
from canopen_device.testing import MemoryStore
from tipforce.fingertip.node import Fingertip, fingertip_node
from tipforce.sources.simulated import SimulatedSource

ROUND_FRAMES = 2500
MEMORY_ROUNDS = 40  # one round of so many runs under tracemalloc, which makes it several times slower
MEMORY_LIMIT_BYTES = 400_000  # what the node's own code may hold at the end of a round: dictionary, routes, buffers
TPDOS = 4
STATES = (codes.INITIALISING, codes.STOPPED, codes.OPERATIONAL, codes.PRE_OPERATIONAL)
STRAIN_PER_NEWTON = ((8e-5, 1e-5, -2e-5), (-1e-5, 9e-5, 3e-5), (2e-5, -3e-5, 7e-5))
MOST_BUFFERED = max(MAX_DOWNLOAD_BYTES, 5000) + 7
COMMIT_ANSWERED = struct.pack("<BHB4x", 0x60, 0x2104, 0)


class BrokenError(Exception):
    """An invariant that does not hold."""


def require(holds: object, what: str) -> None:
    """Raise BrokenError unless the condition holds."""
    if not holds:
        raise BrokenError(what)


class Rig:
    """A device of one round, stepped as itself or by its simulation. What it raises passes through."""

    most_per_step = most_per_frame = 300  # sent: an SDO block of 127, and PDOs

    def __init__(self, device: Device, simulated: SimulatedDevice | None = None, now_us: int = 0) -> None:
        self.device = device
        self._stepped = simulated or device
        self.now_us = self.due_us = now_us
        self.sdo_answers = 0  # in the last step

    def step(self, step: Step) -> list[Frame]:
        """Let time pass, hand the frames over, and check what is sent, which is returned."""
        pause_us, frames = step
        self.now_us += pause_us
        self.device.requests.clear()
        sent, self.due_us = self._stepped.step(self.now_us, frames)
        require(self.due_us >= self.now_us, f"due {self.due_us} before now {self.now_us}")
        most = self.most_per_step + self.most_per_frame * len(frames)
        require(len(sent) <= most, f"{len(sent)} frames sent at once")
        for can_id, data in sent:
            require(type(can_id) is int and 0 <= can_id <= 0x7FF, f"identifier {can_id!r}")
            require(type(data) is bytes and len(data) <= 8, f"data {data!r}")
        if sent:
            self.sdo_answers = sum(can_id == 0x580 + self.device.node_id for can_id, _ in sent)
        return sent


class FingertipRig(Rig):
    """One node of a round, its store, and the invariants. ``number`` and ``seed`` determine how it starts."""

    most_per_step = (
        TPDOS + 3
    )  # time alone: each TPDO's event, one heartbeat, one EMCY, one SDO abort or acknowledgement
    most_per_frame = MAX_BLOCK + TPDOS  # an SDO block, or every TPDO on a SYNC, or a boot-up message and an LSS answer

    def __init__(self, seed: int, number: int) -> None:
        rng = Random(f"{seed} {number} start")
        now_us = int(rng.random() ** 4 * 1e15)
        self._stored: dict[str, bytes] = {}
        self._store_fails = rng.random() < 0.1
        node_id = (5, 1, 127, codes.LSS_UNCONFIGURED)[int(rng.random() * 4)]
        eds = bytes(k * 7 & 0xFF for k in range(5000)) if rng.random() < 0.8 else b""
        stores = rng.random() < 0.9
        source = SimulatedSource(STRAIN_PER_NEWTON, 0.1 if rng.random() < 0.5 else 0.0, seed=number)
        device = fingertip_node(
            node_id, source, 3, number, self._save if stores else None, self._stored.get if stores else None, eds
        )
        super().__init__(device, now_us=now_us)
        assert isinstance(device.application, Fingertip)
        self.application = device.application
        self._values = len(device.od.values)
        if rng.random() < 0.5:
            self._stored["calibration"] = storage.with_crc(struct.pack("<fI", 1e4, 1) + good_record(rng))
        self._active = self.application.calibration.active_record()
        self.step((0, ()), fresh=True)

    def _save(self, group: str, data: bytes) -> bool:
        if not self._store_fails:
            self._stored[group] = bytes(data)
        return not self._store_fails

    def step(self, step: Step, fresh: bool = False) -> list[Frame]:
        """The same, and check everything."""
        _, frames = step
        device = self.device
        node_id, state = device.node_id, device.nmt.state
        lengths, emcy_id = self._tpdo_lengths(), device.od.integer(0x1014) & 0x7FF
        transfer = device.sdo._index if device.sdo.due_us != codes.NEVER_US else 0
        sent = super().step(step)
        require(device.nmt.state in STATES, f"NMT state {device.nmt.state}")
        node_ids = {node_id, device.node_id}
        if sent:
            lengths |= self._tpdo_lengths()
            own = {codes.LSS_RESPONSE_COB_ID, emcy_id, device.od.integer(0x1014) & 0x7FF}
            own |= {base + number for base in (0x580, 0x700) for number in node_ids}
            # Of several frames one may configure a PDO that the next one triggers and the last one takes away.
            for can_id, data in sent if len(frames) < 2 else ():
                ours = can_id in own or (can_id, len(data)) in lengths
                require(ours, f"{can_id:03X}h with {len(data)} bytes is no TPDO of this node")
            if state == device.nmt.state == codes.STOPPED and len(frames) < 2:
                allowed = (0x700 + node_id, codes.LSS_RESPONSE_COB_ID)
                require(all(can_id in allowed for can_id, _ in sent), "only heartbeat and LSS speak in STOPPED")
        answers = [data for can_id, data in sent if can_id - 0x580 in node_ids]
        self._check_calibration(answers, frames, transfer, fresh)
        self._check_sizes(frames)
        return sent

    def _tpdo_lengths(self) -> set[tuple[int, int]]:
        return {(pdo.can_id, pdo.length) for pdo in self.device.tpdos._pdos if pdo.active}

    def _check_calibration(self, answers: list[bytes], frames: tuple[Frame, ...], transfer: int, fresh: bool) -> None:
        """The active record changes by an acknowledged commit, to what is staged, or by a reset, to what is stored."""
        calibration = self.application.calibration
        active = calibration.active_record()
        # 60h also answers the initiate of a segmented download: only an expedited one (bit 1) is done with it.
        expedited = any(data[:1] and data[0] & 0xE2 == 0x22 for _, data in frames)
        committed = (expedited and COMMIT_ANSWERED in answers) or (
            transfer == 0x2104 and any(data[0] in (0x20, 0x30, 0xA1) for data in answers)
        )
        reset = fresh or any(what == "reset-node" for what, _, _ in self.device.requests)
        if committed and len(frames) == 1:  # of several frames a later one may have staged another
            require(active == calibration.staged_record(), "a commit was acknowledged, the active record is another")
            require(calibration.active is not None, "a commit was acknowledged, but the node is uncalibrated")
        elif reset and len(frames) < 2:
            stored = self._stored.get("calibration", b"")[12:]
            kept = self.device.storage.available and stored
            require(active == (stored if kept else bytes(len(active))), "after a reset: not the stored record")
        elif not committed and not reset:
            require(active == self._active, "the active record changed without a commit")
        self._active = active

    def _check_sizes(self, frames: tuple[Frame, ...]) -> None:
        device, interrupts = self.device, self.application.interrupts
        require(not device._outbox, "frames are left in the outbox")
        require(len(device.od.values) == self._values, "the dictionary grew")
        consumer, block = device.heartbeat_consumer, device.sdo._block
        for what, size, most in (
            ("requests", len(device.requests), 2 + len(frames)),
            ("EMCY messages", len(device.emcy._waiting), emcy.MAX_WAITING),
            ("errors of the history", len(device.emcy._history), emcy.HISTORY_LENGTH),
            ("active errors", len(device.emcy._active), 64),
            ("routes", len(device._routes), 32),
            ("names of damaged groups", len(device.storage.damaged), 5),
            ("bytes of an SDO buffer", len(getattr(block, "_buffer", device.sdo._buffer)), MOST_BUFFERED),
            ("watched nodes", max(map(len, (consumer._periods, consumer._deadlines, consumer._lost))), 4),
            ("interrupts", 0 if interrupts is None else max(len(interrupts._sent), len(interrupts._zones)), 9),
        ):
            require(size <= most, f"{size} {what}, allowed are {most}")


def play(seed: int, number: int, frames: int, history: list[Step]) -> int:
    """One round: frames thrown. ``history`` receives the steps as they are made."""
    rig = FingertipRig(seed, number)
    source, thrown = Frames(Random(f"{seed} {number} frames"), rig), 0
    while thrown < frames:
        step = source.next()
        history.append(step)
        rig.step(step)
        thrown += len(step[1])
    return thrown


def play_measured(seed: int, number: int, frames: int, history: list[Step]) -> int:
    """The same with an eye on the memory that the node's own code holds."""
    tracemalloc.start()
    try:
        thrown = play(seed, number, frames, history)
        code = [tracemalloc.Filter(True, f"*/{name}/*") for name in ("canopen_device", "tipforce")]
        held = sum(trace.size for trace in tracemalloc.take_snapshot().filter_traces(code).traces)
        require(held <= MEMORY_LIMIT_BYTES, f"the node holds {held} bytes")
        return thrown
    finally:
        tracemalloc.stop()


def breaks(seed: int, number: int, steps: list[Step]) -> str:
    """What goes wrong when a node of that round is handed these steps; empty if nothing does."""
    try:
        rig = FingertipRig(seed, number)
        for step in steps:
            rig.step(step)
    except BrokenError as error:
        return str(error)
    except Exception:
        return traceback.format_exc(limit=-3)
    return ""


def minimised(seed: int, number: int, steps: list[Step]) -> list[Step]:
    """As few steps as still break an invariant: drop halves, quarters, ... single steps while it stays broken."""
    size = max(1, len(steps) // 2)
    while True:
        at, shorter = 0, False
        while at < len(steps):
            without = steps[:at] + steps[at + size :]
            # The time of what is left out passes all the same, or else nothing that waits for time would fail.
            lost_us = sum(pause_us for pause_us, _ in steps[at : at + size])
            if at < len(without):
                without[at] = (without[at][0] + lost_us, without[at][1])
            if breaks(seed, number, without):
                steps, shorter = without, True
            else:
                at += size
        if size == 1 and not shorter:
            return steps
        size = max(1, size // 2)


def report(seed: int, number: int, history: list[Step]) -> str:
    """The failure of a round as text: the seed, the reason, the shortest list of frames."""
    if not breaks(seed, number, history):
        return f"seed {seed}, round {number}: memory; repeat with --seed {seed} --only {number}"
    steps = minimised(seed, number, history)
    lines = [f"seed {seed}, round {number}: {breaks(seed, number, steps)}", "repeat with these steps:"]
    for pause_us, frames in steps:
        lines.append(f"  + {pause_us}  " + " ".join(f"{can_id:03X}#{data.hex().upper()}" for can_id, data in frames))
    return "\n".join(lines)


def rounds(seed: int, numbers: range, frames: int = ROUND_FRAMES, measure: bool = True) -> tuple[int, str]:
    """Play rounds until one fails: (frames thrown, the report of the failure)."""
    thrown = 0
    for number in numbers:
        history: list[Step] = []
        player = play_measured if measure and number % MEMORY_ROUNDS == 0 else play
        try:
            thrown += player(seed, number, frames, history)
        except Exception:
            return thrown, report(seed, number, history)
    return thrown, ""


def fuzz_file(path: Path, steps: int, seed: int) -> int:
    """Throw so many steps of frames at the device of a file; return how many it sent. Raises BrokenError."""
    sent_frames = 0
    for number in range(0, steps, ROUND_FRAMES):
        eds, store = read_eds(path, 5), MemoryStore()
        drive = Drive() if 0x6040 in eds.objects and 0x6060 in eds.objects else None
        simulated = SimulatedDevice(eds, drive, None, store.save, store.load)
        rig = Rig(simulated.core, simulated)
        frames = Frames(Random(f"{seed} {path.name} {number}"), rig)
        try:
            rig.step((0, ()))
            sent_frames += sum(len(rig.step(frames.next())) for _ in range(min(ROUND_FRAMES, steps - number)))
        except BrokenError as error:
            raise BrokenError(f"{path.name}, round {number}: {error}") from None
    return sent_frames


def main() -> int:
    parser = arguments(__doc__)
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="play this round alone")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--eds", type=int, metavar="STEPS", help="of the devices of two EDS files instead")
    options = parser.parse_args()
    if options.eds:
        for file in (ROOT / "eds" / "tipforce-3.eds", shipped_eds("cia402")):
            print(f"{file.name}: {options.eds} steps, {fuzz_file(file, options.eds, 1)} frames sent, nothing raised")
        return 0
    count = -(-options.frames // ROUND_FRAMES)
    parts = [range(k, count, options.jobs) for k in range(options.jobs)]
    if options.only is not None:
        parts = [range(options.only, options.only + 1)]
    started_s = time.perf_counter()
    with multiprocessing.Pool(len(parts)) as pool:
        results = pool.starmap(rounds, [(options.seed, part) for part in parts])
    took_s = time.perf_counter() - started_s
    counts, reports = zip(*results, strict=True)
    thrown, failures = sum(counts), list(filter(None, reports))
    print(f"{machine()}; {len(parts)} processes, seed {options.seed}")
    print(f"{thrown} frames in {took_s:.1f} s: {thrown / took_s:.0f} frames/s, {len(failures)} failures")
    print("\n".join(failures))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
