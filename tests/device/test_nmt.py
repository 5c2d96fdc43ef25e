"""NMT slave (CiA 301, 7.2.8): the start by itself, and what the two resets return."""

from device.tiny import Recorder, booted, operational

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
