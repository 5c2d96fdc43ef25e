"""Frames of a hand with late, lost, doubled and strange answers, by seed: those of bench.row_model, and more PDOs."""

from __future__ import annotations

import random
import struct
from collections import deque
from typing import Any

FINGERS = 3
LATEST = 119
PERIOD_NS = 1_000_000
BASES = {"Contact": 0x280, "Gauges": 0x180, "Force": 0x380}
Frames = list[tuple[int, int, bytes]]


def calls(seed: int, syncs: int = 150) -> tuple[dict[str, Any], list[tuple[Frames, float]]]:
    """(options of the collector, the calls: frames and the time in seconds)."""
    sequence = _Sequence(seed)
    found = []
    for serial in range(1, syncs + 1):
        frames = sequence.frames(serial, serial > syncs - 3)
        cut = sequence.pick.randint(0, len(frames)) if sequence.pick.random() < 0.5 else len(frames)
        found += [(frames[:cut], serial * 1e-3), (frames[cut:], serial * 1e-3)]
    wait = sequence.wait
    found += [([], (syncs + 1 + later) * 1e-3) for later in range(wait + 2)]
    options = {
        "fingers": FINGERS, "wait_s": (wait + 0.5) * 1e-3, "own_sync": sequence.own, "modulus": sequence.modulus,
        "messages": sequence.messages,
    }  # fmt: skip
    return options, found


class _Sequence:
    def __init__(self, seed: int) -> None:
        self.pick = pick = random.Random(seed)
        self.own = pick.random() < 0.7
        self.modulus = 240 if self.own or pick.random() < 0.7 else pick.choice((20, 100, 239))
        latest = min(LATEST, self.modulus // 2 - 1)
        self.wait = pick.randint(1, latest)
        self.latest = pick.choice((1, 3, self.wait, latest))
        self.rates = {name: pick.choice((0.0, 0.02, 0.2)) for name in ("busy", "lost", "doubled", "missed", "unheard")}
        self.restarts = 0.0 if self.own else pick.choice((0.0, 0.02, 0.05))
        self.strange = pick.choice((0.0, 0.0, 0.05))
        more = random.Random(-seed - 1)
        self.unnumbered = more.random() < 0.25
        self.messages = more.choice((("Contact",), ("Contact",), ("Contact", "Gauges"), ("Contact", "Gauges", "Force")))
        self.number = pick.randint(1, self.modulus)
        self.waiting: list[deque[tuple[int, list[bytes]]]] = [deque() for _ in range(FINGERS)]
        self.copies: list[tuple[int, int, bytes]] = []

    def frames(self, serial: int, quiet: bool) -> Frames:
        """The frames from one SYNC to the next."""
        pick, t_ns = self.pick, serial * PERIOD_NS
        chance = {name: 0.0 if quiet else rate for name, rate in self.rates.items()}
        self.number = self.number % self.modulus + 1
        if pick.random() < self.restarts:
            self.number = 1
        found: Frames = []
        if pick.random() >= chance["unheard"] or serial == 1:
            found.append((t_ns, 0x80, b"" if self.unnumbered else bytes((self.number,))))
        for k in range(FINGERS):
            found += self._answers(k, serial, chance, quiet)
        for due, can_id, data in [copy for copy in self.copies if copy[0] <= serial]:
            found.append((t_ns, can_id, data))
            self.copies.remove((due, can_id, data))
        if pick.random() < 0.01:
            found.append((t_ns, 0x701 + pick.randrange(FINGERS), pick.choice((b"\x05", b"\x00"))))
        return found

    def _answers(self, k: int, serial: int, chance: dict[str, float], quiet: bool) -> Frames:
        """What a finger sends: nothing while it is busy, else all that waits, in order."""
        pick, t_ns, waiting = self.pick, serial * PERIOD_NS, self.waiting[k]
        found: Frames = []
        if pick.random() >= chance["missed"]:
            counter = serial % 256 if self.unnumbered else self.number
            status = 3 | (8 if pick.random() < 0.02 else 0)
            waiting.append(
                (serial, [struct.pack("<hhhBB", serial, 4500 + at, 3000, status, counter) for at in range(3)])
            )
        if waiting and pick.random() < chance["busy"] and serial - waiting[0][0] < self.latest:
            return []
        while waiting:
            of, data = waiting.popleft()
            for at, name in enumerate(self.messages):
                can_id = BASES[name] + 1 + k
                if pick.random() < chance["lost"]:
                    continue
                found.append((t_ns + 1000 * k, can_id, data[at]))
                if pick.random() < chance["doubled"]:
                    self.copies.append(
                        (serial + pick.choice((0, 1, max(self.latest - serial + of, 0))), can_id, data[at])
                    )
                if pick.random() < self.strange and not quiet:
                    other = struct.pack("<hhhBB", 30_000 + of, 0, 0, 3, data[at][7])
                    found.insert(len(found) - pick.randint(0, 1), (t_ns, can_id, other))
        return found


def steady(fingers: int, rows: int = 2000) -> tuple[int, Frames]:
    """(number of rows, frames): numbered SYNCs with the contact of each finger, for costs."""
    found: Frames = []
    for row in range(rows):
        number = row % 240 + 1
        found.append((row * PERIOD_NS, 0x80, bytes((number,))))
        for k in range(fingers):
            found.append(
                (row * PERIOD_NS + 1000 * k, 0x281 + k, struct.pack("<hhhBB", 1000 + row % 100, 4500, 3000, 3, number))
            )
    return rows, found
