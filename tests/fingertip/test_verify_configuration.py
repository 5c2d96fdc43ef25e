"""1020h vouches for what boot-up loads; 2126h counts changes of what PDO values mean; the calibration record."""

import binascii
import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_device.testing import MemoryStore
from fingertip.finger import LOAD, OPEN, SAVE, ZERO, Finger, finger, matrix, packing, record
from tipforce.dictionary import table_objects
from tipforce.dictionary.entries import Entry
from tipforce.dictionary.names import entries

NONE: list[float]
OURS: list[float]
NONE, OURS = [0, 0], [15000, 77]
STORE, RESTORE = 0x1010, 0x1011
HEALTH = 0x40000485
# Of 6xxxh, 7xxxh and 9xxxh: operating mode, scaling, offset, interrupts, span, filter.
PROFILE = {0x112, 0x120, 0x121, 0x122, 0x123, 0x124, 0x133, 0x134, 0x135, 0x136, 0x148, 0x149, 0x1A0, 0x1A1}


def verified(talk: Finger) -> list[float]:
    return [talk.get("I", 0x1020, sub) for sub in (1, 2)]


def verify(talk: Finger) -> None:
    for sub in (1, 2):
        assert talk.put("I", 0x1020, sub, OURS[sub - 1]) == 0


def reset(talk: Finger) -> None:
    talk.step([(0, b"\x81\x05")])
    talk.take()


def configured() -> Finger:
    """A node that was configured by the book (CiA 301, 7.5.2.21): settings, 1020h, store."""
    talk = finger(store=MemoryStore(), offset_microstrain=[1.0, 0.0, 0.0])
    for change in CHANGES:
        change(talk)
    verify(talk)
    assert talk.put("I", STORE, 1, SAVE) == 0
    return talk


def change_heartbeat(talk: Finger) -> None:
    assert talk.put("H", 0x1017, 0, 1 + int(talk.get("H", 0x1017))) == 0


def change_mapping(talk: Finger) -> None:
    assert talk.put("B", 0x1A02, 0, 0) == talk.put("I", 0x1A02, 1, 0x21200008) == talk.put("B", 0x1A02, 0, 1) == 0
    assert talk.put("H", 0x1802, 5, 1 + int(talk.get("H", 0x1802, 5))) == 0


def change_span(talk: Finger) -> None:
    assert talk.put("f", 0x6149, 4, talk.get("f", 0x6149, 4) - 1.0) == 0


def change_offset(talk: Finger) -> None:
    talk.source.offset_microstrain[0] += 0.5
    talk.frames()
    assert talk.put("I", 0x6125, 1, ZERO) == 0


def change_calibration(talk: Finger) -> None:
    serial = int(talk.get("I", 0x2102, 1))
    talk.stage(record(C=matrix(), serial=serial + 1))
    assert talk.commit() == 0


CHANGES = (change_heartbeat, change_span, change_offset, change_calibration)
GROUPS = {change_heartbeat: 2, change_mapping: 2, change_span: 3, change_offset: 3, change_calibration: 4}


def test_a_configuration_by_the_book_is_verified_after_a_restart() -> None:
    talk = configured()
    assert verified(talk) == OURS
    for _ in range(2):
        reset(talk)
        assert verified(talk) == OURS
        for sub in (1, 2, 3, 4):  # nothing else is stored than what is loaded
            assert talk.put("I", STORE, sub, SAVE) == 0
            assert verified(talk) == OURS


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("change", GROUPS)
@pytest.mark.parametrize("whole", [False, True])
def test_a_change_that_is_stored_clears_it(change, whole: bool, restarted: bool) -> None:  # type: ignore[no-untyped-def]
    talk = configured()
    if restarted:
        reset(talk)
    talk.step([(0, b"\x01\x05")])
    talk.take()
    change(talk)
    assert verified(talk) == OURS  # not stored: boot-up loads what it loaded
    other = 5 - GROUPS[change]
    if other != GROUPS[change] and other in (2, 3):
        assert talk.put("I", STORE, other, SAVE) == 0  # nor in the other group
        assert verified(talk) == OURS
    assert talk.put("I", STORE, 1 if whole else GROUPS[change], SAVE) == 0
    assert verified(talk) == NONE
    reset(talk)
    assert verified(talk) == NONE


