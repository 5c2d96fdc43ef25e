"""A model of numbered rows: fingers that are late, frames that are lost, doubled or missed, and what a hand may show.

Each value is the serial number of the SYNC that it answers, so a value in another SYNC's row is seen at once. A value
that the host received within the waiting time must be in its row."""

from __future__ import annotations

import random
import struct
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from canopen_device.core.codes import SYNC_COB_ID
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.hand.rows import Collector

FINGERS = 3
LATEST = 119  # SYNCs: no answer is later
_CONTACT = 0x280
_PERIOD_NS = 1_000_000
_STRANGE = 30_000  # mN, and above: values of somebody else


@dataclass
class Sequence:
    """One run; every choice comes from ``seed``."""

    seed: int
    errors: list[str] = field(default_factory=list)
    shown: int = 0

    def __post_init__(self) -> None:
        self._random = pick = random.Random(self.seed)
        self._own = pick.random() < 0.7
        self._modulus = 240 if self._own or pick.random() < 0.7 else pick.choice((20, 100, 239))
        latest = min(LATEST, self._modulus // 2 - 1)
        self._wait = pick.randint(1, latest)
        self._latest = pick.choice((1, 3, self._wait, latest))
        self._rates = {name: pick.choice((0.0, 0.02, 0.2)) for name in ("busy", "lost", "doubled", "missed", "unheard")}
        self._restarts = 0.0 if self._own else pick.choice((0.0, 0.02, 0.05))
        self._strange = pick.choice((0.0, 0.0, 0.05))
        self._collector = Collector(range(1, FINGERS + 1), wait_s=(self._wait + 0.5) * 1e-3, own_sync=self._own)
        self._collector._numbers.modulus = self._modulus
        self._waiting: list[deque[tuple[int, bytes]]] = [deque() for _ in range(FINGERS)]  # answers not sent yet
        self._copies: list[tuple[int, int, bytes]] = []  # due at this serial: finger, data
        self._serial_of: dict[int, int] = {}  # by time of the SYNC
        self._opened: dict[int, int] = {}  # by serial: the time at which the host knew of it
        self._due: dict[tuple[int, int], int] = {}  # (serial, finger): the time at which the host received the value
        self._conflicts: set[tuple[int, int]] = set()
        self._promised = 10_000  # a value received until this serial is not lost
        self._timed = self._own  # the producer's period is known: two consecutive SYNCs were received
        self._unheard: list[int] = []
        self._rows: list[tuple[int | None, bool, list[float]]] = []

    def run(self, syncs: int = 150) -> Sequence:
        number = self._random.randint(1, self._modulus)
        for serial in range(1, syncs + 1):
            number = number % self._modulus + 1
            if self._random.random() < self._restarts and self._timed:
                number, self._promised = 1, min(self._promised, max(self._serial_of.values()))
            frames = self._frames(serial, number, quiet=serial > syncs - 3)
            cut = self._random.randint(0, len(frames)) if self._random.random() < 0.5 else len(frames)
            for part in (frames[:cut], frames[cut:]):
                self._host(part, serial)
        for later in range(self._wait + 2):
            self._host([], syncs + 1 + later)
        self._check()
        return self

    def _frames(self, serial: int, number: int, quiet: bool) -> list[tuple[int, int, bytes]]:
        chance = {name: 0.0 if quiet else rate for name, rate in self._rates.items()}
        pick, t_ns = self._random, serial * _PERIOD_NS
        frames = []
        if pick.random() >= chance["unheard"] or serial == 1:
            frames.append((t_ns, SYNC_COB_ID, bytes((number,))))
            self._serial_of[t_ns] = serial
            if not self._timed and self._unheard:
                self._promised = 0
            self._timed |= serial > 1 and not self._unheard
            for missed in (*self._unheard, serial):
                self._opened[missed] = serial
            self._unheard = []
        else:
            self._unheard.append(serial)
        for k in range(FINGERS):
            frames += self._answers(k, serial, number, chance, quiet)
        frames += [(t_ns, _CONTACT + 1 + k, data) for due, k, data in self._copies if due <= serial]
        self._copies = [copy for copy in self._copies if copy[0] > serial]
        return frames

    def _answers(
        self, k: int, serial: int, number: int, chance: dict[str, float], quiet: bool
    ) -> list[tuple[int, int, bytes]]:
        """What a finger sends after this SYNC: nothing while it is busy, else all that waits, in order."""
        pick, t_ns, waiting = self._random, serial * _PERIOD_NS, self._waiting[k]
        frames: list[tuple[int, int, bytes]] = []
        if pick.random() >= chance["missed"]:
            waiting.append((serial, struct.pack("<hhhBB", serial, 4500, 3000, 3, number)))
        if waiting and pick.random() < chance["busy"] and serial - waiting[0][0] < self._latest:
            return []
        while waiting:
            of, data = waiting.popleft()
            if pick.random() < chance["lost"]:
                continue
            frames.append((t_ns, _CONTACT + 1 + k, data))
            self._due[of, k] = serial
            if pick.random() < chance["doubled"]:
                self._copies.append((serial + pick.choice((0, 1, max(self._latest - serial + of, 0))), k, data))
            if pick.random() < self._strange and not quiet:
                other = struct.pack("<hhhBB", _STRANGE + of, 0, 0, 3, data[7])
                frames.insert(len(frames) - pick.randint(0, 1), (t_ns, _CONTACT + 1 + k, other))
                self._conflicts.add((of, k))
        return frames

    def _host(self, frames: list[tuple[int, int, bytes]], serial: int) -> None:
        rows = self._collector.add(frame_array(frames), serial * 1e-3)
        for at, t_ns, P in zip(range(len(rows)), rows.sync_ns.tolist(), rows.columns["P"].tolist(), strict=True):
            if rows.first + at != len(self._rows):
                self.errors.append(f"row {rows.first + at} at {len(self._rows)}")
            self._rows.append((self._serial_of.get(t_ns), bool(rows.numbered[at]), P))

    def _check(self) -> None:
        heard = [serial for serial, _, _ in self._rows if serial is not None]
        if heard != sorted(self._serial_of.values()):
            self.errors.append("the rows are not those of the SYNCs")
            return
        place = 0
        values: dict[tuple[int, int], int] = {}
        for serial, _, P in self._rows:
            place = serial if serial is not None else place + 1
            for k, value in enumerate(P):
                if np.isnan(value):
                    continue
                self.shown += 1
                shown = values[place, k] = round(value * 1000)
                # Of two values of one number the first may be shown, where its row was complete before the other came.
                if shown != place and not (shown == _STRANGE + place and (place, k) in self._conflicts):
                    self.errors.append(f"row of SYNC {place}: finger {k + 1} shows {shown}")
        for (of, k), received in self._due.items():
            clear = of not in self._unheard and (of, k) not in self._conflicts and of in self._opened
            # After a restart of the count its numbers may be those of late answers to the count before.
            clear = clear and received - self._opened[of] <= self._wait and received <= self._promised
            if clear and (of, k) not in values:
                self.errors.append(f"SYNC {of}: finger {k + 1} answered at {received}, and is missing")


def failures(sequences: int, first_seed: int = 0) -> list[str]:
    """Run sequences; return what was wrong, with the seed."""
    errors = []
    for seed in range(first_seed, first_seed + sequences):
        outcome = Sequence(seed).run()
        errors += [f"seed {seed}: {error}" for error in outcome.errors[:3]]
        if not outcome.shown and outcome._promised >= 10:
            errors.append(f"seed {seed}: no value was shown")
    return errors
