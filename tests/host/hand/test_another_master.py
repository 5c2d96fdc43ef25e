"""Every writable object of a finger in a running hand, written by another master; alone, and after its health PDO.

The cases come from the dictionary. The loads are known for each SYNC: no row may show another force, except where
``foreign_changes = "accept"`` accepted the change. What differs at the end is an event, and is restored where asked.
A sample runs here; with TIPFORCE_ALL_WRITES=1 all of them (``make long``), which print a table with -s."""

import os
import random
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

from canopen_device import types
from canopen_device.core import codes, communication
from canopen_device.core.node import Device
from host.hand.simulated_hand import SimulatedHand, simulated_hand
from tipforce.dictionary import indices, objects, table
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import entries
from tipforce.fingertip.node import fingertip_node
from tipforce.host.hand.meaning import watched
from tipforce.sources.simulated import SimulatedSource

POLICIES = ("refuse", "restore", "accept")
Write = tuple[int, int, bytes]  # index, sub-index, data of an expedited download
ALL = bool(os.environ.get("TIPFORCE_ALL_WRITES"))
GAP_US = 700  # between two writes of a sequence
END_S = 1.2
UNSURE_S = 0.1
"""What another master writes without changing anything costs no more."""

COUNTS: Counter[tuple[str, str, str]] = Counter()


@pytest.fixture(scope="module", autouse=True)
def _table() -> Iterator[None]:
    """What was tried, under which policy, with which outcome, how often."""
    yield
    for (what, policy, found), count in sorted(COUNTS.items()):
        print(f"| {what} | {policy} | {found} | {count} |")


def upload(device: Device, index: int, sub: int) -> bytes:
    found = device.od.upload(index, sub)
    return found if isinstance(found, bytes) else b""


def candidates(row: Entry[Any], present: bytes) -> list[bytes]:
    """Values that differ from the present one: a bit, the ends of the range, identifiers of others."""
    size = types.data_type(row.type).size or 0
    if row.type == "f":
        value = struct.unpack("<f", present)[0] if present else 0.0
        return [struct.pack("<f", other) for other in (value + 50.0, -1.0 if value else 3.0, 2.0 * value + 1.0)]
    value = int.from_bytes(present, "little")
    numbers = [value ^ 1, value + 7, 0, 1, 2, 4, 100, 240, 254, 0x90, 0x280, 0xFFFF, 0x7FFFFFFF]
    if row.name.endswith("cob_id"):
        numbers = [value ^ codes.COB_ID_INVALID, 0x40000281, 0x281, 0x400003B3, 0x90, *numbers]
    signatures = {indices.AUTOTARE: table.SIGNATURE_TARA, indices.CALIBRATION_COMMIT: table.SIGNATURE_COMMIT}
    if row.access == "wo":
        numbers = [signatures.get(row.index, table.SIGNATURE_ZERO)]
    found = [n & (1 << 8 * size) - 1 for n in numbers]
    return [n.to_bytes(size, "little") for n in dict.fromkeys(found) if row.access == "wo" or n != value]


def sequence(device: Device, row: Entry[Any], data: bytes) -> list[Write]:
    """The writes by which a master changes an object: those of a PDO by the procedure of CiA 301, 7.5.2.35."""
    first, last = communication.RPDO, communication.LAST_TPDO_MAPPING
    write: Write = row.index, row.sub, data
    if not first <= row.index <= last:
        return [write]
    parameters = row.index & ~communication.MAPPING
    cob_id = int.from_bytes(upload(device, parameters, 1), "little")
    off = parameters, 1, (cob_id | codes.COB_ID_INVALID).to_bytes(4, "little")
    on = parameters, 1, cob_id.to_bytes(4, "little")
    if row.index == parameters:
        return [off, write] if row.sub == 1 else [off, write, on]
    count = row.index, 0, upload(device, row.index, 0)
    return [off, (row.index, 0, b"\0"), write, *([count] if row.sub else []), on]


