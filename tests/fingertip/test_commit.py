"""Commit (2104h) activates the staged record as a whole, or refuses and changes nothing; the write lock (2105h)."""

import binascii
import struct
from typing import Any

import pytest

from device.tiny import Memory
from fingertip.finger import COMMIT, OPEN, PUSH, SAVE, Finger, finger, matrix, packing, record

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


@pytest.mark.parametrize("signature", [0, 1, 0x636D6974, COMMIT ^ 0x80])
def test_wrong_signature(talk: Finger, signature: int) -> None:
    talk.stage(record(C=DOUBLED))
    refuse(talk, SIGNATURE, signature)


def test_locked(talk: Finger) -> None:
    talk.stage(record(C=DOUBLED))
    assert talk.put("B", 0x2105, 2, 1) == 0
    refuse(talk, LOCKED)


def test_crc_mismatch(talk: Finger) -> None:
    data = record(C=DOUBLED)
    talk.stage(data, crc=binascii.crc32(data) ^ 1)
    refuse(talk, CRC)


def test_a_single_element_written_after_the_check_is_seen(talk: Finger) -> None:
    # docs/dependencies.md: one wrong element flipped a force's sign for months, because nobody compared.
    talk.stage(record(C=DOUBLED))
    assert talk.put("f", 0x2100, 5, -2e4) == 0
    refuse(talk, CRC)


@pytest.mark.parametrize("field", [*range(12), 14, *range(16, 27), *range(28, 41)])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_value_not_finite(talk: Finger, field: int, value: float) -> None:
    fields = list(struct.unpack(packing(), record(C=DOUBLED)))
    fields[field] = value
    talk.stage(struct.pack(packing(), *fields))
    refuse(talk, VALUE)


def test_condition_number_over_the_limit(talk: Finger) -> None:
    talk.stage(record(C=FLAT))
    refuse(talk, TOO_HIGH)
    assert talk.put("f", 0x2105, 1, 1.1e5) == 0
    assert talk.commit() == 0


def test_singular_matrix(talk: Finger) -> None:
    assert talk.put("f", 0x2105, 1, 1e30) == 0
    talk.stage(record(C=[[1e4, 0.0, 0.0], [0.0, 1e4, 0.0], [0.0, 0.0, 0.0]]))
    refuse(talk, TOO_HIGH)
    talk.stage(record(C=[[0.0] * 3] * 3))
    refuse(talk, TOO_HIGH)


@pytest.mark.parametrize(
    ("factor", "code"), [(1e-6, 0x06090032), (9e-4, 0x06090032), (1.1e3, TOO_HIGH), (1e6, TOO_HIGH)]
)
def test_a_matrix_of_a_size_that_no_fingertip_has(talk: Finger, factor: float, code: int) -> None:
    # N per microstrain instead of N per unit strain, and the reverse; 1e4 N per unit strain is that of the node.
    talk.stage(record(C=[[factor * value for value in row] for row in matrix()]))
    refuse(talk, code)


@pytest.mark.parametrize("factor", [1.1e-3, 9e2])
def test_a_matrix_of_a_size_that_a_fingertip_may_have(talk: Finger, factor: float) -> None:
    talk.stage(record(C=[[factor * value for value in row] for row in matrix()]))
    assert talk.commit() == 0


@pytest.mark.parametrize(
    "validity",
    [
        {"validity": (-1.0, 0.0, 0.0, 0.0, 0.0)},
        {"validity": (0.0, -1.0, 0.0, 0.0, 0.0)},
        {"validity": (0.0, 0.0, 20.0, 19.0, 0.0)},
        {"validity": (0.0, 0.0, 0.0, 0.0, -0.01)},
        {"converter_limit": -1e-3},
        {"redundancy_limit": -1.0},
    ],
)
def test_a_validity_of_wrong_sign_or_order(talk: Finger, validity: dict[str, Any]) -> None:
    talk.stage(record(C=DOUBLED, **validity))
    refuse(talk, VALUE)


def test_coefficients_of_temperature_have_either_sign(talk: Finger) -> None:
    talk.stage(record(validity=(5.0, 20.0, -20.0, -10.0, 0.01), offset_per_K=-1e-6, gain_per_K=-1e-3))
    assert talk.commit() == 0


