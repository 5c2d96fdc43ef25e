"""SYNC (CiA 301, 7.2.5) and the TPDOs that follow it (7.2.2.2, 7.5.2.35): transmission types, counter, start value."""

import pytest

from device.conversation import Conversation
from device.tiny import Recorder, booted

TPDO1 = "< 185#11FEFF"  # 2000h = 11h and 2001h = -2


def with_tpdo(
    transmission: int = 1, *, overflow: int = 0, start: int = 0, recorder: Recorder | None = None
) -> Conversation:
    """A node in OPERATIONAL whose TPDO1 is valid."""
    talk = booted(application=recorder)
    assert talk.put("B", 0x1019, 0, overflow) == 0
    assert talk.put("B", 0x1800, 6, start) == 0
    assert talk.put("B", 0x1800, 2, transmission) == 0
    assert talk.put("I", 0x1800, 1, 0x40000185) == 0
    talk.say("> 000#0105")
    return talk


def sent_on(talk: Conversation, counters: list[int | None]) -> list[int]:
    """The SYNCs, counted from 1, that TPDO1 went out with; None is a SYNC without counter."""
    due = []
    for number, counter in enumerate(counters, 1):
        if talk.step([(0x80, b"" if counter is None else bytes((counter,)))]):
            due.append(number)
    assert all(frame == (0x185, bytes.fromhex("11FEFF")) for frame in talk.take())
    return due


@pytest.mark.parametrize("transmission", [*range(1, 14), 100, 239, 240])
def test_cyclic_tpdo_goes_out_with_every_nth_sync(transmission: int) -> None:
    talk = with_tpdo(transmission)
    assert sent_on(talk, [None] * (3 * transmission)) == [transmission, 2 * transmission, 3 * transmission]


def test_acyclic_tpdo_goes_out_once_with_the_sync_after_a_request() -> None:
    talk = with_tpdo(0)
    talk.say("> 080#\n> 080#")
    talk.device.tpdos.request(1)
    talk.say(f"+ 1000\n> 080#\n{TPDO1}\n> 080#")
    talk.device.tpdos.request(1)
    talk.device.tpdos.request(1)
    talk.say(f"> 080#\n{TPDO1}\n> 080#")


def test_values_are_those_of_the_sync() -> None:
    talk = with_tpdo()
    talk.say(f"> 080#\n{TPDO1}")
    talk.put("B", 0x2000, 0, 0x99)
    talk.say("> 080#\n< 185#99FEFF")


def test_application_latches_before_the_tpdo_is_packed() -> None:
    recorder = Recorder()
    talk = with_tpdo(recorder=recorder)
    recorder.on_sync = lambda now_us, _number: talk.device.od.values.update({0x200000: now_us})  # type: ignore[method-assign]
    talk.say("+ 66\n> 080#\n< 185#42FEFF\n+ 1\n> 080#\n< 185#43FEFF")


@pytest.mark.parametrize("state", ["80", "02"])
def test_no_tpdo_outside_operational(state: str) -> None:
    talk = with_tpdo()
    talk.say(f"> 000#{state}05\n> 080#\n> 080#\n> 000#0105\n> 080#\n{TPDO1}")


def test_latch_in_pre_operational_none_in_stopped() -> None:
    recorder = Recorder()
    talk = booted(application=recorder)
    talk.say("+ 7\n> 080#\n> 000#0205\n+ 1\n> 080#")
    assert [call for call in recorder.calls if call.startswith("sync")] == ["sync 7"]


@pytest.mark.parametrize("frame", ["080#01", "080#0102", "080#0000000000000000"])
def test_sync_of_wrong_length_is_ignored(frame: str) -> None:
    with_tpdo().say(f"> {frame}\n> 080#\n{TPDO1}")


@pytest.mark.parametrize("frame", ["080#", "080#0102"])
def test_sync_without_its_counter_is_ignored_where_1019h_asks_for_one(frame: str) -> None:
    with_tpdo(overflow=10).say(f"> {frame}\n> 080#07\n{TPDO1}")


def test_sync_remote_or_29_bit_frame_is_none() -> None:
    talk = with_tpdo()
    talk.step([(0x40000080, b""), (0x80000080, b""), (0x20000080, b"")])
    talk.quiet()


def test_sync_start_value_names_the_first_sync() -> None:
    talk = with_tpdo(2, overflow=4, start=3)
    assert sent_on(talk, [1, 2, 3, 4, 1, 2, 3, 4, 1]) == [3, 5, 7, 9]


def test_sync_start_value_with_every_sync() -> None:
    talk = with_tpdo(1, overflow=4, start=4)
    assert sent_on(talk, [1, 2, 3, 4, 1, 2]) == [4, 5, 6]


def test_sync_start_value_zero_does_not_look_at_the_counter() -> None:
    talk = with_tpdo(3, overflow=4)
    assert sent_on(talk, [2, 3, 4, 1, 2, 3]) == [3, 6]


def test_sync_start_value_is_without_meaning_where_sync_has_no_counter() -> None:
    # 7.5.2.37: otherwise a TPDO that waits for a counter would stay silent for ever.
    talk = with_tpdo(2, overflow=0, start=3)
    assert sent_on(talk, [None] * 6) == [2, 4, 6]


@pytest.mark.parametrize(("value", "code"), [(1, 0x06090030), (241, 0x06090031), (255, 0x06090031), (2, 0), (240, 0)])
def test_synchronous_counter_overflow_value(value: int, code: int) -> None:
    talk = booted()
    assert talk.put("B", 0x1019, 0, value) == code


def test_sync_cob_id_changes_at_once() -> None:
    talk = with_tpdo()
    talk.put("I", 0x1005, 0, 0x90)
    talk.say(f"> 080#\n> 090#\n{TPDO1}")


@pytest.mark.parametrize(
    "cob_id",
    [
        0x40000080,  # bit 30: this node would produce SYNC
        0x20000080,  # bit 29: 29-bit identifier
        0x00000880,
        0x000,  # identifiers of NMT, reserved ones, those of the default SDO and of error control
        0x07F,
        0x101,
        0x180,
        0x585,
        0x605,
        0x6E0,
        0x705,
        0x7FF,
    ],
)
def test_sync_cob_id_is_refused(cob_id: int) -> None:
    talk = booted()
    assert talk.put("I", 0x1005, 0, cob_id) == 0x06090030
    assert talk.get("I", 0x1005) == 0x80


def test_two_tpdos_of_one_sync_go_out_in_their_order() -> None:
    talk = with_tpdo()
    talk.put("B", 0x1801, 2, 1)
    talk.put("I", 0x1801, 1, 0x40000285)
    talk.say(f"> 080#\n{TPDO1}\n< 285#11FEFF")


def test_syncs_count_anew_after_a_start_value_change() -> None:
    talk = with_tpdo(3)
    talk.say("> 080#\n> 080#")
    for value, sub, kind in ((0xC0000185, 1, "I"), (0, 6, "B"), (0x40000185, 1, "I")):
        assert talk.put(kind, 0x1800, sub, value) == 0
    assert sent_on(talk, [None] * 3) == [3]
