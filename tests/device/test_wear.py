"""The budget of wear: 200 operations on the store at once, one back in each 18 s, whoever asks, and over resets."""

import random
import struct

import pytest

from canopen_device.core.node import Device
from canopen_device.testing import Conversation, MemoryStore
from device.tiny import booted
from fingertip.finger import LOAD, SAVE
from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource

PERIOD_US, OPERATIONS = 18_000_000, 200
SIGNATURE = {0x1010: SAVE, 0x1011: LOAD}
NO_LSS, LSS_STORED, LSS_FAILED = b"", b"\x17\0", b"\x17\2"
REFUSED = 0x08000022


class Counted(MemoryStore):
    """A store, and program slots, that count the operations on them."""

    reason = crc = 0
    version = "1"
    ready = busy = locked = False

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def save(self, group: str, data: bytes) -> bool:
        self.operations += 1
        return super().save(group, data)

    def begin(self, _size: int) -> int:
        self.operations += 1
        return 0

    def write(self, _part: bytes) -> int:
        return 0

    def end(self) -> int:
        return 1

    def cancel(self) -> None:
        """Nothing to give up."""

    def clear(self) -> int:
        return self.begin(0)

    def start(self) -> int:
        return 1


def fingertip(store: Counted) -> Device:
    return fingertip_node(5, SimulatedSource([[1e-4] * 3] * 3), 3, 4711, store.save, store.load, programs=store)


def talking(device: Device) -> Conversation:
    talk = Conversation(device, now_us=1_000_000, emcy=True)
    talk.take()
    talk.step([(0x7E5, b"\x04\x01" + bytes(6))])  # LSS configuration
    return talk


def lss_store(talk: Conversation) -> bytes:
    talk.step([(0x7E5, b"\x17" + bytes(7))])
    return next((data[:2] for can_id, data in reversed(talk.take()) if can_id == 0x7E4), NO_LSS)


def request(talk: Conversation, what: int, sub: int) -> int:
    """One of the requests that wear flash; the abort code, 1 for the error of LSS."""
    if what in SIGNATURE:
        return talk.put("I", what, sub, SIGNATURE[what])
    if what == 0x1F50:
        talk.step([(0x605, struct.pack("<BHBI", 0x21, 0x1F50, 1, 1000))])
        answer = next(data for can_id, data in reversed(talk.sent) if can_id == 0x585)
        talk.step([(0x605, b"\x80\x50\x1f\x01" + bytes(4))])
        return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0
    if what == 0x1F51:
        return talk.put("B", 0x1F51, 1, 3)
    return int(lss_store(talk) == LSS_FAILED)


def emcys(talk: Conversation) -> int:
    return [data[:2] for can_id, data in talk.take() if can_id == 0x85].count(b"\x10\xff")


@pytest.mark.parametrize("seed", range(4))
def test_a_flood_of_every_request_and_reset_keeps_the_budget(seed: int) -> None:
    store, pick = Counted(), random.Random(seed)
    talk = talking(fingertip(store))
    began_us, refused = talk.now_us, 0
    for _ in range(4000):
        talk.now_us += pick.choice((0, 1, 1000, 1_000_000))
        what = pick.choice((0x1010, 0x1011, 0x1F50, 0x1F51, 0x17, 0x17, 0))
        if what:
            refused += request(talk, what, pick.choice((1, 2, 3, 4))) in (REFUSED, 1)
        elif pick.random() < 0.1:
            talk.step([(0, bytes((pick.choice((0x81, 0x82)), 5)))])
            talk.step([(0x7E5, b"\x04\x01" + bytes(6))])
        assert store.operations <= OPERATIONS + (talk.now_us - began_us) // PERIOD_US
    assert refused > 1000
    assert store.operations >= OPERATIONS + (talk.now_us - began_us) // PERIOD_US - 4


@pytest.mark.parametrize("what", [0x1010, 0x1011, 0x1F50, 0x1F51, 0x17])
def test_each_request_is_refused_when_the_budget_is_empty(what: int) -> None:
    store = Counted()
    talk = talking(fingertip(store))
    assert [request(talk, what, 4) for _ in range(OPERATIONS)] == [0] * OPERATIONS
    assert emcys(talk) == 0
    for reset in (b"", b"\x81\x05", b"\x82\x05"):
        if reset:
            talk.step([(0, reset), (0x7E5, b"\x04\x01" + bytes(6))])
        talk.take()
        assert request(talk, what, 4) == (1 if what == 0x17 else REFUSED)
    assert talk.get("I", 0x1003, 1) == 0xFF10
    assert talk.get("B", 0x1003) == 1
    talk.now_us += PERIOD_US - 1
    assert request(talk, what, 4)
    talk.now_us += 1
    assert request(talk, what, 4) == 0
    assert request(talk, what, 4)
    assert store.operations == OPERATIONS + 1
    assert talk.get("B", 0x1003) == 1  # said once
    talk.now_us += OPERATIONS * PERIOD_US
    assert [request(talk, what, 4) == 0 for _ in range(OPERATIONS + 1)] == [True] * OPERATIONS + [False]
    assert talk.get("B", 0x1003) == 2  # it was full again


def test_all_groups_are_stored_or_none() -> None:
    """1010h:1 writes three groups of a fingertip: with two operations left none is written."""
    store = Counted()
    talk = talking(fingertip(store))
    for _ in range(OPERATIONS - 2):
        assert talk.put("I", 0x1010, 3, SAVE) == 0
    before = dict(store.groups)
    assert talk.put("I", 0x1010, 1, SAVE) == REFUSED
    assert store.groups == before
    assert talk.put("I", 0x1010, 3, SAVE) == talk.put("I", 0x1010, 4, SAVE) == 0


def test_what_writes_nothing_takes_nothing() -> None:
    store = Counted()
    talk = talking(fingertip(store))
    for _ in range(300):
        assert talk.put("I", 0x1010, 1, 0) == talk.put("I", 0x1011, 1, SAVE) == 0x08000020
        assert talk.put("B", 0x1F51, 1, 0) == 0
    talk.step([(0, b"\x01\x05")])
    for _ in range(300):
        assert request(talk, 0x1F50, 1) == request(talk, 0x1F51, 1) == REFUSED  # OPERATIONAL
    talk.step([(0, b"\x80\x05")])
    assert store.operations == 0
    assert request(talk, 0x1F51, 1) == 0
    talk.step([(0x605, struct.pack("<BHBI", 0x21, 0x1F50, 1, 14)), (0, b"\x01\x05"), (0x605, bytes(8))])
    assert talk.take()[-1][1] == struct.pack("<BHBI", 0x80, 0x1F50, 1, REFUSED)  # OPERATIONAL since it began


def test_the_budget_holds_after_a_clock_that_goes_back_and_after_a_restart() -> None:
    store = Counted()
    talk = talking(fingertip(store))
    while not talk.put("I", 0x1010, 4, SAVE):
        pass
    talk.now_us = 0
    assert talk.put("I", 0x1010, 4, SAVE) == REFUSED
    again = fingertip(store)
    again.wear.drain()  # the firmware does, unless power was off
    talk = talking(again)
    assert talk.put("I", 0x1010, 4, SAVE) == REFUSED
    talk.now_us += PERIOD_US
    assert talk.put("I", 0x1010, 4, SAVE) == 0


def test_any_device_has_it() -> None:
    store = Counted()
    talk = booted(store)
    assert sum(talk.put("I", 0x1010, 3, SAVE) == 0 for _ in range(300)) == OPERATIONS == store.operations
