"""TIME (CiA 301, 7.2.6): objects 1012h and 1013h."""

import struct

from device.tiny import serving

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
