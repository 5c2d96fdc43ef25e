"""The compiled core makes the rows that the loop in Python makes; contacts of rows are those of the columns."""

import random
import struct
from array import array
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest

from tipforce.core import core
from tipforce.host.frames.frame_array import frame_array
from tipforce.host.hand.rows import Collector, rows_one_by_one
from tipforce.host.hand.trust import COUNTER
from tipforce.samples.record import RowContacts, Rows
from tipforce.scene import beam_calibration

needs_core = pytest.mark.skipif(core is None, reason="needs the compiled core")
BASES = {"Contact": 0x280, "Gauges": 0x180, "Force": 0x380}
Frame = tuple[int, int, bytes]


class InPython(Collector):
    def _enter(self) -> bool:
        return False


class Bus:
    """SYNCs and answers; ``trouble`` is the share of what is lost, late, doubled, strange, short, stale or foreign."""

    def __init__(self, pick: random.Random) -> None:
        self.pick, self.trouble = pick, pick.choice((0.0, 0.001, 0.01, 0.1))
        self.fingers = pick.choice((1, 3, 5))
        self.messages = pick.choice((("Contact",), ("Contact",), ("Contact", "Gauges"), ("Force", "Gauges", "Contact")))
        self.number, self.t_ns, self.late = pick.randint(1, 240), 10**9, list[Frame]()

    def happens(self) -> bool:
        return self.pick.random() < self.trouble

    def frames(self) -> list[Frame]:
        pick, late, self.late = self.pick, self.late, []
        self.number = self.number % 240 + 1
        self.t_ns += 1_000_000 + pick.randrange(-900, 900)
        if self.happens():
            self.number = pick.choice((1, pick.randint(1, 255), (self.number + 2) % 240 + 1))
            self.t_ns += pick.choice((-5_000_000, 0, 3_000_000))
        sync = bytes((self.number,)) if not self.happens() else pick.choice((b"", b"\0", bytes((self.number, 0))))
        frames = [] if self.happens() else [(self.t_ns, 0x80, sync)]
        answers = list[Frame]()
        for name in self.messages:
            for k in range(1, self.fingers + 1):
                counter = self.number if not self.happens() else pick.randrange(256)
                force = pick.choice((32767, *[pick.randint(-999, 999)] * 3))
                status = pick.choice((3, 3, 0x83, 0x61)) | 8 * self.happens()
                data = struct.pack("<hhhBB", force, 4500, -0x8000, status, counter)
                data = data[: 8 if not self.happens() else pick.randrange(8)]
                copies = [(self.t_ns + 1000 * k, BASES[name] + k, data)] * (1 - self.happens() + self.happens())
                (self.late if self.happens() else answers).extend(copies)
        if pick.random() < 0.3:
            pick.shuffle(answers)
        frames += answers
        if pick.random() < 0.1:
            health = 0x480 + pick.randint(1, self.fingers)
            other = pick.choice((0x701, 0x333, 0x80000281, 0x40000281, 0x081, *[health] * 5))
            data = pick.choice((b"\5", b"\0", struct.pack("<hHHBB", 2300, 1, 0, pick.choice((0,) * 9 + (1,)), 0)))
            frames.insert(pick.randint(0, len(frames)), (self.t_ns, other, data))
        return late + frames if pick.random() < 0.5 else frames + late


def content(rows: Rows) -> Any:
    raw = [(t_ns, number, [*words], [*reasons]) for t_ns, number, words, reasons, _ in rows.raw]
    return rows.first, raw, rows.counter.tolist(), {name: column.tobytes() for name, column in rows.columns.items()}


def tally(collector: Collector) -> Any:
    return [value.tolist() if isinstance(value, np.ndarray) else value for value in astuple(collector.tally)]


