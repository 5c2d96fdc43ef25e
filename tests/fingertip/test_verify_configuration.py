"""1020h vouches for what boot-up loads: storing anything else clears it, unless it was written after the change."""

import struct

import pytest

from canopen_device.testing import MemoryStore
from fingertip.finger import LOAD, SAVE, ZERO, Finger, finger, matrix, record

NONE: list[float]
OURS: list[float]
NONE, OURS = [0, 0], [15000, 77]
STORE, RESTORE = 0x1010, 0x1011


def verified(talk: Finger) -> list[float]:
    """1020h."""
    return [talk.get("I", 0x1020, sub) for sub in (1, 2)]


def verify(talk: Finger) -> None:
    """Write 1020h."""
    for sub in (1, 2):
        assert talk.put("I", 0x1020, sub, OURS[sub - 1]) == 0


def reset(talk: Finger) -> None:
    """Reset node."""
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
    """A setting of the communication area."""
    assert talk.put("H", 0x1017, 0, 1 + int(talk.get("H", 0x1017))) == 0


def change_mapping(talk: Finger) -> None:
    """A setting of the communication area that takes several writes."""
    assert talk.put("B", 0x1A02, 0, 0) == talk.put("I", 0x1A02, 1, 0x21200008) == talk.put("B", 0x1A02, 0, 1) == 0
    assert talk.put("H", 0x1802, 5, 1 + int(talk.get("H", 0x1802, 5))) == 0


def change_span(talk: Finger) -> None:
    """A setting of the profile area."""
    assert talk.put("f", 0x6149, 4, talk.get("f", 0x6149, 4) - 1.0) == 0


def change_offset(talk: Finger) -> None:
    """One that a command changes."""
    talk.source.offset_microstrain[0] += 0.5
    talk.frames()
    assert talk.put("I", 0x6125, 1, ZERO) == 0


def change_calibration(talk: Finger) -> None:
    """The active record."""
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
