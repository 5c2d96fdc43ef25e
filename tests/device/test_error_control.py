"""NMT, LSS and TIME (CiA 301, CiA 305); heartbeat, node guarding and the heartbeat consumer, byte for byte."""

import struct

import pytest

from canopen_device.core import storage
from canopen_device.core.codes import NEVER_US
from canopen_device.testing import Conversation, MemoryStore
from device.tiny import Recorder, booted, serving

CONFIGURE = "> 7E5#0401000000000000\n"
DAY_MS = 86_400_000


def test_reset_communication_returns_only_the_communication_area() -> None:
    recorder = Recorder()
    talk = booted(application=recorder)
    assert talk.put("I", 0x1005, 0, 0x90) == talk.put("H", 0x6000, 0, 7) == talk.put("B", 0x2000, 0, 9) == 0
    talk.say("> 000#8205\n< 705#00")
    assert talk.device.nmt.state == 127
    assert (talk.get("I", 0x1005), talk.get("H", 0x6000), talk.get("B", 0x2000)) == (0x80, 7, 9)
    assert talk.device.requests == [("reset-communication", 0, 0)]
    assert [call for call in recorder.calls if call.startswith("reset")] == ["reset 0"]
    # A reset of the node returns the application area, too.
    talk.device.requests.clear()
    talk.say("+ 30\n> 000#8100\n< 705#00")
    assert (talk.get("I", 0x1005), talk.get("H", 0x6000)) == (0x80, 100)
    assert talk.device.requests == [("reset-node", 0, 0)]
    assert "reset 30" in recorder.calls


def test_frames_after_a_reset_in_one_step_meet_the_new_state() -> None:
    talk = booted()
    talk.say("> 000#0105")
    assert talk.put("I", 0x1800, 1, 0x40000185) == 0
    talk.step([(0, b"\x82\x05"), (0x80, b""), (0, b"\x01\x05"), (0x80, b"")])
    # The reset made TPDO1 invalid again, so the boot-up message is all there is.
    talk.say("< 705#00")
    assert talk.device.nmt.state == 5


def test_activate_asks_the_loop_for_the_bit_rate() -> None:
    talk = serving()
    talk.say(CONFIGURE + "> 7E5#1300030000000000\n< 7E4#1300000000000000\n> 7E5#1534120000000000")
    assert talk.device.requests == [("bit-rate", 250_000, 0x1234)]


def test_a_selection_may_begin_again() -> None:
    vendor, others = "> 7E5#4011000000000000\n", "> 7E5#4155443322000000\n> 7E5#4202000100000000\n"
    serving().say(2 * vendor + others + "> 7E5#4301000080000000\n< 7E4#4400000000000000")


def test_store_and_start_again() -> None:
    store = MemoryStore()
    talk = serving(store=store)
    talk.say(CONFIGURE + "> 7E5#1109000000000000\n< 7E4#1100000000000000")
    store.refuses = True
    talk.say("> 7E5#1700000000000000\n< 7E4#1702000000000000")
    store.refuses = False
    talk.say("> 7E5#1700000000000000\n< 7E4#1700000000000000")
    assert serving(store=store).device.node_id == 9
    # Where nothing can be stored:
    serving().say(CONFIGURE + "> 7E5#1700000000000000\n< 7E4#1701000000000000")


@pytest.mark.parametrize("content", [b"\x09", b"\x09\x05", b"\x80\x00", b"\x09\x00\x00"])
def test_a_stored_node_id_that_cannot_be_is_passed_over(content: bytes) -> None:
    store = MemoryStore()
    store.groups["lss"] = storage.with_crc(content)
    assert serving(store=store).device.node_id == 5


def test_network_time_is_known_after_a_time_message_in_its_place_and_runs_on() -> None:
    talk = serving()
    talk.say("> 000#0205\n> 100#000000000000\n> 000#8005")  # not heard in STOPPED, nor switched off
    assert talk.put("I", 0x1012, 0, 0x100) == 0
    talk.step([(0x100, bytes(6))])
    assert talk.device.time.unix_ms() is None
    # 1984-01-01 is 5113 days after 1970-01-01; the four highest bits of the milliseconds mean nothing.
    for can_id in (0x300, 0x100):
        assert talk.put("I", 0x1012, 0, 0x80000000 | can_id) == 0
        talk.step([(can_id, struct.pack("<IH", 1234 | 0xF << 28, 10))])
        assert talk.device.time.unix_ms() == 5123 * DAY_MS + 1234
    talk.advance(2_500_000)
    assert talk.device.time.unix_ms() == 5123 * DAY_MS + 3734
    talk.say("")


def test_heartbeats_of_a_process_that_is_late_or_slept() -> None:
    # Each step comes 3 ms late; the hundredth heartbeat is still due at 100 periods.
    talk = booted()
    assert talk.put("H", 0x1017, 0, 10) == 0
    for k in range(1, 101):
        assert talk.due_us == 10_000 * k
        talk.sleep(talk.due_us + 3000 - talk.now_us)
    assert talk.take() == [(0x705, b"\x7f")] * 100
    talk.say("~ 1000000\n< 705#7F\n+ 9999\n+ 1\n< 705#7F")


def test_a_new_time_starts_the_watch_anew() -> None:
    talk = serving()
    assert talk.put("I", 0x1016, 1, 7 << 16 | 100) == 0
    talk.say("> 707#05\n+ 50000")
    assert talk.put("I", 0x1016, 1, 7 << 16 | 200) == 0
    talk.say("+ 10000000\n> 707#05\n+ 199999\n+ 1\n< 085#3081110700000000")


def beating_for_a_second() -> Conversation:
    """A booted node with a heartbeat of 100 ms, one second old."""
    talk = booted()
    talk.sleep(1_000_000)
    assert talk.put("H", 0x1017, 0, 100) == 0
    talk.take()
    return talk


@pytest.mark.parametrize(("times", "back_us"), [(1, 900_000), (1000, 10)])
def test_heartbeats_go_on_at_their_period_when_the_clock_goes_back(times: int, back_us: int) -> None:
    talk = beating_for_a_second()
    for _ in range(times):
        talk.now_us -= back_us
        talk.step()
    assert talk.due_us == talk.now_us + 100_000
    talk.say("+ 99999\n+ 1\n< 705#7F\n+ 100000\n< 705#7F")


def test_own_time_never_falls_and_what_is_never_due_stays_far_away() -> None:
    talk = beating_for_a_second()
    before = talk.device.now_us
    for now_us, own_us in ((5, before), (15, before + 10)):
        talk.now_us = now_us
        talk.step()
        assert talk.device.now_us == own_us
    talk.put("H", 0x1017, 0, 0)
    talk.now_us = 0
    talk.step()
    assert talk.due_us > NEVER_US // 2
