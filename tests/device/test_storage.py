"""Store and restore of parameters (CiA 301, 7.5.2.13 and 7.5.2.14), objects 1010h and 1011h."""

import binascii
import struct

import pytest

from canopen_device.testing import Conversation, MemoryStore
from device.tiny import booted

SAVE, LOAD = 0x65766173, 0x64616F6C
RESET_NODE = "> 000#8105\n< 705#00"
DEFAULTS = (0, 0xC0000185, 100, 0.5)
COMMUNICATION = (500, 0x400001AA, 100, 0.5)


def changed(store: MemoryStore | None) -> Conversation:
    """A node with one setting of each area changed: 1017h, 1800h:1, 6000h, 6001h; and 2000h, which no area holds."""
    talk = booted(store)
    for kind, index, sub, value in (
        ("H", 0x1017, 0, 500), ("I", 0x1800, 1, 0x400001AA), ("H", 0x6000, 0, 7), ("f", 0x6001, 0, 1.25),
        ("B", 0x2000, 0, 9),
    ):  # fmt: skip
        assert talk.put(kind, index, sub, value) == 0
    return talk


def settings(talk: Conversation) -> tuple[float, ...]:
    return (talk.get("H", 0x1017), talk.get("I", 0x1800, 1), talk.get("H", 0x6000), talk.get("f", 0x6001))


def test_a_store_that_refuses_and_none_are_said_to_the_client() -> None:
    refusing = MemoryStore()
    refusing.refuses = True
    for store in (refusing, None):
        talk = changed(store)
        assert talk.put("I", 0x1010, 1, SAVE) == talk.put("I", 0x1011, 1, LOAD) == 0x06060000


def test_defaults_are_not_stored_so_that_cob_ids_follow_a_new_node_id() -> None:
    store = MemoryStore()
    talk = booted(store)
    # Written back as it is: still the default, which is 180h plus the node-id.
    assert talk.put("I", 0x1801, 1, 0xC0000285) == talk.put("H", 0x6000, 0, 7) == 0
    assert talk.put("I", 0x1010, 1, SAVE) == 0
    moved = booted(store, node_id=9)
    assert moved.get("I", 0x1801, 1) == 0xC0000289
    assert moved.get("H", 0x6000) == 7


@pytest.mark.parametrize("damage", ["flip", "cut", "short", "append"])
def test_damaged_group_gives_its_defaults_and_is_noted(damage: str) -> None:
    store = MemoryStore()
    assert changed(store).put("I", 0x1010, 1, SAVE) == 0
    blob = store.groups["application"]
    store.groups["application"] = {
        "flip": blob[:-1] + bytes((blob[-1] ^ 1,)), "cut": blob[:-1], "short": blob[:3], "append": blob + b"\0",
    }[damage]  # fmt: skip
    talk = booted(store)
    assert settings(talk) == COMMUNICATION
    assert talk.device.storage.damaged == ["application"]
    # Restoring the other area does not take the note away, storing anew and a reset do.
    talk.say("> 000#8205\n< 705#00")
    assert talk.device.storage.damaged == ["application"]
    assert talk.put("I", 0x1010, 1, SAVE) == 0
    talk.say(RESET_NODE)
    assert talk.device.storage.damaged == []


def test_every_single_bit_of_damage_is_seen() -> None:
    store = MemoryStore()
    assert changed(store).put("I", 0x1010, 3, SAVE) == 0
    blob = store.groups["application"]
    for bit in range(8 * len(blob)):
        spoilt = bytearray(blob)
        spoilt[bit // 8] ^= 1 << bit % 8
        store.groups["application"] = bytes(spoilt)
        assert settings(booted(store)) == DEFAULTS


def test_records_that_no_longer_fit_the_dictionary_are_passed_over() -> None:
    # A group from other firmware: unknown index, unknown sub-index, another length, outside the limits, read-only.
    records = b"".join(
        struct.pack("<HBH", index, sub, len(data)) + data
        for index, sub, data in (
            (0x6002, 0, b"\1"), (0x6000, 3, b"\1\0"), (0x6000, 0, b"\1"), (0x6001, 0, struct.pack("<f", 9.0)),
            (0x6001, 0, struct.pack("<f", float("nan"))), (0x2000, 0, b"\7"), (0x6000, 0, b"\x2a\0"),
        )
    ) + struct.pack("<HBHH", 0x6001, 0, 4, 0)  # its end is missing  # fmt: skip
    store = MemoryStore()
    store.groups["application"] = struct.pack("<I", binascii.crc32(records)) + records
    talk = booted(store)
    assert settings(talk) == (0, 0xC0000185, 42, 0.5)
    assert talk.get("B", 0x2000) == 0x11
