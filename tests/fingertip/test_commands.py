"""Commands of a node: tare, self-test, a calibration staged and committed, simulation objects."""

import binascii
import math

import pytest

from canopen_device.testing import MemoryStore
from fingertip.finger import COMMIT, OPEN, PUSH, SAVE, STALE, TARA, ZERO, Finger, finger, forces, matrix, record

REFUSED = 0x08000022
TARE, CLEAR, ZERO_GAUGES = 1, 2, 3
OFFSETS = (12.0, -7.0, 30.0)  # microstrain: 0.34 N of force that is none
SIGNATURE, LOCKED, CRC, VALUE, TOO_HIGH = 0x08000020, 0x08000022, 0x06040043, 0x06090030, 0x06090031
FLAT = [[1e4, 0.0, 0.0], [0.0, 1e4, 0.0], [0.0, 0.0, 1e-1]]  # condition number 1e5
DOUBLED = [[2.0 * value for value in row] for row in matrix()]
WRITES = (("H", 0x2200, 1, 3), ("B", 0x2200, 2, 2), ("f", 0x2200, 3, 7.0), ("f", 0x2201, 1, 5.0), ("f", 0x2201, 2, 9.0),
          ("f", 0x2201, 3, -4.0))  # fmt: skip


def offsets(talk: Finger) -> list[float]:
    return [talk.get("f", 0x6124, sub) for sub in (1, 2, 3)]


def tare(talk: Finger) -> list[float]:
    return [talk.get("f", 0x2111, sub) for sub in (1, 2, 3)] + [talk.get("I", 0x2111, 4)]


def drifted(store: MemoryStore | None = None) -> Finger:
    """A node without load and without calibration whose gauges have drifted off zero."""
    return finger(calibrated=False, offset_microstrain=OFFSETS, store=store)


def test_autozero_adds_to_an_offset_twice_within_one_sample_is_the_same_as_once_and_it_is_stored() -> None:
    store = MemoryStore()
    talk = drifted(store)
    assert talk.put("f", 0x6124, 1, 100.0) == 0
    talk.sync()
    for _ in range(3):
        assert talk.put("I", 0x6125, 1, ZERO) == 0
        assert offsets(talk) == pytest.approx([-12.0, 0.0, 0.0])
    assert talk.put("H", 0x2130, 0, ZERO_GAUGES) == talk.put("H", 0x2130, 0, ZERO_GAUGES) == 0
    assert offsets(talk) == [-OFFSETS[0], -OFFSETS[1], -OFFSETS[2]]
    assert talk.sync().gauges == (0, 0, 0)
    assert talk.put("I", 0x1010, 3, SAVE) == 0
    assert drifted(store).sync().gauges == (0, 0, 0)


def test_autozero_without_sync_looks_at_the_load_of_now() -> None:
    # Nothing was read since the start, or for a long time: the last sample says nothing about the present.
    talk = finger(load=PUSH)
    assert talk.put("I", 0x6125, 1, ZERO) == REFUSED
    talk.source.load = (0.0, 0.0, 0.0)
    talk.sync()
    talk.source.load = PUSH
    talk.advance(200_000)
    assert talk.put("I", 0x6125, 1, ZERO) == REFUSED
    assert [talk.put("H", 0x2130, 0, command) for command in (TARE, ZERO_GAUGES)] == [0, REFUSED]  # hidden by the tare
    assert offsets(talk) == [0.0] * 3


def test_autozero_is_refused_while_any_gauge_is_saturated_and_on_a_stale_sample() -> None:
    # What saturates one gauge is most likely a heavy load, which the others must not be zeroed under.
    talk = finger(calibrated=False, load=(1.0, 0.0, 0.0))
    talk.source.offset_microstrain[1] = 5000.0
    talk.sync()
    for sub in (1, 2, 3):
        assert talk.put("I", 0x6125, sub, ZERO) == REFUSED
    assert offsets(talk) == [0.0] * 3
    talk = drifted()
    talk.sync()
    assert talk.sync(after_us=1).status & STALE
    assert talk.put("I", 0x6125, 1, ZERO) == REFUSED


def test_autozero_that_real32_cannot_hold_is_refused_and_changes_nothing() -> None:
    talk = drifted()
    for index, value in ((0x6121, -3e38), (0x6123, 3e38), (0x6122, 1.0)):
        assert talk.put("f", index, 1, value) == 0
    talk.sync()
    assert talk.put("H", 0x2130, 0, ZERO_GAUGES) == REFUSED
    assert offsets(talk) == [0.0] * 3


@pytest.mark.parametrize("how", ["autotare", "command"])
def test_tare_takes_the_present_force_as_zero(how: str) -> None:
    talk = finger(load=PUSH)
    talk.sync()
    taken = []
    for _ in range(3):  # again within one sample is the same as once
        assert talk.put("I", 0x6139, 4, TARA) == 0 if how == "autotare" else talk.put("H", 0x2130, 0, TARE) == 0
        taken.append(tare(talk))
    assert taken == taken[:1] * 3
    pdos = talk.sync()
    assert pdos.contact[0] == 0
    assert pdos.contact[1:] == (-0x8000, -0x8000)  # no contact, no direction
    assert tare(talk)[:3] == pytest.approx(forces(PUSH), abs=1e-3)
    assert talk.sync().gauges[2] == pytest.approx(-996, abs=1)  # gauges are not tared
    assert talk.put("H", 0x2130, 0, CLEAR) == 0
    assert talk.sync().contact[0] == pytest.approx(1000, abs=1)
    assert tare(talk) == [0.0] * 3 + [0]


