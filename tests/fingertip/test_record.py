"""The calibration record (docs/objects.md): its layout; the staged objects, 2141h and 2140h have the same bytes."""

import binascii
import math
import struct

import pytest

from fingertip.finger import SAVE, finger, packing, record
from tipforce.dictionary import table


@pytest.mark.parametrize(("n", "size"), [(3, 158), (4, 198), (5, 242), (6, 290), (7, 342), (8, 398)])
def test_length_of_the_record(n: int, size: int) -> None:
    # 4 (3n + n) + 13 + 4 n (n + 1) / 2 + 21, and in version 2 20 + 4 n + 4 n + 8
    assert size == 16 * n + 13 + 2 * n * (n + 1) + 21 + 28 + 8 * n == struct.calcsize(packing(n))
    talk = finger(n, calibrated=False)
    for index in (0x2140, 0x2141):
        assert talk.upload(index) == bytes(size)


def test_table_declares_the_record_in_this_order() -> None:
    fields = table.staged(3)
    assert [index for index, _sub, _kind in fields] == [0x2100] * 9 + [0x2101] * 3 + [0x2102] * 4 + [0x2106] * 6 + [
        0x2110
    ] * 6 + [0x2112] * 5 + [0x2113] * 3 + [0x2114] * 3 + [0x2115, 0x2116]
    assert "".join(kind for _index, _sub, kind in fields) == "f" * 12 + "IIfB" + "f" * 6 + "fffff" + "B" + "f" * 13


@pytest.mark.parametrize("n", [3, 5, 8])
def test_writing_2141h_sets_every_staged_object(n: int) -> None:
    talk = finger(n, calibrated=False)
    values = [float(k) for k in range(1, 4 * n + 1)] + [7, 20240229, 21.5, 3]
    values += [100.0 + k for k in range(n * (n + 1) // 2)] + [0.0078125, -30.0, 30.0, 2.0, 1.0, 1]
    values += [5.0, 20.0, -10.0, 50.0, 0.25] + [0.5 + k for k in range(2 * n + 2)]
    data = struct.pack(packing(n), *values)
    assert talk.download(0x2141, 0, data) == 0
    read = [talk.get(kind, index, sub) for index, sub, kind in table.staged(n)]
    assert read == values
    assert talk.upload(0x2141) == data
    assert talk.get("I", 0x2103, 2) == binascii.crc32(data)
    # Staged only: the node is still not calibrated.
    assert talk.calibration() == (bytes(len(data)), 0, 0)


@pytest.mark.parametrize("n", [3, 8])
def test_writing_each_object_gives_the_same_record(n: int) -> None:
    talk, data = finger(n, calibrated=False), record(n)
    offset = 0
    for index, sub, kind in table.staged(n):
        size = struct.calcsize(kind)
        assert talk.download(index, sub, data[offset : offset + size]) == 0
        offset += size
    assert talk.upload(0x2141) == data
    assert talk.get("I", 0x2103, 2) == binascii.crc32(data)


@pytest.mark.parametrize(
    ("size", "code"), [(0, 0x06070013), (4, 0x06070013), (106, 0x06070013), (157, 0x06070013), (159, 0x06070012)]
)
def test_record_of_another_length_is_refused(size: int, code: int) -> None:
    talk = finger()
    before = talk.upload(0x2141)
    assert talk.download(0x2141, 0, bytes(size)) == code
    assert talk.upload(0x2141) == before


def test_record_cut_off_on_the_way_changes_nothing() -> None:
    talk = finger()
    before = talk.upload(0x2141)
    talk.say("""
        > 605#204121000000.0000
        < 585#6041210000000000
        > 605#00.FFFFFFFFFFFFFF
        < 585#2000000000000000
        > 605#11.FFFFFFFFFFFFFF
        < 585#8041210013000706
    """)
    assert talk.upload(0x2141) == before


def test_active_record_is_read_only() -> None:
    assert finger().download(0x2140, 0, record()) == 0x06010002


def test_what_was_committed_is_read_back_and_counted() -> None:
    talk = finger(calibrated=False)
    for k in range(1, 4):
        data = record(serial=k)
        talk.stage(data)
        assert talk.commit() == 0
        assert talk.calibration() == (data, binascii.crc32(data), k)
        assert talk.upload(0x2141) == data
        assert talk.get("I", 0x2102, 1) == k


def test_staged_record_equals_the_active_one_after_start() -> None:
    from device.tiny import Memory

    store = Memory()
    talk = finger(store=store)
    assert talk.put("I", 0x1010, 4, SAVE) == 0
    talk.stage(record(serial=99))
    again = finger(store=store, calibrated=False)
    assert again.upload(0x2141) == again.upload(0x2140) == record()
    assert again.get("I", 0x2103, 4) == 1
    # A reset of the running node drops what was staged as well.
    talk.say("> 000#8105\n< 705#00")
    assert talk.upload(0x2141) == record()


@pytest.mark.parametrize("bits", [0x7FC00000, 0x7F800000, 0xFF800000])
def test_numbers_that_are_not_finite_may_be_staged(bits: int) -> None:
    talk = finger()
    assert talk.download(0x2100, 1, struct.pack("<I", bits)) == 0
    assert math.isnan(talk.get("f", 0x2102, 5))


def test_load_sense_keeps_its_limits_in_both_ways() -> None:
    talk = finger()
    assert talk.put("B", 0x2110, 6, 2) == 0x06090031
    assert talk.download(0x2141, 0, record()[:105] + b"\x02" + record()[106:]) == 0x06090030
    assert talk.upload(0x2141) == record()


def test_condition_number_is_that_of_the_staged_matrix() -> None:
    talk = finger()
    assert talk.get("f", 0x2102, 5) == pytest.approx(1.0)
    assert talk.put("f", 0x2100, 1, 1e6) == 0
    assert talk.get("f", 0x2102, 5) == pytest.approx(100.0)
    assert talk.put("f", 0x2100, 1, 0.0) == 0
    assert talk.get("f", 0x2102, 5) == math.inf
    assert talk.put("f", 0x2102, 5, 1.0) == 0x06010002
