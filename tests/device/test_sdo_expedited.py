"""SDO server (CiA 301, 7.2.4): expedited transfers and every reason for an abort at the initiate."""

import struct

import pytest

from device.conversation import Conversation
from device.tiny import Recorder, booted


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("4000200000000000", "4F00200011000000"),  # one byte: 3 of 4 unused
        ("4001200000000000", "4B012000FEFF0000"),  # two bytes
        ("4002200000000000", "4302200011223344"),  # four bytes
        ("4003200000000000", "430320000000C03F"),  # REAL32 1.5
        ("400B200100000000", "4F0B2001FF000000"),  # INTEGER8 -1
        ("400B200200000000", "430B2002FEFFFFFF"),  # INTEGER32 -2
        ("400B200000000000", "4F0B200002000000"),  # highest sub-index supported
        ("4000100000000000", "4300100094010200"),  # device type: CiA 404
        ("40002000AABBCCDD", "4F00200011000000"),  # the reserved bytes of a request mean nothing
        ("5F00200000000000", "4F00200011000000"),  # nor do the reserved bits
    ],
)
def test_expedited_upload(request_: str, answer: str) -> None:
    booted().say(f"> 605#{request_}\n< 585#{answer}")


@pytest.mark.parametrize(
    ("request_", "index", "sub", "value"),
    [
        ("2F00200033000000", 0x2000, 0, "33"),
        ("2B01200034120000", 0x2001, 0, "3412"),
        ("2302200001020304", 0x2002, 0, "01020304"),
        ("2303200000000040", 0x2003, 0, "00000040"),
        ("2F0B200180000000", 0x200B, 1, "80"),
        # Size not indicated (s = 0): the object's own length counts.
        ("2200200033FFFFFF", 0x2000, 0, "33"),
        ("220120003412FFFF", 0x2001, 0, "3412"),
        ("2202200001020304", 0x2002, 0, "01020304"),
        # Objects without a length of their own: 1, 2, 3, 4 bytes as indicated, else four.
        ("2F05200001FFFFFF", 0x2005, 0, "01"),
        ("2B0520000102FFFF", 0x2005, 0, "0102"),
        ("27052000010203FF", 0x2005, 0, "010203"),
        ("2305200001020304", 0x2005, 0, "01020304"),
        ("2205200001020304", 0x2005, 0, "01020304"),
        ("2704200061626300", 0x2004, 0, "616263"),
    ],
)
def test_expedited_download(request_: str, index: int, sub: int, value: str) -> None:
    talk = booted()
    multiplexer = request_[2:8]
    talk.say(f"> 605#{request_}\n< 585#60{multiplexer}00000000")
    assert talk.upload(index, sub) == bytes.fromhex(value)


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("4034120000000000", 0x06020000),  # upload: no such object
        ("4000200100000000", 0x06090011),  # no such sub-index of a VAR
        ("400B200300000000", 0x06090011),
        ("4008200000000000", 0x06010001),  # attempt to read a write-only object
        ("2F34120000000000", 0x06020000),  # download: no such object
        ("2F00200100000000", 0x06090011),
        ("2309200000000000", 0x06010002),  # attempt to write a read-only object
        ("2F0B200005000000", 0x06010002),  # a constant is one
        ("2309200900000000", 0x06090011),
        ("2B00200001020000", 0x06070012),  # length too high
        ("2301200001020304", 0x06070012),
        ("2F01200001000000", 0x06070013),  # length too low
        ("2702200001020300", 0x06070013),
        ("2306200001020304", 0x06070013),  # a DOMAIN that takes nine bytes
        ("2206200001020304", 0x06070013),
        ("2B07200015000000", 0x06090031),  # value 21 of 10..20: too high
        ("2B07200009000000", 0x06090032),  # value 9: too low
        ("230320000000C07F", 0x06090030),  # NaN
        ("230320000000807F", 0x06090030),  # infinity
        ("23032000000080FF", 0x06090030),
        ("2F042000FF000000", 0x06090030),  # a VISIBLE_STRING that is no text
        ("E000200000000000", 0x05040001),  # no such command
        ("6000000000000000", 0x05040001),  # a segment outside any transfer
        ("0000000000000000", 0x05040001),
    ],
)
def test_abort_names_object_and_reason(request_: str, code: int) -> None:
    talk = booted()
    multiplexer = request_[2:8]
    talk.say(f"> 605#{request_}\n< 585#80{multiplexer}{struct.pack('<I', code).hex()}")


@pytest.mark.parametrize("value", [10, 20])
def test_limits_themselves_are_allowed(value: int) -> None:
    talk = booted()
    assert talk.put("H", 0x2007, 0, value) == 0
    assert talk.get("H", 0x2007) == value


def test_a_refused_download_changes_nothing() -> None:
    talk = booted()
    for data in ("1500", "0900", "15", "150000"):
        assert talk.download(0x2007, 0, bytes.fromhex(data))
    assert talk.get("H", 0x2007) == 15


@pytest.mark.parametrize("bits", [0x7FC00000, 0x7F800000, 0xFF800000, 0x7F7FFFFF])
def test_staged_real32_takes_what_is_not_finite(bits: int) -> None:
    talk = booted()
    data = struct.pack("<I", bits)
    assert talk.download(0x200A, 0, data) == 0
    assert talk.upload(0x200A) == data


@pytest.mark.parametrize("length", range(8))
def test_frames_of_other_length_than_eight_are_no_sdo(length: int) -> None:
    booted().say(f"> 605#{'4000200000000000'[: 2 * length]}")


def test_request_to_another_node_is_not_answered() -> None:
    booted().say("> 606#4000200000000000\n> 604#4000200000000000\n> 585#4000200000000000")


def test_a_client_abort_outside_a_transfer_is_not_answered() -> None:
    booted().say("> 605#8000200000000408")


def test_application_refreshes_live_values_before_an_upload() -> None:
    recorder = Recorder()
    talk = booted(application=recorder)
    talk.say("+ 40")
    talk.upload(0x2000)
    assert recorder.calls[-1] == "refresh 40"
    refreshes = len(recorder.calls)
    talk.upload(0x2001)
    talk.upload(0x1000)
    assert len(recorder.calls) == refreshes


def test_several_requests_in_one_step_are_answered_in_order() -> None:
    talk = booted()
    frame = bytes.fromhex
    talk.step([(0x605, frame("4000200000000000")), (0x605, frame("4001200000000000"))])
    talk.say("< 585#4F00200011000000\n< 585#4B012000FEFF0000")


def test_integer_range_is_held_when_a_value_from_inside_does_not_fit() -> None:
    talk: Conversation = booted()
    talk.device.od.readers[0x2001] = lambda _sub: 40000
    talk.device.od.readers[0x2003] = lambda _sub: 1e39
    assert talk.get("h", 0x2001) == 32767
    assert talk.get("f", 0x2003) == float("inf")


def test_limit_that_real32_cannot_hold_is_allowed_as_its_nearest_real32() -> None:
    talk = booted()
    talk.device.od.add(0x200C, 0, ("f", "rw", 0, 1.0, 0.1, 1e30))
    for value, code in ((1e30, 0), (1.1e30, 0x06090031), (0.1, 0), (0.0999, 0x06090032)):
        assert talk.put("f", 0x200C, 0, value) == code