def writable() -> list[Entry[Any]]:
    """Every object that another master can write in one frame; of the staged calibration only the commit matters."""
    kept = table.STAGED
    return [
        row
        for row in entries(3).values()
        if row.access in ("rw", "wo") and not row.flags & kept and types.data_type(row.type).size
    ]


def accepted_values(limit: int) -> list[tuple[Entry[Any], bytes]]:
    """Values that a finger takes, at most so many for an object; one that it refuses where it takes none."""
    found = []
    device = fingertip_node(2, SimulatedSource([[1.0, 0.0, 0.0]] * 3), serial=2)
    device.step(0, [])
    initial = dict(device.od.values)
    for row in writable():
        values = candidates(row, upload(device, row.index, row.sub))
        taken = []
        for data in values:
            aborted = [device.od.download(*write) for write in sequence(device, row, data)]
            if not any(aborted) or row.access == "wo":
                taken.append((row, data))
            device.od.values.update(initial)
            device.tpdos.reset()
            device.rpdos.reset()
            if len(taken) == limit:
                break
        found += taken or [(row, values[0])]
    return found


def inject(hand: SimulatedHand, writes: list[Write], after_us: int = 0, node_id: int = 2) -> int:
    """Send downloads one after another; return when the last is sent."""
    for index, sub, data in writes:
        request = struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")
        hand.line.at(after_us, partial(hand.line.put, codes.SDO_REQUEST_BASE + node_id, request))
        after_us += GAP_US
    return after_us


def snapshot(hand: SimulatedHand) -> dict[tuple[int, int, int], bytes]:
    """All that is watched, on the nodes themselves."""
    return {
        (serial, index, sub): upload(device, index, sub)
        for serial, device in hand.line.devices.items()
        for index, sub in watched(3)
    }


def outcome(hand: SimulatedHand, before: dict[tuple[int, int, int], bytes], policy: str) -> str:
    """Let the hand decide; check what holds for every case, and return what it was."""
    hand.line.run(END_S)
    after = snapshot(hand)
    differs = [hex(index) + f":{sub} of {serial}" for (serial, index, sub), data in before.items()
               if after[serial, index, sub] != data]  # fmt: skip
    kinds = hand.kinds(2) + hand.kinds(1)
    text = f"{policy}: differs {differs}, events {[(e.node_id, e.kind, e.text) for e in hand.events]}"
    assert not hand.wrongs, f"{text}, {hand.wrongs[:5]}"
    shown = hand.is_shown(1) and hand.is_shown(2)
    assert shown or not hand.hand.settled(), text
    if differs:
        assert {"accepted", "refused"} & set(kinds), text
        assert policy != "refuse" or not shown, text
        assert policy != "restore" or "refused" in kinds, text
        return "accepted" if shown else "refused"
    assert shown, text
    assert hand.hand.settled(), text
    return "restored" if "restored" in kinds else "noticed" if "changed" in kinds else "no change"


FIRST = {
    "health off": (communication.TPDO + 3, 1, 0xC0000482),
    "health moved": (communication.TPDO + 3, 1, 0x400003B3),
    "health inhibited": (communication.TPDO + 3, 3, 0xFFFF),
    "health untimed": (communication.TPDO + 3, 5, 0),
    "PDO of the other finger": (communication.TPDO + 1, 1, 0x40000281),
}
"""What takes the hand's means of noticing away, or another finger's place."""


def first_writes(hand: SimulatedHand, how: str) -> list[Write]:
    index, sub, value = FIRST[how]
    row = entries(3)[index, sub]
    return sequence(hand.line.devices[2], row, value.to_bytes(types.data_type(row.type).size or 0, "little"))


def decided(
    hand: SimulatedHand, before: dict[tuple[int, int, int], bytes], policy: str, what: str, row: Entry[Any]
) -> None:
    """Count the outcome; only a committed calibration is not restored."""
    found = outcome(hand, before, policy)
    assert policy != "restore" or found != "refused" or row.index == indices.CALIBRATION_COMMIT
    COUNTS[what, policy, found] += 1


