"""Small services: NMT (CiA 301, 7.2.8), LSS (CiA 305), TIME (CiA 301, 7.2.6)."""

import struct

import pytest

from canopen_device.core import storage
from canopen_device.testing import MemoryStore
from device.tiny import Recorder, booted, operational, serving

ENABLE_TPDO1 = """
    > 605#2300180185010040
    < 585#6000180100000000
"""


def test_reset_communication_returns_only_the_communication_area() -> None:
    recorder = Recorder()
    talk = booted(application=recorder)
    assert talk.put("I", 0x1005, 0, 0x90) == talk.put("H", 0x6000, 0, 7) == talk.put("B", 0x2000, 0, 9) == 0
    talk.say("> 000#8205\n< 705#00")
    assert talk.device.nmt.state == 127
    assert (talk.get("I", 0x1005), talk.get("H", 0x6000), talk.get("B", 0x2000)) == (0x80, 7, 9)
    assert talk.device.requests == [("reset-communication", 0, 0)]
    assert [call for call in recorder.calls if call.startswith("reset")] == ["reset 0"]


def test_reset_node_returns_the_application_area_too() -> None:
    recorder = Recorder()
    talk = booted(application=recorder)
    assert talk.put("I", 0x1005, 0, 0x90) == talk.put("H", 0x6000, 0, 7) == 0
    talk.say("+ 30\n> 000#8100\n< 705#00")
    assert (talk.get("I", 0x1005), talk.get("H", 0x6000)) == (0x80, 100)
    assert talk.device.requests == [("reset-node", 0, 0)]
    assert "reset 30" in recorder.calls


def test_frames_after_a_reset_in_one_step_meet_the_new_state() -> None:
    talk = operational()
    talk.say(ENABLE_TPDO1)
    talk.step([(0, b"\x82\x05"), (0x80, b""), (0, b"\x01\x05"), (0x80, b"")])
    # The reset made TPDO1 invalid again, so the boot-up message is all there is.
    talk.say("< 705#00")
    assert talk.device.nmt.state == 5


CONFIGURE = "> 7E5#0401000000000000\n"


def test_activate_asks_the_loop_for_the_bit_rate() -> None:
    talk = serving()
    talk.say(CONFIGURE + "> 7E5#1300030000000000\n< 7E4#1300000000000000\n> 7E5#1534120000000000")
    assert talk.device.requests == [("bit-rate", 250_000, 0x1234)]


def test_store_and_start_again() -> None:
    store = MemoryStore()
    talk = serving(store=store)
    talk.say(CONFIGURE + "> 7E5#1109000000000000\n< 7E4#1100000000000000")
    store.refuses = True
    talk.say("> 7E5#1700000000000000\n< 7E4#1702000000000000")
    store.refuses = False
    talk.say("> 7E5#1700000000000000\n< 7E4#1700000000000000")
    assert serving(store=store).device.node_id == 9


def test_store_where_nothing_can_be_stored() -> None:
    serving().say(CONFIGURE + "> 7E5#1700000000000000\n< 7E4#1701000000000000")


@pytest.mark.parametrize("content", [b"\x09", b"\x09\x05", b"\x80\x00", b"\x09\x00\x00"])
def test_a_stored_node_id_that_cannot_be_is_passed_over(content: bytes) -> None:
    store = MemoryStore()
    store.groups["lss"] = storage.with_crc(content)
    assert serving(store=store).device.node_id == 5


def test_a_node_that_is_given_255_falls_silent_after_the_reset() -> None:
    talk = serving()
    talk.say(
        CONFIGURE + "> 7E5#11FF000000000000\n< 7E4#1100000000000000\n> 000#8205\n+ 10000000\n> 605#4000100000000000"
    )
    assert talk.device.node_id == 255


DAY_MS = 86_400_000


def test_network_time_is_known_after_a_time_message_and_runs_on() -> None:
    talk = serving()
    assert talk.device.time.unix_ms() is None
    # 1984-01-01 is 5113 days after 1970-01-01; the four highest bits of the milliseconds mean nothing.
    talk.step([(0x100, struct.pack("<IH", 1234 | 0xF << 28, 10))])
    assert talk.device.time.unix_ms() == 5123 * DAY_MS + 1234
    talk.advance(2_500_000)
    assert talk.device.time.unix_ms() == 5123 * DAY_MS + 3734
    talk.say("")


def test_consuming_is_switched_off_and_moved() -> None:
    talk = serving()
    assert talk.put("I", 0x1012, 0, 0x100) == 0
    talk.step([(0x100, bytes(6))])
    assert talk.device.time.unix_ms() is None
    assert talk.put("I", 0x1012, 0, 0x80000300) == 0
    talk.step([(0x300, bytes(6))])
    assert talk.device.time.unix_ms() == 5113 * DAY_MS


def test_it_is_not_heard_in_stopped() -> None:
    talk = serving()
    talk.say("> 000#0205\n> 100#000000000000")
    assert talk.device.time.unix_ms() is None
