"""A hand for an hour of simulated time on a bus that loses, delays, repeats and swaps frames, with fingers that lose
power, converters that fail, ones that are too busy to answer in time, a babbler and an adapter that drops off; and a
check of every row against what was sent.

    python -m bench.soak --seconds 3600
"""

import gc
import math
import random
import struct
import time
from collections import Counter
from typing import Self

import numpy as np
from bench.measure import arguments, resident_bytes

from canopen_device.core import codes, communication
from canopen_device.core.codes import NMT_COB_ID, SYNC_COB_ID
from canopen_device.core.node import Device
from canopen_device.running.loop import MemoryStore
from tipforce.fingertip.node import fingertip_node
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.hand.events import Supervisor
from tipforce.host.hand.rows import Collector
from tipforce.host.network.faulty_bus import Babbler, Faults, Injector
from tipforce.samples.record import Rows
from tipforce.samples.sync_numbers import LARGEST
from tipforce.scene.delivered import beam_calibration, commit_calibration, download
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix
from tipforce.sources.simulated import SimulatedSource

FINGERS, SEED, NOISE_MICROSTRAIN = 5, 20261121, 0.5
PERIOD_S, PARTS = 0.01, 4  # a SYNC every 10 ms; between two of them the host looks four times
FAULTS = Faults(drop=0.003, duplicate=0.003, reorder=0.003, delay=0.01, delay_s=0.025)
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_S = 100, 0.25
WAIT_S = 5 * PERIOD_S
RECOVERY_S = 2.0  # after the last trouble every finger must be there again
_NMT_START, _PRE_OPERATIONAL = 1, 127
_CONTACT = 0x280