def _sample(cases: list[tuple[Entry[Any], bytes]], count: int, seed: int) -> list[tuple[Entry[Any], bytes]]:
    """All, or some: of each object that is not one of many equal ones."""
    if ALL:
        return cases
    by_index: dict[int, list[tuple[Entry[Any], bytes]]] = {}
    for case in cases:
        by_index.setdefault(case[0].index, []).append(case)
    pick = random.Random(seed)
    return [pick.choice(by_index[index]) for index in pick.sample(sorted(by_index), count)]


VALUES = accepted_values(2)


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("case", _sample(VALUES, 6, 1), ids=lambda case: f"{case[0].name}={case[1].hex()}")
def test_one_object(policy: str, case: tuple[Entry[Any], bytes]) -> None:
    row, data = case
    with simulated_hand(policy, echo=row.sub % 2 == 0) as hand:
        before = snapshot(hand)
        inject(hand, sequence(hand.line.devices[2], row, data))
        decided(hand, before, policy, "one object", row)


def _pairs() -> Iterator[tuple[str, tuple[Entry[Any], bytes], int]]:
    pick, values = random.Random(2), accepted_values(1)
    for number, how in enumerate(FIRST):
        for case in _sample(values, 2, number):
            yield how, case, pick.choice((0, 5_000, 50_000, pick.randrange(300_000)))


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize(("how", "case", "gap_us"), list(_pairs()), ids=lambda one: one if isinstance(one, str) else "")
def test_a_pair(policy: str, how: str, case: tuple[Entry[Any], bytes], gap_us: int) -> None:
    """One of FIRST, and within 0.3 s an object."""
    with simulated_hand(policy) as hand:
        before, first = snapshot(hand), first_writes(hand, how)
        inject(hand, first)
        inject(hand, sequence(hand.line.devices[2], *case), len(first) * GAP_US + gap_us)
        decided(hand, before, policy, f"{how}, then one object", case[0])


def write(entry: Entry[int] | Entry[float], value: float) -> Write:
    return entry.index, entry.sub, entry.encode(value)  # type: ignore[arg-type]


COB_ID_SYNC = entries(3)[communication.COB_ID_SYNC, 0]
SAVE = communication.STORE_PARAMETERS, 1, codes.SIGNATURE_SAVE.to_bytes(4, "little")


OFFSETS = [write(objects.PROCESS_OFFSET[2], 50.0 + k) for k in range(256)]
MOVED = [write(objects.TPDO2_COB_ID, 0xC0000281), write(objects.TPDO2_COB_ID, 0x40000282)]
NO_HEARTBEAT = communication.PRODUCER_HEARTBEAT, 0, b"\0\0"


def _wrapped(hand: SimulatedHand) -> None:
    first = first_writes(hand, "health off")
    inject(hand, [*first, *OFFSETS[len(first) :]])


def _stored_and_reset(*writes: Write) -> Callable[[SimulatedHand], None]:
    def act(hand: SimulatedHand) -> None:
        after_us = inject(hand, [*writes, SAVE])
        reset = bytes((codes.NMT_RESET_NODE, 2))
        hand.line.at(after_us + 20_000, lambda: hand.line.put(codes.NMT_COB_ID, reset))

    return act


def _tare_by_rpdo(hand: SimulatedHand) -> None:
    after_us = inject(hand, [*first_writes(hand, "health off"), (communication.RPDO, 1, (0x202).to_bytes(4, "little"))])
    hand.line.at(after_us + 250_000, lambda: hand.line.put(0x202, b"\x01\0"))


def _renumbered(hand: SimulatedHand) -> None:
    """Finger 2 becomes node 9, by LSS."""
    parts = (0, table.product_code(3, True), table.REVISION, 2)
    frames = [bytes((0x40 + k,)) + part.to_bytes(4, "little") + b"\0\0\0" for k, part in enumerate(parts)]
    frames += [bytes((0x11, 9, 0, 0, 0, 0, 0, 0)), bytes((0x04, 0, 0, 0, 0, 0, 0, 0))]
    for k, frame in enumerate(frames):
        hand.line.at(1000 * k, partial(hand.line.put, codes.LSS_REQUEST_COB_ID, frame))
    hand.line.at(30_000, lambda: hand.line.put(codes.NMT_COB_ID, bytes((codes.NMT_RESET_COMMUNICATION, 2))))


