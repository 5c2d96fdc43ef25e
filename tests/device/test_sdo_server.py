"""SDO server (CiA 301, 7.2.4): expedited, segmented and block transfers, byte for byte; every abort."""

import struct
from collections.abc import Callable

import pytest

from canopen_device.core.sdo_block import crc16, crc16_by_nibbles
from canopen_device.testing import Conversation
from device.tiny import Recorder, booted

TIMEOUT_US = 1_000_000
DATA = bytes(range(1, 21))  # three segments: 7, 7 and 6 bytes
BEGIN_UPLOAD = "> 605#A40520007F000000\n< 585#C605200014000000\n"  # 20 bytes, with CRC
SEGMENTS = ["< 585#01.01020304050607", "< 585#02.08090A0B0C0D0E", "< 585#83.0F1011121314.00"]
START = "> 605#A300000000000000\n"


@pytest.mark.parametrize(
    ("request_", "index", "sub", "value"),
    [
        ("2F0B200180000000", 0x200B, 1, "80"),
        # Size not indicated (s = 0): the object's own length counts.
        ("2200200033FFFFFF", 0x2000, 0, "33"),
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
        ("2F0B200005000000", 0x06010002),  # a write to a constant
        ("2306200001020304", 0x06070013),  # a DOMAIN that takes nine bytes
        ("2206200001020304", 0x06070013),
        ("2105200001100000", 0x06070012),  # more than this server buffers, by segments and by blocks
        ("21052000FFFFFFFF", 0x06070012),
        ("C605200001100000", 0x06070012),
        ("2B07200015000000", 0x06090031),  # value 21 of 10..20: too high
        ("2B07200009000000", 0x06090032),  # value 9: too low
        ("230320000000C07F", 0x06090030),  # NaN
        ("230320000000807F", 0x06090030),  # infinity
        ("23032000000080FF", 0x06090030),
        ("2F042000FF000000", 0x06090030),  # a VISIBLE_STRING that is no text
    ],
)
def test_abort_names_object_and_reason(request_: str, code: int) -> None:
    talk = booted()
    multiplexer = request_[2:8]
    talk.say(f"> 605#{request_}\n< 585#80{multiplexer}{struct.pack('<I', code).hex()}")


@pytest.mark.parametrize("bits", [0x7FC00000, 0x7F800000, 0xFF800000, 0x7F7FFFFF])
def test_staged_real32_takes_what_is_not_finite(bits: int) -> None:
    talk = booted()
    data = struct.pack("<I", bits)
    assert talk.download(0x200A, 0, data) == 0
    assert talk.upload(0x200A) == data


def test_application_refreshes_live_values_before_an_upload() -> None:
    recorder = Recorder()
    talk = booted(application=recorder)
    talk.say("+ 40")
    talk.upload(0x2000)
    talk.upload(0x2001)
    talk.upload(0x1000)
    talk.say("+ 1\n> 605#A40020007F000000\n< 585#C600200001000000")
    assert recorder.calls == ["reset 0", "refresh 40", "refresh 41"]


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


def test_data_without_an_end_is_cut_off() -> None:
    talk = booted()
    talk.say("> 605#2005200000000000\n< 585#6005200000000000")
    toggle = 0
    for _ in range(4096 // 7):
        talk.say(f"> 605#{toggle:02X}01020304050607\n< 585#{0x20 | toggle:02X}00000000000000")
        toggle ^= 0x10
    talk.say(f"> 605#{toggle:02X}01020304050607\n< 585#8005200012000706")


@pytest.mark.parametrize("initiate", ["4006200000000000", "2106200009000000"])
def test_silent_client_is_timed_out_once(initiate: str) -> None:
    talk = booted()
    talk.step([(0x605, bytes.fromhex(initiate))])
    talk.take()
    talk.say(f"+ {TIMEOUT_US - 1}\n+ 1\n< 585#8006200000000405\n+ 9000000")


def test_an_upload_shows_one_value_although_it_changes_meanwhile() -> None:
    talk = booted()
    assert talk.download(0x2006, 0, bytes(range(9))) == 0
    talk.say("> 605#4006200000000000\n< 585#4106200009000000\n> 605#6000000000000000\n< 585#00.00010203040506")
    talk.device.od.values[0x200600] = bytes((0xFF,)) * 9
    talk.say("> 605#7000000000000000\n< 585#1B.07080000000000")


def loaded(data: bytes = DATA) -> Conversation:
    talk = booted()
    assert talk.download(0x2005, 0, data) == 0
    return talk


def crc(data: bytes) -> str:
    return crc16(data).to_bytes(2, "little").hex()


@pytest.mark.parametrize("function", [crc16, crc16_by_nibbles])
def test_crc_of_the_standard(function: Callable[..., int]) -> None:
    assert function(b"123456789") == 0x31C3  # 7.2.4.3.16
    assert function(b"") == 0
    assert function(b"56789", function(b"1234")) == 0x31C3


def test_block_uploads_of_nothing_without_a_switch_and_that_the_client_forgets_or_gives_up() -> None:
    nothing = "< 585#8100000000000000\n"  # one segment without bytes, which comes again when it was lost
    again = "> 605#A2007F0000000000\n" + nothing + "> 605#A2017F0000000000\n< 585#DD00000000000000"
    loaded(b"").say("> 605#A40520007F000000\n< 585#C605200000000000\n> 605#A300000000000000\n" + nothing + again)
    loaded().say(BEGIN_UPLOAD + f"+ {TIMEOUT_US - 1}\n+ 1\n< 585#8005200000000405")
    abort = "> 605#8005200000000008\n"
    loaded().say(BEGIN_UPLOAD + START + "\n".join(SEGMENTS) + "\n" + abort + f"+ {TIMEOUT_US}")
    another = "> 605#4000200000000000\n< 585#4F00200011000000\n"
    loaded().say(BEGIN_UPLOAD + START + "\n".join(SEGMENTS) + "\n" + another + f"+ {TIMEOUT_US}")


HALF_US = 500_000

BEGIN_DOWNLOAD = "> 605#C605200014000000\n< 585#A40520007F000000\n"
SENT = ["> 605#01.01020304050607\n", "> 605#02.08090A0B0C0D0E\n", "> 605#83.0F1011121314.00\n"]
END = f"> 605#C5{crc(DATA)}0000000000\n"


READ = "> 605#4000100000000000\n"  # of a client that knows nothing of the download: it ends for all that
STALLED = f"+ {HALF_US}\n< 585#A2007F0000000000\n+ {HALF_US - 1}\n+ 1\n< 585#8005200000000405\n+ {TIMEOUT_US}"


@pytest.mark.parametrize(
    "script",
    [
        "> 605#4004200000000000\n< 585#4104200000000000\n> 605#6000000000000000\n< 585#0F00000000000000",  # no bytes
        BEGIN_DOWNLOAD + STALLED,
        BEGIN_DOWNLOAD + f"{READ}{READ}+ 300000\n{READ}+ 200000\n< 585#A2007F0000000000\n{READ}+ 300000\n{READ}"
        "+ 200000\n< 585#8005200000000405\n" + READ + "< 585#4300100094010200",
        BEGIN_DOWNLOAD + "".join(SENT) + f"< 585#A2037F0000000000\n+ {HALF_US}\n< 585#8005200000000405",
        BEGIN_DOWNLOAD + "> 605#01.010203\n" + "".join(SENT) + "< 585#A2037F0000000000",  # a frame that is no SDO
    ],
)
def test_an_empty_string_a_download_that_stalls_and_a_frame_of_another_length(script: str) -> None:
    booted().say(script)