@needs_core
@pytest.mark.parametrize("part", range(16))
def test_both_bodies_make_the_same_rows_in_any_calls(part: int) -> None:
    closed = of_core = 0
    for seed in range(20 * part, 20 * part + 20):
        pick = random.Random(seed)
        bus, own = Bus(pick), pick.random() < 0.9
        options: Any = range(1, bus.fingers + 1), bus.messages, 3, pick.choice((0.002, 0.02, 0.5)), own
        bodies = Collector(*options), InPython(*options)
        waiting, now_s, known = list[Frame](), 0.0, pick.choice(({}, {}, {COUNTER: 0}))
        for _ in range(150):
            waiting += bus.frames()
            while len(waiting) > pick.choice((0, 0, 4, 40)):
                count = pick.choice((1, 2, 3, 6, len(waiting)))
                now_s += pick.choice((0.0, 0.0005, 0.001))
                call, waiting = frame_array(waiting[:count]), waiting[count:]
                ours, theirs = (body.add(call, now_s) for body in bodies)
                assert content(ours) == content(theirs), seed
                closed += len(ours)
                of_core += sum(type(words) is tuple for _, _, words, *_ in ours.raw)
            for body in bodies if pick.random() < 0.01 else ():
                body.restart()
            if pick.random() < 0.01:
                node_id, present = pick.randint(1, bus.fingers), pick.random() < 0.8
                for body in bodies:
                    body.expect(node_id, present)
            if pick.random() < 0.03:
                node_id, hides = pick.randint(1, bus.fingers), pick.random() < 0.2
                for body in bodies:
                    body.trust.hide(node_id) if hides else body.trust.learn(node_id, known)
        assert tally(bodies[0]) == tally(bodies[1]), seed
        assert bodies[0].shown == bodies[1].shown
    assert closed > 1400
    assert of_core > 300


@needs_core
def test_the_core_refuses_what_does_not_fit() -> None:
    """A state, an index or a modulus that no assembler has."""
    whole: list[Any] = []
    body = Collector((1, 2), own_sync=True)
    fixed: list[Any] = [body._steady, 240, [True], None, (), ()]
    body._steady[3] = 240
    assert core.rows(b"", 0.0, whole, tuple(fixed)) == 0
    for memory in (body._steady[:-1], body._steady[:5], array("q")):
        with pytest.raises(ValueError, match="rows: arguments"):
            core.rows(b"", 0.0, whole, (memory, *fixed[1:]))
    wrong = (tuple(fixed[:-1]), (*fixed[:2], (True,), *fixed[3:]), fixed)
    for arguments in ((whole,), ((), tuple(fixed)), *((whole, of_core) for of_core in wrong)):
        with pytest.raises(TypeError, match="rows: arguments"):
            core.rows(b"", 0.0, *arguments)
    with pytest.raises(TypeError):
        core.rows(b"", "now", whole, tuple(fixed))
    body._steady[3] = 1
    with pytest.raises(ValueError, match="rows: arguments"):
        core.rows(b"", 0.0, whole, tuple(fixed))
    body._steady[3] = 240
    body._steady[-512:] = array("q", b"\7\0" * 2048)
    with pytest.raises(ValueError, match="rows: index"):
        core.rows(frame_array([(0, 0x281, bytes(8))]).tobytes(), 0.0, whole, tuple(fixed))


@pytest.mark.parametrize("seed", range(12))
def test_contacts_of_a_row_are_those_of_its_columns(seed: int) -> None:
    """Field by field, to the last bit; missing ones too."""
    pick = random.Random(seed)
    bus = Bus(pick)
    node_ids = range(1, bus.fingers + 1)
    body, calibration = Collector(node_ids, bus.messages, own_sync=True), beam_calibration(noise_microstrain=0.5)
    calibrations = [pick.choice((calibration, None)) for _ in node_ids]
    names = ["", "thumb", "index", "ring", "little"][: bus.fingers]
    contacts, named = (
        RowContacts(node_ids, names, calibrations),
        dict(zip(node_ids, ["finger 1", *names[1:]], strict=True)),
    )
    frames = [frame for _ in range(40) for frame in bus.frames()]
    for at in range(0, len(frames), 50):
        rows = body.add(frame_array(frames[at : at + 50]), at * 1e-3)
        expected = list(rows.samples(calibrations).contacts(named))
        made = [contact for row in rows_one_by_one(rows, contacts) for contact in row.contacts]
        assert [repr(contact) for contact in made] == [repr(contact) for contact in expected]
        for row in rows_one_by_one(rows, contacts):
            assert [contact.name for contact in row.contacts] == list(row) == list(named.values())
            assert all(row[n] is row[name] for n, name in named.items())
    with pytest.raises(AttributeError, match="no 'force'"):
        _ = made[0].force