def _tare_after_health(hand: SimulatedHand) -> None:
    first = first_writes(hand, "health off")
    inject(hand, first)
    inject(hand, [write(objects.AUTOTARE[4], table.SIGNATURE_TARA)], len(first) * GAP_US + 300_000)


HOLES: dict[str, Callable[[SimulatedHand], object]] = {
    "health off": lambda hand: inject(hand, first_writes(hand, "health off")),
    "256 writes, health off": _wrapped,
    "256 writes": lambda hand: inject(hand, OFFSETS),
    "health off, then a tare": _tare_after_health,
    "COB-ID of the other finger": lambda hand: inject(hand, MOVED, node_id=1),
    "heartbeat off, then COB-ID of the other finger": lambda hand: inject(hand, [NO_HEARTBEAT, *MOVED], node_id=1),
    "1005h, stored and reset": _stored_and_reset((communication.COB_ID_SYNC, 0, b"\x90\0\0\0")),
    "offset, stored and reset": _stored_and_reset(write(objects.PROCESS_OFFSET[2], 50.0)),
    "tare by RPDO": _tare_by_rpdo,
    "renumbered by LSS": _renumbered,
}
RESTORED_SILENTLY = {"1005h, stored and reset", "renumbered by LSS"}  # a finger that boots is set up as in the file


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("hole", HOLES)
def test_a_hole(policy: str, hole: str) -> None:
    with simulated_hand(policy) as hand:
        before = snapshot(hand)
        HOLES[hole](hand)
        hand.line.run(1.5)
        found = outcome(hand, before, policy)
        assert found in ("no change", "noticed") if hole in RESTORED_SILENTLY else found != "no change"
        assert hand.events
        COUNTS[hole, policy, found] += 1


@pytest.mark.parametrize("echo", [True, False])
def test_what_is_already_there_costs_a_tenth_of_a_second(echo: bool) -> None:
    """Polling costs nothing; writing back what was read, in REAL32 too, at most 0.1 s of values each time."""
    with simulated_hand(echo=echo) as hand:
        before = snapshot(hand)
        hand.rows.clear()
        hand.shown = 0
        for index, sub in watched(3):
            hand.master.sdo(2).upload(index, sub)
        hand.line.run(0.1)
        assert all(not rows.reason.any() for rows in hand.rows)
        for index, sub in ((0x6124, 1), (0x6123, 1), (0x6149, 2), (0x1017, 0), (0x1801, 2)):
            data = before[2, index, sub]
            hand.rows.clear()
            inject(hand, [(index, sub, data)])
            hand.line.run(0.3)
            hidden = sum(int((rows.reason[:, 1] != 0).sum()) for rows in hand.rows)
            assert 0 < hidden <= UNSURE_S * 100, (hex(index), hidden)
            assert all(not rows.reason[:, 0].any() for rows in hand.rows)
        assert hand.events == []
        assert hand.hand.settled()


def test_a_finger_whose_heartbeats_are_late_is_not_reset() -> None:
    """LSS finds its serial under the node-id of the hand file: a reset would end its tare."""
    with simulated_hand() as hand, pytest.MonkeyPatch.context() as patch:
        put = hand.line.put
        patch.setattr(hand.line, "put", lambda can_id, *words, **more: can_id == 0x702 or put(can_id, *words, **more))
        hand.line.run(2.5)
        patch.undo()
        hand.line.run(0.5)
        assert hand.kinds(2) == ["heartbeat_lost", "heartbeat_back"]
        assert hand.is_shown(2)


def test_a_block_download_is_a_write() -> None:
    with simulated_hand() as hand:
        staged = hand.line.devices[2].od.upload(indices.CALIBRATION_ACTIVE_RECORD, 0)
        assert isinstance(staged, bytes)
        hand.master.sdo(2).download(indices.CALIBRATION_STAGED_RECORD, 0, staged)
        assert not hand.is_shown(2, 0.05)
        hand.line.run(0.5)
        assert hand.is_shown(2)
        assert hand.events == []