@pytest.mark.parametrize("tip", [(0.01, 60.0, -60.0, 0.05, 0.02, 0), (0.01, -60.0, 60.0, 0.02, 0.05, 0)])
def test_contact_settings_that_contradict_themselves(talk: Finger, tip: tuple[float, ...]) -> None:
    talk.stage(record(C=DOUBLED, tip=tip))
    refuse(talk, VALUE)


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


def test_lock_refuses_every_staged_write_and_the_limit(talk: Finger) -> None:
    assert talk.put("B", 0x2105, 2, 1) == 0
    assert talk.get("B", 0x2105, 2) == 1
    for kind, index, sub in (("f", 0x2100, 1), ("f", 0x2101, 1), ("I", 0x2102, 1), ("f", 0x2106, 1), ("f", 0x2110, 1)):
        assert talk.put(kind, index, sub, 1) == LOCKED
    assert talk.download(0x2141, 0, record(serial=5)) == LOCKED
    assert talk.put("f", 0x2105, 1, 10.0) == LOCKED
    assert talk.put("B", 0x2105, 2, 0) == LOCKED  # not taken off by a plain write
    assert talk.put("B", 0x2105, 2, 1) == 0
    assert talk.upload(0x2141) == record()
    assert talk.get("f", 0x2105, 1) == 1e4


def test_unlock_needs_its_signature(talk: Finger) -> None:
    assert talk.put("B", 0x2105, 2, 1) == 0
    assert talk.put("I", 0x2105, 3, OPEN + 1) == SIGNATURE
    assert talk.get("B", 0x2105, 2) == 1
    assert talk.put("I", 0x2105, 3, OPEN) == 0
    assert talk.get("B", 0x2105, 2) == 0
    assert talk.put("f", 0x2100, 1, 2.0) == 0
    assert talk.upload(0x2105, 3) == 0x06010001


def test_lock_is_not_stored_and_outlasts_a_reset() -> None:
    store = Memory()
    talk = finger(store=store)
    assert talk.put("B", 0x2105, 2, 1) == 0
    assert talk.put("I", 0x1010, 1, SAVE) == 0
    talk.say("> 000#8105\n< 705#00")
    assert talk.get("B", 0x2105, 2) == 1  # until a power cycle
    assert finger(store=store, calibrated=False).get("B", 0x2105, 2) == 0


@pytest.mark.parametrize(
    ("value", "code"), [(0.5, 0x06090032), (1e31, 0x06090031), (float("nan"), VALUE), (float("inf"), VALUE), (1.0, 0)]
)
def test_condition_limit_has_limits_itself(talk: Finger, value: float, code: int) -> None:
    assert talk.put("f", 0x2105, 1, value) == code


def test_node_never_calibrated_has_zeros() -> None:
    talk = finger(calibrated=False)
    assert talk.calibration() == (bytes(158), 0, 0)
    assert talk.commit() == CRC  # the expected CRC is still 0, that of 158 zero bytes is not
    assert not talk.sync().status & 0x02


C2 = 1e-14


@pytest.mark.parametrize(
    "variance",
    [
        (-C2, 0, 0, C2, 0, C2),
        (C2, 0, 0, C2, 0, -1e-45),
        (C2, 1.1 * C2, 0, C2, 0, C2),
        (0, C2, 0, C2, 0, C2),
        (C2, -0.9 * C2, -0.9 * C2, C2, -0.9 * C2, C2),
    ],
)
def test_noise_that_no_gauges_can_have(talk: Finger, variance: tuple[float, ...]) -> None:
    # A negative variance would give an uncertainty of 0: theta would count as resolved.
    talk.stage(record())
    for sub, value in enumerate(variance, 1):
        assert talk.put("f", 0x2106, sub, value) == 0
    assert talk.put("I", 0x2103, 1, talk.get("I", 0x2103, 2)) == 0
    refuse(talk, VALUE)


@pytest.mark.parametrize("variance", [(0.0,) * 6, (C2,) * 6, (1e-38, 0, 0, 1e-14, 0, 1e30), (C2, -C2, 0, C2, 0, C2)])
def test_noise_at_the_edge_of_what_gauges_can_have(talk: Finger, variance: tuple[float, ...]) -> None:
    talk.stage(record())
    for sub, value in enumerate(variance, 1):
        assert talk.put("f", 0x2106, sub, value) == 0
    assert talk.put("I", 0x2103, 1, talk.get("I", 0x2103, 2)) == 0
    assert talk.commit() == 0
