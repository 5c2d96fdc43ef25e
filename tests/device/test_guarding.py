"""Node guarding and life guarding (CiA 301, 7.2.8.3.2.1): objects 100Ch and 100Dh."""

from device.conversation import Conversation
from device.services import serving
from tipforce.device.codes import REMOTE_FLAG

GUARD = (0x705 | REMOTE_FLAG, b"")


def guarded(guard_ms: int = 100, factor: int = 3) -> Conversation:
    """A node with life guarding."""
    talk = serving()
    assert talk.put("H", 0x100C, 0, guard_ms) == talk.put("B", 0x100D, 0, factor) == 0
    return talk


def test_state_and_toggle_bit() -> None:
    talk = serving()
    for answer in ("7F", "FF", "7F"):
        talk.step([GUARD])
        talk.say(f"< 705#{answer}")
    talk.say("> 000#0105")
    talk.step([GUARD])
    talk.say("< 705#85\n> 000#0205")
    talk.step([GUARD])
    talk.say("< 705#04\n> 000#8205\n< 705#00")
    talk.step([GUARD])
    talk.say("< 705#7F\n+ 10000000")


def test_a_heartbeat_excludes_it() -> None:
    talk = guarded()
    talk.step([GUARD])
    talk.say("< 705#7F")
    assert talk.put("H", 0x1017, 0, 500) == 0
    talk.step([GUARD])
    talk.say("+ 499999\n+ 1\n< 705#7F")


def test_life_guarding_misses_the_master() -> None:
    talk = guarded()
    talk.say("> 000#0105\n+ 10000000")
    talk.step([GUARD])
    talk.say("< 705#05\n+ 299999\n+ 1\n< 085#3081110000000000\n+ 10000000")
    talk.step([GUARD])
    talk.say("< 705#FF\n< 085#0000003081000000")  # 1029h: it left OPERATIONAL


def test_life_guarding_that_was_switched_off_misses_nobody() -> None:
    talk = guarded()
    talk.step([GUARD])
    talk.say("< 705#7F")
    assert talk.put("B", 0x100D, 0, 0) == 0
    talk.say("+ 10000000")
