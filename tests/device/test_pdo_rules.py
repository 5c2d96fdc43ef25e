"""Rules for writing PDO parameters (CiA 301, 7.5.2.33 to 7.5.2.38), and that an accepted write acts at once."""

import pytest

from device.conversation import Conversation
from device.tiny import booted, operational

INVALID, NO_RTR = 0x80000000, 0x40000000
BUSY, VALUE = 0x08000022, 0x06090030


@pytest.fixture
def talk() -> Conversation:
    """A node whose TPDO1 and RPDO1 are valid, and TPDO2 and RPDO2 not."""
    talk = booted()
    assert talk.put("I", 0x1800, 1, NO_RTR | 0x185) == 0
    assert talk.put("I", 0x1400, 1, 0x205) == 0
    return talk


def test_cob_id_of_a_valid_pdo_is_not_changed(talk: Conversation) -> None:
    assert talk.put("I", 0x1800, 1, NO_RTR | 0x186) == VALUE
    assert talk.put("I", 0x1400, 1, 0x206) == VALUE
    assert talk.get("I", 0x1800, 1) == NO_RTR | 0x185
    # The same once more is no change; invalid, then another, is the way to do it.
    assert talk.put("I", 0x1800, 1, NO_RTR | 0x185) == 0
    assert talk.put("I", 0x1800, 1, INVALID | NO_RTR | 0x186) == 0
    assert talk.put("I", 0x1800, 1, NO_RTR | 0x186) == 0


@pytest.mark.parametrize(
    "can_id",
    [0, 1, 0x7F, 0x101, 0x180, 0x581, 0x585, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x77F, 0x780, 0x7FF],
)
def test_restricted_can_ids_are_refused(talk: Conversation, can_id: int) -> None:
    assert talk.put("I", 0x1801, 1, NO_RTR | can_id) == VALUE
    assert talk.put("I", 0x1401, 1, can_id) == VALUE


@pytest.mark.parametrize("can_id", [0x80, 0x100, 0x181, 0x57F, 0x580, 0x600, 0x680, 0x6DF, 0x700])
def test_can_ids_at_the_edge_of_restricted_ranges_are_allowed(talk: Conversation, can_id: int) -> None:
    assert talk.put("I", 0x1801, 1, NO_RTR | can_id) == 0


@pytest.mark.parametrize("cob_id", [0x20000285, 0x20000285 | NO_RTR, NO_RTR | 0x800, INVALID | 0x20000000 | NO_RTR])
def test_29_bit_identifiers_are_refused(talk: Conversation, cob_id: int) -> None:
    assert talk.put("I", 0x1801, 1, cob_id) == VALUE
    assert talk.put("I", 0x1401, 1, cob_id) == VALUE


@pytest.mark.parametrize("cob_id", [0x285, INVALID | 0x285])
def test_tpdo_without_bit_30_would_have_to_answer_remote_frames(talk: Conversation, cob_id: int) -> None:
    assert talk.put("I", 0x1801, 1, cob_id) == VALUE


@pytest.mark.parametrize("transmission", range(241, 254))
def test_reserved_and_remote_transmission_types_are_refused(talk: Conversation, transmission: int) -> None:
    for index in (0x1800, 0x1801, 0x1400, 0x1401):
        assert talk.put("B", index, 2, transmission) == VALUE
    assert talk.get("B", 0x1800, 2) == 1


@pytest.mark.parametrize("transmission", [0, 1, 240, 254, 255])
def test_transmission_types_that_are_offered(talk: Conversation, transmission: int) -> None:
    for index in (0x1800, 0x1801, 0x1400, 0x1401):
        assert talk.put("B", index, 2, transmission) == 0


def test_inhibit_time_and_sync_start_value_only_while_invalid(talk: Conversation) -> None:
    assert talk.put("H", 0x1800, 3, 10) == BUSY
    assert talk.put("B", 0x1800, 6, 3) == BUSY
    assert talk.put("H", 0x1800, 5, 10) == 0
    assert talk.put("H", 0x1801, 3, 10) == 0
    assert talk.put("B", 0x1801, 6, 3) == 0


def test_mapping_of_a_valid_pdo_is_not_changed(talk: Conversation) -> None:
    for index in (0x1A00, 0x1600):
        assert talk.put("B", index, 0, 0) == BUSY
        assert talk.put("I", index, 1, 0x20000008) == BUSY
        assert talk.get("B", index, 0) == 2


def test_mapping_entries_only_while_sub_index_0_is_0(talk: Conversation) -> None:
    for index in (0x1A01, 0x1601):
        assert talk.put("I", index, 1, 0x20000008) == BUSY
        assert talk.put("B", index, 0, 0) == 0
        assert talk.put("I", index, 1, 0x20020020) == 0
        assert talk.put("B", index, 0, 1) == 0


