"""NMT slave (CiA 301, 7.2.8): boot-up, state transitions, what each state allows, and the two resets."""

import pytest

from device.conversation import Conversation
from device.tiny import Memory, Recorder, booted, operational, tiny

READ_2000 = "> 605#4000200000000000"
SDO_ANSWER = "< 585#4F00200011000000"
ENABLE_TPDO1 = """
    > 605#2300180185010040
    < 585#6000180100000000
"""
TPDO1 = "< 185#11FEFF"


def listens_to_sdo(talk: Conversation) -> bool:
    """Whether the node answers an SDO request now."""
    talk.quiet()
    answered = bool(talk.step([(0x605, bytes.fromhex("4000200000000000"))]))
    talk.take()
    return answered


def sends_pdo(talk: Conversation) -> bool:
    """Whether a SYNC makes the node send its TPDO1."""
    talk.quiet()
    sent = bool(talk.step([(0x080, b"")]))
    talk.take()
    return sent


def test_boot_up_message_then_pre_operational() -> None:
    talk = tiny()
    talk.say("< 705#00")
    assert talk.device.nmt.state == 127
    talk.say(f"{READ_2000}\n{SDO_ANSWER}\n> 080#")


def test_boot_up_message_carries_the_node_id() -> None:
    talk = tiny(node_id=0x7)
    talk.say("< 707#00")


@pytest.mark.parametrize(
    ("path", "state"),
    [
        ("01", 5),
        ("02", 4),
        ("80", 127),
        ("01 80", 127),
        ("01 02", 4),
        ("01 02 80", 127),
        ("01 02 01", 5),
        ("02 01", 5),
        ("02 80", 127),
        ("01 80 01", 5),
        ("01 01", 5),
    ],
)
@pytest.mark.parametrize("target", ["00", "05"])
def test_state_transitions_by_command_specifier(path: str, state: int, target: str) -> None:
    talk = booted()
    for command in path.split():
        talk.say(f"> 000#{command}{target}")
    assert talk.device.nmt.state == state


def test_communication_allowed_in_each_state() -> None:
    # CiA 301, 7.3.2.3: SDO in PRE-OPERATIONAL and OPERATIONAL, PDO in OPERATIONAL alone, neither in STOPPED.
    talk = booted()
    talk.say(ENABLE_TPDO1)
    assert (listens_to_sdo(talk), sends_pdo(talk)) == (True, False)
    talk.say("> 000#0105")
    assert (listens_to_sdo(talk), sends_pdo(talk)) == (True, True)
    talk.say("> 000#0205")
    assert (listens_to_sdo(talk), sends_pdo(talk)) == (False, False)
    talk.say("> 000#8005")
    assert (listens_to_sdo(talk), sends_pdo(talk)) == (True, False)


@pytest.mark.parametrize(
    "frame",
    [
        "000#0106",  # another node
        "000#01",  # too short
        "000#010500",  # too long
        "000#",
        "000#0305",  # no such command specifier
        "000#FF05",
        "000#0005",
    ],
)
def test_nmt_frame_of_other_shape_or_for_another_node_is_ignored(frame: str) -> None:
    talk = booted()
    talk.say(f"> {frame}")
    assert talk.device.nmt.state == 127


@pytest.mark.parametrize("flag", [0x80000000, 0x40000000, 0x20000000])
def test_extended_remote_and_error_frames_are_no_nmt_commands(flag: int) -> None:
    talk = booted()
    talk.step([(flag, b"\x01\x05"), (flag | 0x605, bytes.fromhex("4000200000000000"))])
    talk.quiet()
    assert talk.device.nmt.state == 127


def test_self_starting_node_enters_operational_after_boot_up() -> None:
    # 1F80h with bit 2 clear (CiA 302-2), stored, so that it holds at the next start.
    store = Memory()
    talk = booted(store)
    talk.say("""
        > 605#23801F0000000000
        < 585#60801F0000000000
        > 605#2310100273617665
        < 585#6010100200000000
    """)
    again = booted(store)
    assert again.device.nmt.state == 5


@pytest.mark.parametrize("value", [0x1, 0x5, 0x2, 0x8, 0x80000000])
def test_nmt_startup_refuses_the_master_and_all_else_but_bit_2(value: int) -> None:
    talk = booted()
    assert talk.put("I", 0x1F80, 0, value) == 0x06090030
    assert talk.get("I", 0x1F80) == 4


def test_stop_during_a_transfer_ends_it_without_a_word() -> None:
    talk = operational()
    talk.say("""
        > 605#4006200000000000
        < 585#4106200009000000
        > 000#0205
        + 2000000
        > 605#6000000000000000
        > 000#0105
    """)
    # The segment that comes late belongs to no transfer any more.
    talk.step([(0x605, bytes.fromhex("6000000000000000"))])
    assert talk.take()[0][1][4:] == bytes.fromhex("01000405")


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


def test_nothing_is_sent_before_the_boot_up_message() -> None:
    # Frames that come with the very first step are taken after the boot-up.
    device = tiny().device
    fresh = type(device)(device.od)
    sent, _ = fresh.step(0, [(0x605, bytes.fromhex("4000200000000000"))])
    assert [can_id for can_id, _ in sent] == [0x705, 0x585]