class Finger:
    """One node; power and converter can fail until a stated time."""

    def __init__(self, node_id: int, seed: int) -> None:
        self.node_id = node_id
        self.last_contact = b""
        self._seed, self._store = seed, MemoryStore()
        self.random = random.Random(seed)
        self.off_until_s = self.broken_until_s = -1.0
        self._booted_s = 0.0
        self._device = self._power()
        self._device.step(0)
        commit_calibration(self._device, beam_calibration(pull=True, noise_microstrain=NOISE_MICROSTRAIN))
        download(self._device, communication.PRODUCER_HEARTBEAT, 0, struct.pack("<H", HEARTBEAT_MS))
        download(self._device, communication.STORE_PARAMETERS, 1, struct.pack("<I", codes.SIGNATURE_SAVE))
        self._device = self._power()

    def _power(self) -> Device:
        self.source = SimulatedSource(strain_matrix(FABRICATED, "I").tolist(), NOISE_MICROSTRAIN, seed=self._seed)
        return fingertip_node(
            self.node_id, self.source, serial=self.node_id, save=self._store.save, load=self._store.load
        )

    def end_trouble(self, now_s: float) -> bool:
        """Power comes back, the converter works again; return whether something is still wrong."""
        if 0.0 <= self.off_until_s <= now_s:
            self.off_until_s, self._booted_s = -1.0, now_s
            self._device = self._power()
        if 0.0 <= self.broken_until_s <= now_s:
            self.broken_until_s = -1.0
            self.source.set_fault(0, 1, 0.0, 0)
        return max(self.off_until_s, self.broken_until_s) >= 0.0

    def step(self, now_s: float, frames: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
        """Give it frames and the time."""
        if self.off_until_s >= 0.0:
            return []
        if any(can_id == NMT_COB_ID for can_id, _ in frames):  # the hand numbers the SYNC before it starts a finger
            self._device.od.values[communication.SYNC_OVERFLOW << 8] = LARGEST
        P = 2.0 + 1.5 * math.sin(now_s + self.node_id)
        self.source.load = (P, 40.0 * math.sin(0.7 * now_s), 30.0)
        sent, _due_us = self._device.step(round((now_s - self._booted_s) * 1e6), frames)
        answers = [(can_id, bytes(data)) for can_id, data in sent]
        for can_id, data in answers:
            if can_id == _CONTACT + self.node_id:
                self.last_contact = data
        return answers


class Soak:
    """One run, all of it from ``seed``."""

    def __init__(self, fingers: int, seed: int) -> None:
        ids = range(1, fingers + 1)
        self.fingers = [Finger(n, seed + n) for n in ids]
        self.rows = self.checked = 0  # checked: values compared with what the finger sent for that very SYNC
        self.breaks: list[str] = []
        self.counts = Counter[str]()
        self.resident_bytes: list[int] = []  # after each tenth of the time
        self._random = random.Random(seed)
        self._to_host = Injector(FAULTS, seed + 1)
        # A node may miss a frame; it cannot get one later than the others do, on one and the same wire.
        self._to_node = {n: Injector(Faults(drop=FAULTS.drop / 10), seed + 100 + n) for n in ids}
        self._collector = Collector(ids, wait_s=WAIT_S, own_sync=True)
        self._supervisor = Supervisor(ids, HEARTBEAT_TIMEOUT_S)
        self._truth: dict[int, dict[int, bytes]] = {}  # by row, by node-id: the contact PDO that answered its SYNC
        self._starts: set[int] = set()
        self._babbler: Babbler | None = None
        self._bus_off_until_s = -1.0
        self._babble_until_s = -1.0
        self._busy: dict[int, float] = {}  # by node-id: the share of SYNCs at which it has no time
        self._busy_until_s, self._busy_gap_s = -1.0, 0.0
        self._trouble_s = 0.0
        self._row = 0

    def run(self, seconds: float) -> Self:
        """Simulate."""
        ticks = round(seconds / PERIOD_S)
        for tick in range(ticks):
            self._tick(tick * PERIOD_S)
            if (tick + 1) % max(ticks // 10, 1) == 0:
                gc.collect()
                self.resident_bytes.append(resident_bytes())
        self.rows = self._collector.tally.rows
        for name in ("missing", "delayed", "late", "mixed", "repeated", "doubtful"):
            self.counts[name] = int(getattr(self._collector.tally, name).sum())
        self.counts.update({f"frames: {name}": n for name, n in self._to_host.counts.items()})
        return self

    def _tick(self, now_s: float) -> None:
        self._trouble(now_s)
        off = now_s < self._bus_off_until_s
        received: list[tuple[float, int, bytes]] = []
        if not off:
            received.append((now_s, SYNC_COB_ID, bytes((self._row % LARGEST + 1,))))
            self._truth[self._row] = {}
            self._truth.pop(self._row - 50, None)
        for finger in self.fingers:
            self._step_finger(finger, now_s, off)
        if not off:
            self._row += 1
        for part in range(PARTS):
            until_s = now_s + (part + 1) * PERIOD_S / PARTS
            while (frame := self._to_host.take(until_s)) is not None:
                if not off:
                    received.append((until_s, *frame))
            self._host(received, until_s)
            received = []

    def _step_finger(self, finger: Finger, now_s: float, off: bool) -> None:
        injector = self._to_node[finger.node_id]
        if not off:
            injector.put((SYNC_COB_ID, struct.pack("<I", self._row)), now_s)
            if finger.node_id in self._starts:
                injector.put((0, bytes((_NMT_START, finger.node_id))), now_s)
                self._starts.discard(finger.node_id)
        if now_s < self._busy_until_s and self._random.random() < self._busy.get(finger.node_id, 0.0):
            return  # what it received waits; it answers all of it when it has time
        late_s = now_s
        while (frame := injector.take(now_s)) is not None:
            can_id, data = frame
            answered = struct.unpack("<I", data)[0] if can_id == SYNC_COB_ID else -1
            given = (can_id, bytes((answered % LARGEST + 1,)) if answered >= 0 else data)
            self._send(finger, finger.step(late_s, [given]), now_s, off, answered)
            late_s += self._busy_gap_s
        self._send(finger, finger.step(late_s, []), now_s, off, -1)

    def _send(self, finger: Finger, frames: list[tuple[int, bytes]], now_s: float, off: bool, answered: int) -> None:
        for can_id, data in frames:
            if can_id == _CONTACT + finger.node_id and answered in self._truth:
                self._truth[answered][finger.node_id] = self._truth[answered].get(finger.node_id, b"") + data
            if not off:
                self._to_host.put((can_id, data), now_s)

    def _host(self, received: list[tuple[float, int, bytes]], now_s: float) -> None:
        if self._babbler is not None and now_s < self._babble_until_s:
            received += [(now_s, *frame) for frame in self._babbler.step(now_s)]
        frames = frame_array([(int(t_s * 1e9), can_id, data) for t_s, can_id, data in received])
        rows = self._collector.add(frames, now_s)
        if len(rows):
            self._check(rows, now_s)
        for event in self._supervisor.add(frames, now_s):
            self.counts[event.kind] += 1
            if event.kind == "heartbeat_lost":  # two that the bus lost are trouble, too
                self._trouble_s = now_s
        # As the Hand does: until it is seen to run, because the command may be lost, too.
        self._starts |= {n for n, state in self._supervisor.states.items() if state == _PRE_OPERATIONAL}

    def _check(self, rows: Rows, now_s: float) -> None:
        P = rows.columns["P"]
        for row in range(len(rows)):
            truth = self._truth.get(rows.first + row, {})
            for k, finger in enumerate(self.fingers):
                if rows.missing[row, k]:
                    continue
                self.checked += 1
                sent = truth.get(finger.node_id, b"")
                raw = -0x8000 if np.isnan(P[row, k]) else round(P[row, k] * 1000)
                answers = [sent[at : at + 8] for at in range(0, len(sent), 8)]
                if not any(struct.unpack_from("<h", a)[0] == raw and a[7] == rows.counter[row, k] for a in answers):
                    shown = f"{raw} mN, {rows.counter[row, k]}; sent {sent.hex()}"
                    self._break(rows.first + row, f"finger {finger.node_id} shows {shown}")
        if now_s - self._trouble_s > RECOVERY_S and any(s != 5 for s in self._supervisor.states.values()):
            self._break(rows.first, f"not operational again: {self._supervisor.states}")

    def _break(self, row: int, text: str) -> None:
        if len(self.breaks) < 100:
            self.breaks.append(f"row {row}: {text}")

    def _trouble(self, now_s: float) -> None:
        """Now and then something happens, and most of the time nothing."""
        troubled = [finger.end_trouble(now_s) for finger in self.fingers]
        if any(troubled) or now_s < max(self._bus_off_until_s, self._babble_until_s, self._busy_until_s):
            self._trouble_s = now_s
        if self._random.random() > PERIOD_S / 3.0 or now_s - self._trouble_s < 3.0:
            return
        kind = self._random.choice(("power", "power", "source", "source", "bus-off", "babbler", "busy", "busy"))
        self.counts[f"trouble: {kind}"] += 1
        length_s = self._random.uniform(0.2, 3.0)
        finger = self._random.choice(self.fingers)
        if kind == "power":
            finger.off_until_s = now_s + length_s
        elif kind == "busy":
            self._busy = {other.node_id: self._random.uniform(0.3, 0.95) for other in (finger, self.fingers[0])}
            self._busy_until_s = now_s + length_s
            self._busy_gap_s = self._random.choice((0.0, 1e-4))  # 0: all that waited gets one and the same sample
        elif kind == "source":
            finger.broken_until_s = now_s + length_s
            finger.source.set_fault(self._random.randint(1, 5), 1 + finger.random.randrange(3), 50.0, 0)
        elif kind == "bus-off":
            self._bus_off_until_s = now_s + length_s
        else:
            self._babble_until_s = now_s + length_s
            frame = (_CONTACT + finger.node_id, finger.last_contact) if finger.last_contact else (0x050, bytes(8))
            self._babbler = Babbler(frame, 2000.0)
            self._babbler.next_due_s = now_s


def main() -> int:
    parser = arguments(__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0, help="simulated (default %(default)g)")
    args = parser.parse_args()
    started_s = time.monotonic()
    outcome = Soak(FINGERS, SEED).run(args.seconds)
    elapsed_s = time.monotonic() - started_s
    print(f"{args.seconds:g} s simulated in {elapsed_s:.0f} s, {outcome.rows} rows, {outcome.checked} values checked")
    for name, count in sorted(outcome.counts.items()):
        print(f"  {name:24} {count}")
    print("memory, MB, after each tenth:", *(f"{n / 1e6:.1f}" for n in outcome.resident_bytes))
    print(f"{len(outcome.breaks)} invariant breaks")
    print("\n".join(outcome.breaks[:20]))
    resident = outcome.resident_bytes
    grown_bytes = resident[-1] - resident[len(resident) // 2]  # in the first half caches fill
    return 1 if outcome.breaks or grown_bytes > 2e6 else 0


if __name__ == "__main__":
    raise SystemExit(main())
