"""Commit (2104h) activates the staged record as a whole, or refuses and changes nothing; the write lock (2105h)."""

import binascii

import pytest

from canopen_device.testing import MemoryStore
from fingertip.finger import COMMIT, OPEN, PUSH, SAVE, Finger, finger, matrix, record

SIGNATURE, LOCKED, CRC, VALUE, TOO_HIGH = 0x08000020, 0x08000022, 0x06040043, 0x06090030, 0x06090031
FLAT = [[1e4, 0.0, 0.0], [0.0, 1e4, 0.0], [0.0, 0.0, 1e-1]]  # condition number 1e5
DOUBLED = [[2.0 * value for value in row] for row in matrix()]


@pytest.fixture
def talk() -> Finger:
    """A calibrated node that is pushed with 1 N."""
    return finger(load=PUSH)


def refuse(talk: Finger, code: int, signature: int = COMMIT) -> None:
    """A commit must be refused with ``code``, and leave record, CRC, generation and all values as they are."""
    before = talk.sync()
    active = talk.calibration()
    assert talk.commit(signature) == code
    after = talk.sync()
    assert talk.calibration() == active
    assert after[:3] == before[:3]
    assert after.counter == before.counter + 1


@pytest.mark.parametrize(("factor", "code"), [(9e-4, 0x06090032), (1.1e-3, 0), (9e2, 0), (1.1e3, TOO_HIGH)])
def test_the_size_of_a_matrix_that_a_fingertip_may_have(talk: Finger, factor: float, code: int) -> None:
    # N per microstrain instead of N per unit strain, and the reverse; 1e4 N per unit strain is that of the node.
    talk.stage(record(C=[[factor * value for value in row] for row in matrix()]))
    assert talk.commit() == code


def test_coefficients_of_temperature_have_either_sign(talk: Finger) -> None:
    talk.stage(record(validity=(5.0, 20.0, -20.0, -10.0, 0.01), offset_per_K=-1e-6, gain_per_K=-1e-3))
    assert talk.commit() == 0


def test_order_of_refusals(talk: Finger) -> None:
    # All faults at once; each that is removed uncovers the next.
    bad = record(C=[[float("nan"), 0.0, 0.0], [0.0, 1e4, 0.0], [0.0, 0.0, 1e-1]])
    talk.stage(bad, crc=1)
    assert talk.put("B", 0x2105, 2, 1) == 0
    refuse(talk, SIGNATURE, 0)
    refuse(talk, LOCKED)
    assert talk.put("I", 0x2105, 3, OPEN) == 0
    refuse(talk, CRC)
    assert talk.put("I", 0x2103, 1, binascii.crc32(bad)) == 0
    refuse(talk, VALUE)
    talk.stage(record(C=FLAT))
    refuse(talk, TOO_HIGH)
    talk.stage(record(C=DOUBLED))
    assert talk.commit() == 0
    assert talk.calibration() == (record(C=DOUBLED), binascii.crc32(record(C=DOUBLED)), 2)


def test_commit_acts_from_the_next_sample_on(talk: Finger) -> None:
    assert talk.sync().contact[0] == pytest.approx(1000, abs=2)
    talk.stage(record(C=DOUBLED))
    assert talk.sync().contact[0] == pytest.approx(1000, abs=2)
    assert talk.commit() == 0
    assert talk.sync().contact[0] == pytest.approx(2000, abs=4)


def test_lock_is_not_stored_and_outlasts_a_reset() -> None:
    store = MemoryStore()
    talk = finger(store=store)
    assert talk.put("B", 0x2105, 2, 1) == 0
    assert talk.put("I", 0x1010, 1, SAVE) == 0
    talk.say("> 000#8105\n< 705#00")
    assert talk.get("B", 0x2105, 2) == 1  # until a power cycle
    assert finger(store=store, calibrated=False).get("B", 0x2105, 2) == 0


def test_node_never_calibrated_has_zeros() -> None:
    talk = finger(calibrated=False)
    assert talk.calibration() == (bytes(158), 0, 0)
    assert talk.commit() == CRC  # the expected CRC is still 0, that of 158 zero bytes is not
    assert not talk.sync().status & 0x02