@pytest.mark.parametrize(
    ("word", "code"),
    [
        (0x20070010, 0x06040041),  # cannot be mapped
        (0x20000010, 0x06040041),  # one byte, not two
        (0x20020008, 0x06040041),
        (0x20000000, 0x06040041),
        (0x20040008, 0x06040041),  # a string
        (0x12340008, 0x06020000),  # no such object
        (0x20000108, 0x06090011),  # no such sub-index
        (0x200B0320, 0x06090011),
    ],
)
def test_entry_that_cannot_be_mapped(talk: Conversation, word: int, code: int) -> None:
    for index in (0x1A01, 0x1601):
        assert talk.put("B", index, 0, 0) == 0
        assert talk.put("I", index, 1, word) == code
        assert talk.get("I", index, 1) == 0x20000008


def test_dummy_entries_belong_to_rpdos_alone(talk: Conversation) -> None:
    assert talk.put("B", 0x1A01, 0, 0) == talk.put("B", 0x1601, 0, 0) == 0
    for index, bits in ((2, 8), (3, 16), (4, 32), (5, 8), (6, 16), (7, 32)):
        assert talk.put("I", 0x1A01, 1, index << 16 | bits) == 0x06020000
        assert talk.put("I", 0x1601, 1, index << 16 | bits) == 0
        assert talk.put("I", 0x1601, 1, index << 16 | bits ^ 0x18) == 0x06040041


def test_number_and_length_of_mapped_objects_exceed_the_pdo(talk: Conversation) -> None:
    for index in (0x1A01, 0x1601):
        assert talk.put("B", index, 0, 0) == 0
        for sub in (1, 2, 3):
            assert talk.put("I", index, sub, 0x20020020) == 0
        assert talk.put("B", index, 0, 3) == 0x06040042  # 12 bytes
        assert talk.put("B", index, 0, 9) == 0x06040042  # more entries than there are
        assert talk.put("B", index, 0, 255) == 0x06040042
        assert talk.get("B", index, 0) == 0
        assert talk.put("B", index, 0, 2) == 0  # 8 bytes fit


def test_count_over_an_empty_entry_is_refused(talk: Conversation) -> None:
    assert talk.put("B", 0x1A01, 0, 0) == 0
    assert talk.put("B", 0x1A01, 0, 3) == 0x06020000
    assert talk.put("I", 0x1A01, 2, 0) == 0
    assert talk.put("B", 0x1A01, 0, 2) == 0x06020000


@pytest.mark.parametrize(
    ("index", "sub"), [(0x1800, 1), (0x1800, 2), (0x1800, 3), (0x1800, 5), (0x1A01, 0), (0x1A01, 1)]
)
def test_parameter_of_wrong_length(talk: Conversation, index: int, sub: int) -> None:
    data = talk.upload(index, sub)
    assert isinstance(data, bytes)
    assert talk.download(index, sub, data + b"\0") == 0x06070012
    assert talk.download(index, sub, data[:-1]) in (0x06070013,)
    assert talk.upload(index, sub) == data


def test_sub_indices_that_a_pdo_does_not_have(talk: Conversation) -> None:
    assert talk.upload(0x1800, 4) == talk.put("B", 0x1800, 4, 0) == 0x06090011
    assert talk.upload(0x1400, 3) == 0x06090011
    assert talk.put("B", 0x1800, 0, 5) == 0x06010002
    assert talk.upload(0x1A00, 9) == 0x06090011


def test_remapping_takes_effect_with_the_next_sync() -> None:
    talk = operational()
    assert talk.put("I", 0x1800, 1, NO_RTR | 0x185) == 0
    talk.say("> 080#\n< 185#11FEFF")
    talk.say("""
        > 605#23001801850100C0
        < 585#6000180100000000
        > 605#2F001A0000000000
        < 585#60001A0000000000
        > 080#
        > 605#23001A0120000320
        < 585#60001A0100000000
        > 605#23001A0220020B20
        < 585#60001A0200000000
        > 605#2F001A0002000000
        < 585#60001A0000000000
        > 605#2300180185010040
        < 585#6000180100000000
        > 080#
        < 185#0000C03F.FEFFFFFF
    """)


def test_valid_pdo_without_a_mapping_is_not_sent() -> None:
    talk = operational()
    assert talk.put("B", 0x1A00, 0, 0) == 0
    assert talk.put("I", 0x1800, 1, NO_RTR | 0x185) == 0
    talk.say("> 080#")
    assert not talk.device.tpdos.enabled(1)


def test_cob_id_change_takes_effect(talk: Conversation) -> None:
    talk.say("> 000#0105\n> 080#\n< 185#11FEFF")
    talk.put("I", 0x1800, 1, INVALID | NO_RTR | 0x185)
    assert not talk.device.tpdos.enabled(1)
    talk.say("> 080#")
    talk.put("I", 0x1800, 1, NO_RTR | 0x2AA)
    assert talk.device.tpdos.enabled(1)
    talk.say("> 080#\n< 2AA#11FEFF")