def test_tare_after_a_zero_or_a_commit_within_one_sample_uses_what_holds_now() -> None:
    talk = finger(offset_microstrain=(1.0, 2.0, -1.0))  # 24 mN: no contact
    talk.sync()
    assert talk.put("H", 0x2130, 0, ZERO_GAUGES) == talk.put("H", 0x2130, 0, TARE) == 0
    assert talk.sync().contact[0] == 0
    assert tare(talk)[:3] == pytest.approx([0.0] * 3, abs=1e-9)
    talk.source.load = PUSH
    talk.sync()
    talk.stage(record(C=[[3.0 * value for value in row] for row in matrix()]))
    assert talk.commit(COMMIT) == talk.put("H", 0x2130, 0, TARE) == 0
    assert talk.sync().contact[0] == 0


def test_tare_without_sync_uses_the_load_of_now() -> None:
    talk = finger(load=PUSH)
    assert talk.put("H", 0x2130, 0, TARE) == 0
    talk.advance(200_000)
    talk.source.load = (2.0, *PUSH[1:])
    talk.advance(200_000)
    assert talk.put("H", 0x2130, 0, TARE) == 0
    assert math.hypot(tare(talk)[0], tare(talk)[2]) == pytest.approx(2.0, abs=2e-3)


def test_the_age_of_a_tare_and_what_ends_it() -> None:
    talk = finger(load=PUSH, store=MemoryStore())
    talk.sync()
    assert talk.put("H", 0x2130, 0, TARE) == 0
    for seconds in range(4):
        assert tare(talk)[3] == seconds
        talk.advance(1_000_000)
    talk.say("> 000#8205\n< 705#00")  # not a reset of communication
    assert tare(talk)[2] == pytest.approx(-0.996, abs=1e-3)
    talk.stage(record(serial=2))
    assert talk.commit(COMMIT) == 0
    assert tare(talk) == [0.0] * 3 + [0]
    assert talk.put("H", 0x2130, 0, TARE) == talk.put("I", 0x1010, 1, SAVE) == 0
    assert tare(talk)[0] != 0.0
    talk.say("> 000#8105\n< 705#00")  # it is not stored
    assert tare(talk) == [0.0] * 3 + [0]


def test_command_by_rpdo_runs_once_per_reception() -> None:
    talk = finger(load=PUSH)
    assert talk.put("I", 0x1400, 1, 0x205) == 0
    talk.sync()
    talk.say("> 205#0100")
    assert talk.sync().contact[0] == 0
    talk.source.load = (3.0, *PUSH[1:])
    # The value stays in 2130h, but the command does not run again with each SYNC.
    for _ in range(3):
        assert talk.sync().contact[0] == pytest.approx(2000, abs=2)
    talk.say("> 205#0100")
    assert talk.sync().contact[0] == 0
    talk.say("> 205#0200")
    assert talk.sync().contact[0] == pytest.approx(3000, abs=2)
    talk.say("> 205#01\n> 205#\n> 205#0400")
    assert talk.sync().contact[0] == pytest.approx(3000, abs=2)


@pytest.fixture
def talk() -> Finger:
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
    talk.stage(record(validity=(5.0, 20.0, -20.0, -10.0, 0.01), offset_per_K=-1e-6, gain_per_K=-1e-3))
    assert talk.commit() == 0  # coefficients of temperature have either sign


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
    assert talk.sync().contact[0] == pytest.approx(1000, abs=2)
    assert talk.commit() == 0
    assert talk.sync().contact[0] == pytest.approx(2000, abs=4)  # from the next sample on
    assert talk.calibration() == (record(C=DOUBLED), binascii.crc32(record(C=DOUBLED)), 2)


def test_node_never_calibrated_has_zeros() -> None:
    talk = finger(calibrated=False)
    assert talk.calibration() == (bytes(158), 0, 0)
    assert talk.commit() == CRC  # the expected CRC is still 0, that of 158 zero bytes is not
    assert talk.sync().status == 0
    assert talk.get("H", 0x2123) == 0xFFFF
    assert all(math.isnan(talk.get("f", 0x2107, sub)) for sub in (1, 2, 3))


def read(talk: Finger) -> list[float]:
    return [talk.get(kind, index, sub) for kind, index, sub, _value in WRITES]


@pytest.mark.parametrize("load", [(0.0, 0.0, 0.0), PUSH])
def test_reset_node_returns_both_to_power_on(load: tuple[float, float, float]) -> None:
    talk = finger(load=load)
    before = read(talk)
    gauges = talk.sync().gauges
    for write in WRITES:
        assert talk.put(*write) == 0
    assert read(talk) == [value for *_entry, value in WRITES]
    assert talk.sync().gauges[1] == 32767
    talk.nmt(0x82)
    assert read(talk) == [value for *_entry, value in WRITES]
    talk.nmt(0x81)
    assert read(talk) == before
    talk.nmt(1)
    assert talk.sync().gauges == gauges


def test_what_the_program_set_stays() -> None:
    talk = finger()
    assert talk.put("f", 0x2201, 1, 5.0) == talk.put("H", 0x2200, 1, 3) == 0
    talk.source.load = PUSH
    talk.source.set_fault(2, 3, 0.0, talk.now_us)
    talk.nmt(0x81)
    assert talk.source.load == PUSH
    assert (talk.source.fault, talk.source.fault_gauge) == (2, 3)
