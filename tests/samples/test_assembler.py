"""The PDOs of a latch become one sample: by the rules of logs, however the stream is cut."""

import random
import struct
from pathlib import Path

import numpy as np
import pytest

from tipforce import read_log
from tipforce.dictionary import table
from tipforce.dictionary.signals import tpdo_messages
from tipforce.host import FRAME, frame_array
from tipforce.samples.assembler import Assembler
from tipforce.samples.reasons import Status
from tipforce.samples.record import JoinedSamples
from tools.decode.logs import write_frames

NODES = (1, 2)
PDOS = {m.cob_id_base + n: (n, m) for m in tpdo_messages(3) for n in NODES if m.cob_id_base}
Frames = list[tuple[int, int, bytes]]


def sequence(seed: int, latches: int = 60) -> Frames:
    """PDOs of two nodes: some are lost, doubled, out of order, or late by more than the longest gap."""
    pick, frames, t_ns = random.Random(seed), [], 0
    lost, doubled, swapped, paused = (pick.choice((0.0, 0.05, 0.3)) for _ in range(4))
    for latch in range(latches):
        t_ns += 300_000_000 if pick.random() < paused / 3 else 1_000_000
        here: Frames = []
        for base in (0x180, 0x280, 0x380):
            for node in NODES:
                data = struct.pack("<hhhBB", latch, 10 * latch + node, base, 3, latch // pick.choice((1, 1, 2)) % 256)
                here += [(t_ns, base + node, data)] * (pick.random() >= lost) * (1 + (pick.random() < doubled))
        if pick.random() < swapped:
            pick.shuffle(here)
        if pick.random() < 0.2:
            here.append((t_ns, 0x480 + pick.choice(NODES), struct.pack("<HHI", 0, 5, 0)))
        frames += here
        t_ns += 250_000_000 if pick.random() < paused / 3 else 0
    return frames


def cut(frames: Frames, seed: int) -> list[JoinedSamples]:
    pick, assembler, at, parts = random.Random(seed), Assembler(PDOS), 0, []
    while at < len(frames):
        count = pick.choice((1, 2, 7, 50))
        parts.append(assembler.feed(frame_array(frames[at : at + count])))
        at += count
    return [*parts, assembler.finish()]


def numbers(*columns: np.ndarray) -> list[tuple[float, ...]]:
    table = np.nan_to_num(np.column_stack([np.asarray(column, dtype=np.float64) for column in columns]), nan=-1e9)
    return sorted(tuple(row) for row in table.round(6).tolist())


@pytest.mark.parametrize("seed", range(12))
def test_samples_are_those_of_the_log(seed: int, tmp_path: Path) -> None:
    frames = sequence(seed)
    log = read_log(write_frames(tmp_path / "frames.log", frame_array(frames)))
    parts = cut(frames, seed)
    for node in NODES:
        found = []
        for part in parts:
            nothing = np.full(len(part), np.nan)
            values = [part.columns.get(name, nothing) for name in ("P", "SG1", "F1")]
            of_node = part.node == node
            found += numbers(*(column[of_node] for column in (part.t_ns * 1e-9, part.counter, *values)))
        of_log = log[node]
        counter = np.where(of_log.counter < 0, -1, of_log.counter % 256)
        P, SG1, F1 = of_log.P_newtons, of_log.microstrain[:, 0], of_log.F_newtons[:, 0]
        assert sorted(found) == numbers(of_log.t_s, counter, P, SG1, F1)


def test_a_sample_is_complete_with_the_pdos_that_are_needed() -> None:
    """At once; what it lacks is unknown, and a sample without a needed PDO is dropped."""
    assembler = Assembler(PDOS, ("Gauges", "Contact"))
    gauges, contact = (struct.pack("<hhhBB", 100, 200, 300, 3, counter) for counter in (7, 7))
    assert not len(assembler.feed(frame_array([(1, 0x181, gauges)])))
    sample = assembler.feed(frame_array([(2, 0x281, contact), (3, 0x381, contact), (4, 0x282, contact)]))
    assert (len(sample), sample.t_ns[0], sample.node[0], sample.counter[0]) == (1, 2, 1, 7)
    assert sample.gauges.tolist() == [[10.0, 20.0, 30.0]]
    assert "F1" not in sample.columns
    assert not len(assembler.finish())
    assert not len(assembler.feed(np.zeros(0, dtype=FRAME)))


def test_faults_are_held_until_they_end() -> None:
    """EMCY tells overload, which the contact PDO does not carry."""
    assembler, data = Assembler(PDOS, ("Contact",)), struct.pack("<hhhBB", 1, 2, 3, 3, 1)
    bit = table.FAULT_OVERLOAD
    emcy = [(k, 0x081, struct.pack("<HBHHx", *body)) for k, body in enumerate(
        ((table.EMCY_OVERLOAD, 1, bit, 0), (0, 0, table.EMCY_OVERLOAD, bit))
    )]  # fmt: skip
    for frame, overload in zip(emcy, (True, False), strict=True):
        (contact,) = assembler.feed(frame_array([frame, (9, 0x281, data)])).contacts()
        assert (Status.OVERLOAD in contact.status) == overload


@pytest.mark.parametrize("base", [0x280, 0x380])
@pytest.mark.parametrize(("raw", "overload"), [(32766, False), (32767, True)])
def test_a_force_at_the_end_of_integer16_may_be_larger(base: int, raw: int, overload: bool) -> None:
    name = "Contact" if base == 0x280 else "Force"
    frames = frame_array([(1, base + 1, struct.pack("<hhhBB", raw, 0, 0, 3, 1))])
    (contact,) = Assembler(PDOS, (name,)).feed(frames).contacts()
    assert (contact.reason == "overload") == overload