@pytest.mark.parametrize("change", GROUPS)
def test_a_change_after_1020h_was_written_clears_it(change) -> None:  # type: ignore[no-untyped-def]
    talk = configured()
    verify(talk)
    change(talk)
    assert talk.put("I", STORE, 1, SAVE) == 0
    assert verified(talk) == NONE
    change(talk)
    verify(talk)
    assert talk.put("I", STORE, 1, SAVE) == 0
    assert verified(talk) == OURS


@pytest.mark.parametrize("sub", [1, 2, 3, 4])
def test_restoring_what_was_stored_clears_it(sub: int) -> None:
    talk = configured()
    assert talk.put("I", RESTORE, sub, LOAD) == 0
    assert verified(talk) == NONE
    reset(talk)
    assert verified(talk) == NONE


def test_restoring_what_was_never_stored_does_not() -> None:
    talk = finger(store=MemoryStore(), calibrated=False)
    verify(talk)
    assert talk.put("I", STORE, 2, SAVE) == talk.put("I", RESTORE, 3, LOAD) == 0
    reset(talk)
    assert verified(talk) == OURS


def test_a_stored_node_id_clears_it() -> None:
    talk = configured()
    talk.step([(0x7E5, b"\x04\x01" + bytes(6)), (0x7E5, b"\x11\x07" + bytes(6))])
    assert verified(talk) == OURS
    talk.step([(0x7E5, b"\x17" + bytes(7))])
    assert (0x7E4, b"\x17" + bytes(7)) in talk.take()
    assert verified(talk) == NONE


def test_the_store_is_cleared_before_the_change_is_written() -> None:
    """Power that fails between two writes never leaves the new content with the old 1020h."""
    store = MemoryStore()
    talk = finger(store=store)
    verify(talk)
    assert talk.put("I", STORE, 1, SAVE) == 0
    written: list[str] = []

    def save(name: str, data: bytes) -> bool:
        written.append(name)
        return store.save(name, data)

    talk.device.storage._save = save
    change_span(talk)
    assert talk.put("I", STORE, 3, SAVE) == 0
    assert written == ["communication", "application"]
    assert struct.pack("<H", 0x1020) not in store.groups["communication"]
    assert struct.pack("<H", 0x1017) in store.groups["communication"]


def counter(talk: Finger) -> int:
    return int(talk.get("B", 0x2126))


@pytest.fixture
def talk() -> Finger:
    """A calibrated node; 1017h and its commit were the first changes."""
    talk = finger()
    assert counter(talk) == 2
    return talk


def counted(index: int, sub: int) -> bool:
    """Whether 2126h counts a change of an entry, as the contract says it, not as the dictionary marks it."""
    if index >= 0x6000:
        return sub > 0 and index & 0xFFF in PROFILE
    if 0x1800 <= index < 0x1A00:
        return sub in (1, 2, 3, 5, 6)
    return 0x1A00 <= index < 0x1C00 or index in (0x1005, 0x1014, 0x1017, 0x1019)


def writable(n: int) -> list[Entry[Any]]:
    return [row for row in entries(n, simulated=True).values() if row.access == "rw" and row.type != "D"]


def others(row: Entry[Any], data: bytes) -> Iterator[bytes]:
    """Other values for an entry, likely ones first."""
    packing = "<" + row.type
    (value,) = struct.unpack(packing, data)
    for other in (value + 1, value - 1, value | 1 << 31 if row.type == "I" else 2, 0x21200008, 0):
        with suppress(struct.error):
            yield struct.pack(packing, other)


def make_writable(talk: Finger, index: int) -> None:
    """Unlock the calibration, make a PDO invalid and its mapping writable."""
    assert talk.put("I", 0x2105, 3, OPEN) == 0
    if 0x1400 <= index < 0x1C00:
        cob_id = index & ~0x200
        assert talk.put("I", cob_id, 1, int(talk.get("I", cob_id, 1)) | 1 << 31) == 0
        assert talk.put("B", cob_id | 0x200, 0, 0) == 0


