"""2126h counts changes of what PDO values mean, and TPDO4 says so before the first PDO that has the new meaning."""

import binascii
import struct

import pytest

from device.tiny import Memory
from fingertip.finger import PUSH, SAVE, TARA, ZERO, Finger, finger, matrix, record

DOUBLED = [[2.0 * value for value in row] for row in matrix()]
HEALTH = 0x40000485


def counter(talk: Finger) -> int:
    """2126h."""
    return int(talk.get("B", 0x2126))


@pytest.fixture
def talk() -> Finger:
    """A calibrated node; its commit was the first change."""
    talk = finger()
    assert counter(talk) == 1
    return talk


@pytest.mark.parametrize(
    ("kind", "index", "sub", "value"),
    [
        ("H", 0x2130, 0, 3),  # zero gauges; below a source with an offset
        ("f", 0x6124, 2, 5.0),
        ("h", 0x7124, 2, 50),
        ("i", 0x9124, 2, 50),
        ("f", 0x6122, 1, 9999.0),
        ("f", 0x6148, 4, -20.0),
        ("B", 0x61A0, 1, 1),
        ("H", 0x61A1, 1, 4),
        ("B", 0x1019, 0, 10),
        ("B", 0x1800, 2, 2),
        ("I", 0x1801, 1, 0xC0000285),
    ],
)
def test_a_setting_counts_where_its_value_changes(kind: str, index: int, sub: int, value: float) -> None:
    talk = finger(offset_microstrain=[3.0, 2.0, 1.0])
    talk.sync()
    assert talk.put(kind, index, sub, value) == 0
    assert counter(talk) == 2
    if index not in (0x2130, 0x7124, 0x9124):
        assert talk.put(kind, index, sub, value) == 0
        assert counter(talk) == 2


@pytest.mark.parametrize(
    ("kind", "index", "sub", "value"),
    [("H", 0x1017, 0, 5), ("H", 0x1803, 5, 500), ("f", 0x6133, 1, 2.0), ("f", 0x2100, 1, 1.0), ("B", 0x1800, 2, 245)],
)
def test_what_changes_no_meaning_or_is_refused_does_not_count(
    talk: Finger, kind: str, index: int, sub: int, value: float
) -> None:
    talk.put(kind, index, sub, value)
    assert counter(talk) == 1


def test_mapping_tare_and_commit(talk: Finger) -> None:
    talk.source.load = PUSH
    talk.sync()
    assert talk.put("I", 0x6139, 4, TARA) == 0
    assert counter(talk) == 2
    assert talk.put("H", 0x2130, 0, 2) == 0
    assert counter(talk) == 3
    assert talk.put("H", 0x2130, 0, 2) == 0  # there is no tare to end
    assert counter(talk) == 3
    talk.stage(record())
    assert talk.commit() == 0  # the same record
    assert counter(talk) == 3
    talk.stage(record(C=DOUBLED))
    assert talk.commit() == 0
    assert counter(talk) == 4
    assert talk.put("I", 0x1802, 1, 0x40000385 | 1 << 31) == 0
    assert talk.put("B", 0x1A02, 0, 0) == 0
    assert counter(talk) == 5
    assert talk.put("I", 0x6125, 1, ZERO) == 0x08000022  # refused: contact
    assert counter(talk) == 5


def test_health_goes_out_before_the_first_pdo_of_the_new_meaning(talk: Finger) -> None:
    assert talk.put("I", 0x1803, 1, HEALTH) == 0
    talk.advance(10)
    talk.take()
    value = struct.pack("<BHBf", 0x23, 0x6124, 2, 5.0)
    talk.now_us += 100
    # The write and the SYNC reach the node in one step: TPDO4 with the new counter is first.
    sent = talk.step([(0x605, value), (0x80, b"")])
    assert [can_id for can_id, _ in sent] == [0x485, 0x585, 0x185, 0x285]
    assert sent[0][1][6] == counter(talk) == 3


def test_the_counter_wraps_and_is_0_at_boot(talk: Finger) -> None:
    for k in range(256):
        assert talk.put("f", 0x6124, 1, 1.0 + k) == 0
    assert counter(talk) == 1
    talk.say("> 000#8105\n< 705#00")
    assert counter(talk) == 0


# --- a store of version 1 -------------------------------------------------------------------------------------------


def test_a_store_of_version_1_is_refused() -> None:
    store = Memory()
    talk = finger(store=store)
    assert talk.put("I", 0x1803, 1, 0xC0000485) == 0
    assert talk.put("B", 0x1A03, 0, 0) == 0
    assert talk.put("I", 0x1A03, 4, 0x21210008) == 0  # what version 1 mapped there
    assert talk.put("B", 0x1A03, 0, 5) == 0
    assert talk.put("I", 0x1010, 1, SAVE) == 0
    blob = store.groups["calibration"][4:]
    assert len(blob) == 8 + 158
    store.groups["calibration"] = struct.pack("<I", binascii.crc32(blob[: 8 + 106])) + blob[: 8 + 106]
    again = finger(store=store, calibrated=False)
    assert again.calibration() == (bytes(158), 0, 0)
    assert not again.sync().status & 0x02
    assert again.get("I", 0x1003, 1) == 0x6320
    assert again.get("I", 0x1A03, 4) == 0x21260008
    again.say("> 000#8205\n< 705#00")  # reset communication restores the mapping as well
    assert again.get("I", 0x1A03, 4) == 0x21260008
    # What is stored next is of this version.
    assert again.put("I", 0x1010, 1, SAVE) == 0
    third = finger(store=store, calibrated=False)
    assert third.device.emcy.register == 0
