"""2126h counts changes of what PDO values mean, and TPDO4 says so before the first PDO that has the new meaning."""

import binascii
import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_device.testing import MemoryStore
from fingertip.finger import OPEN, SAVE, Finger, finger
from tipforce.dictionary.entries import Entry, entries

HEALTH = 0x40000485
# Of 6xxxh, 7xxxh and 9xxxh: operating mode, scaling, offset, interrupts, span, filter.
PROFILE = {0x112, 0x120, 0x121, 0x122, 0x123, 0x124, 0x133, 0x134, 0x135, 0x136, 0x148, 0x149, 0x1A0, 0x1A1}


def counter(talk: Finger) -> int:
    """2126h."""
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
    """Every entry that may be written and read."""
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
def test_what_is_written_back_as_it_was_read_does_not_count(n: int) -> None:
    talk = finger(n)
    before, refused = counter(talk), 0
    for row in writable(n):
        data = talk.upload(row.index, row.sub)
        assert isinstance(data, bytes)
        refused += talk.download(row.index, row.sub, data) != 0
        assert talk.upload(row.index, row.sub) == data, row.name
        assert counter(talk) == before, row.name
    # The mapping of valid PDOs, 1003h:0, what takes a signature only; the entries that a valid TPDO does not change.
    assert refused < 100


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


def test_the_counter_wraps_and_is_0_at_boot(talk: Finger) -> None:
    for k in range(256):
        assert talk.put("f", 0x6124, 1, 1.0 + k) == 0
    assert counter(talk) == 2
    talk.say("> 000#8105\n< 705#00")
    assert counter(talk) == 0


# --- a store of version 1 -------------------------------------------------------------------------------------------


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
    assert not again.sync().status & 0x02
    assert again.get("I", 0x1003, 1) == 0x6320
    assert again.get("I", 0x1A03, 4) == 0x21260008
    again.say("> 000#8205\n< 705#00")  # reset communication restores the mapping as well
    assert again.get("I", 0x1A03, 4) == 0x21260008
    # What is stored next is of this version.
    assert again.put("I", 0x1010, 1, SAVE) == 0
    third = finger(store=store, calibrated=False)
    assert third.device.emcy.register == 0