@pytest.mark.parametrize("n", range(3, 9))
def test_each_entry_counts_a_change_exactly_if_the_contract_says_so(n: int) -> None:
    talk, changed = finger(n), set()
    for row in writable(n):
        make_writable(talk, row.index)
        data, before = talk.upload(row.index, row.sub), counter(talk)
        assert isinstance(data, bytes)
        for other in others(row, data):
            if other != data and talk.download(row.index, row.sub, other) == 0:
                changed.add((row.index, row.sub))
                by = (talk.upload(row.index, row.sub) != data) * counted(row.index, row.sub)
                assert counter(talk) == before + by & 0xFF, row.name
                assert talk.download(row.index, row.sub, other) == 0
                assert counter(talk) == before + by & 0xFF, row.name
                break
            assert counter(talk) == before, f"{row.name}: refused"
    never = {row.index for row in writable(n)} - {index for index, _sub in changed}
    assert never == {0x1003, 0x1010, 0x1011, 0x6112}  # no other value is allowed


@given(
    st.sampled_from(sorted(PROFILE - {0x112, 0x1A0, 0x1A1})),
    st.integers(1, 3),
    st.one_of(st.floats(width=32, allow_nan=False, allow_infinity=False), st.floats(-5000, 5000, width=32)),
)
@settings(max_examples=200)
def test_each_form_of_a_setting_is_written_back_without_a_change(part: int, sub: int, value: float) -> None:
    talk = finger(calibrated=False)
    talk.put("f", 0x6000 | part, sub, value)
    real, before = talk.upload(0x6000 | part, sub), counter(talk)
    for form in (0x7000, 0x9000, 0x6000):
        read = talk.upload(form | part, sub)
        assert isinstance(read, bytes)
        assert talk.download(form | part, sub, read) == 0
    assert talk.upload(0x6000 | part, sub) == real
    assert counter(talk) == before


def test_health_goes_out_before_the_first_pdo_of_the_new_meaning(talk: Finger) -> None:
    assert talk.put("I", 0x1803, 1, HEALTH) == 0
    talk.advance(10)
    talk.take()
    value = struct.pack("<BHBf", 0x23, 0x6124, 2, 5.0)
    talk.now_us += 100
    # The write and the SYNC reach the node in one step: TPDO4 with the new counter is first.
    sent = talk.step([(0x605, value), (0x80, b"")])
    assert [can_id for can_id, _ in sent] == [0x485, 0x585, 0x185, 0x285]
    assert sent[0][1][6] == counter(talk) == 4


def test_damaged_scaling_is_told_and_leaves_the_calibration() -> None:
    store = MemoryStore()
    assert finger(store=store).put("I", 0x1010, 1, SAVE) == 0
    store.groups["application"] = b"\0"
    again = finger(store=store, calibrated=False)
    assert (again.sync().status & 0x02, again.get("I", 0x1003, 1)) == (0x02, 0x6320)


def test_a_store_of_version_1_is_refused() -> None:
    store = MemoryStore()
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
    assert again.get("I", 0x1003, 1) == 0x6320
    assert again.get("I", 0x1A03, 4) == 0x21260008
    again.say("> 000#8205\n< 705#00")  # reset communication restores the mapping as well
    assert again.get("I", 0x1A03, 4) == 0x21260008
    # What is stored next is of this version.
    assert again.put("I", 0x1010, 1, SAVE) == 0
    assert finger(store=store, calibrated=False).device.emcy.register == 0


@pytest.mark.parametrize("n", range(3, 9))
def test_writing_2141h_sets_every_staged_object(n: int) -> None:
    talk = finger(n, calibrated=False)
    values = [float(k) for k in range(1, 4 * n + 1)] + [7, 20240229, 21.5, 3]
    values += [100.0 + k for k in range(n * (n + 1) // 2)] + [0.0078125, -30.0, 30.0, 2.0, 1.0, 1]
    values += [5.0, 20.0, -10.0, 50.0, 0.25] + [0.5 + k for k in range(2 * n + 2)]
    data = struct.pack(packing(n), *values)
    assert talk.upload(0x2140) == talk.upload(0x2141) == bytes(len(data))
    assert talk.download(0x2141, 0, data) == 0
    assert [talk.get(kind, index, sub) for index, sub, kind in table_objects.staged(n)] == values
    assert talk.upload(0x2141) == data
    assert talk.get("I", 0x2103, 2) == binascii.crc32(data)
    # Staged only: the node is still not calibrated. Writing each object gives the same record.
    assert talk.calibration() == (bytes(len(data)), 0, 0)
    talk, offset = finger(n, calibrated=False), 0
    for index, sub, kind in table_objects.staged(n):
        size = struct.calcsize(kind)
        assert talk.download(index, sub, data[offset : offset + size]) == 0
        offset += size
    assert talk.upload(0x2141) == data
