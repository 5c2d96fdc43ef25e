"""SDO block upload (CiA 301, 7.2.4.2.13 to 7.2.4.2.16) byte for byte: losses, resends, block sizes, CRC, pst."""

from collections.abc import Callable

import pytest

from device.conversation import Conversation
from device.tiny import Recorder, booted, tiny
from tipforce.device.crc16 import crc16, crc16_by_nibbles

TIMEOUT_US = 1_000_000
DATA = bytes(range(1, 21))  # three segments: 7, 7 and 6 bytes


def loaded(data: bytes = DATA) -> Conversation:
    """A node whose DOMAIN 2005h holds ``data``."""
    talk = booted()
    assert talk.download(0x2005, 0, data) == 0
    return talk


def crc(data: bytes) -> str:
    """The CRC as it stands in a frame."""
    return crc16(data).to_bytes(2, "little").hex()


@pytest.mark.parametrize("function", [crc16, crc16_by_nibbles])
def test_crc_of_the_standard(function: Callable[..., int]) -> None:
    assert function(b"123456789") == 0x31C3  # 7.2.4.3.16
    assert function(b"") == 0
    assert function(b"56789", function(b"1234")) == 0x31C3


BEGIN_UPLOAD = "> 605#A40520007F000000\n< 585#C605200014000000\n"  # 20 bytes, with CRC
SEGMENTS = ["< 585#01.01020304050607", "< 585#02.08090A0B0C0D0E", "< 585#83.0F1011121314.00"]
START = "> 605#A300000000000000\n"


def test_upload() -> None:
    loaded().say(
        BEGIN_UPLOAD + START + "\n".join(SEGMENTS)
        + f"\n> 605#A2037F0000000000\n< 585#C5{crc(DATA)}0000000000\n> 605#A100000000000000\n+ {2 * TIMEOUT_US}"
    )  # fmt: skip


def test_upload_in_blocks_of_changing_size() -> None:
    loaded().say(f"""
        > 605#A405200001000000
        < 585#C605200014000000
        > 605#A300000000000000
        < 585#01.01020304050607
        > 605#A201020000000000
        < 585#01.08090A0B0C0D0E
        < 585#82.0F1011121314.00
        > 605#A2027F0000000000
        < 585#C5{crc(DATA)}0000000000
        > 605#A100000000000000
    """)


def test_upload_resends_from_what_was_acknowledged() -> None:
    """The client lost the second of three segments, then all, then heard the rest."""
    loaded().say(
        BEGIN_UPLOAD + START + "\n".join(SEGMENTS) + f"""
        > 605#A2017F0000000000
        < 585#01.08090A0B0C0D0E
        < 585#82.0F1011121314.00
        > 605#A2007F0000000000
        < 585#01.08090A0B0C0D0E
        < 585#82.0F1011121314.00
        > 605#A2027F0000000000
        < 585#C5{crc(DATA)}0000000000
        > 605#A100000000000000
        """
    )  # fmt: skip


@pytest.mark.parametrize("size", [0, 1, 4, 7, 8, 889, 890, 3000])
def test_upload_of_every_length(size: int) -> None:
    data = bytes(k * 5 & 0xFF for k in range(size))
    talk = loaded(data)
    talk.step([(0x605, bytes.fromhex("A40520007F000000"))])
    assert talk.take()[0][1] == b"\xc6\x05\x20\x00" + size.to_bytes(4, "little")
    talk.step([(0x605, b"\xa3" + bytes(7))])
    got = b""
    while (segments := talk.take())[0][1][0] & 0xE3 != 0xC1:
        assert [data[0] & 0x7F for _, data in segments] == list(range(1, len(segments) + 1))
        got += b"".join(data[1:] for _, data in segments)
        talk.step([(0x605, bytes((0xA2, len(segments), 127, 0, 0, 0, 0, 0)))])
    end = segments[0][1]
    got = got[: len(got) - (end[0] >> 2 & 7)]
    assert got == data
    assert int.from_bytes(end[1:3], "little") == crc16(data)


@pytest.mark.parametrize(("pst", "switched"), [(0, False), (19, False), (20, True), (255, True)])
def test_protocol_switch_of_a_short_upload(pst: int, switched: bool) -> None:
    answer = "4105200014000000" if switched else "C605200014000000"
    loaded().say(f"> 605#A40520007F{pst:02X}0000\n< 585#{answer}")


def test_pst_0_forbids_the_switch_even_for_nothing() -> None:
    loaded(b"").say("> 605#A40520007F000000\n< 585#C605200000000000")


def test_protocol_switch_to_an_expedited_answer() -> None:
    booted().say("> 605#A40020007F040000\n< 585#4F00200011000000")


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("A405200000000000", "02000405"),  # no segments in a block
        ("A405200080000000", "02000405"),  # 128 of them
        ("A40820007F000000", "01000106"),  # write-only
        ("A43412007F000000", "00000206"),
        ("A60520007F000000", "01000405"),  # a subcommand that does not exist here
    ],
)
def test_upload_initiate_is_refused(request_: str, code: str) -> None:
    loaded().say(f"> 605#{request_}\n< 585#80{request_[2:8]}{code}")


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        ("A204.7F", "03000405"),  # more segments than were sent
        ("A203.00", "02000405"),
        ("A203.80", "02000405"),
        ("A300.00", "01000405"),  # started already
        ("A100.00", "01000405"),  # the end before the end
    ],
)
def test_a_wrong_acknowledgement_aborts_the_upload(answer: str, code: str) -> None:
    request_ = f"> 605#{answer}0000000000\n< 585#80052000{code}\n+ {TIMEOUT_US}"
    loaded().say(BEGIN_UPLOAD + START + "\n".join(SEGMENTS) + "\n" + request_)


def test_an_acknowledgement_before_the_start_aborts_the_upload() -> None:
    loaded().say(BEGIN_UPLOAD + "> 605#A2037F0000000000\n< 585#8005200001000405")


def test_an_upload_that_the_client_forgets_or_gives_up() -> None:
    loaded().say(BEGIN_UPLOAD + f"+ {TIMEOUT_US - 1}\n+ 1\n< 585#8005200000000405")
    abort = "> 605#8005200000000008\n"
    loaded().say(BEGIN_UPLOAD + START + "\n".join(SEGMENTS) + "\n" + abort + f"+ {TIMEOUT_US}")
    another = "> 605#4000200000000000\n< 585#4F00200011000000\n"
    loaded().say(BEGIN_UPLOAD + START + "\n".join(SEGMENTS) + "\n" + another + f"+ {TIMEOUT_US}")


def test_a_live_value_is_refreshed_before_a_block_upload() -> None:
    recorder = Recorder()
    talk = tiny(application=recorder)
    talk.take()
    talk.say("> 605#A40020007F000000\n< 585#C600200001000000")
    assert recorder.calls == ["reset 0", "refresh 0"]


def test_upload_to_a_client_without_crc() -> None:
    loaded(b"12345").say("""
        > 605#A00520007F000000
        < 585#C605200005000000
        > 605#A300000000000000
        < 585#81.31323334350000
        > 605#A2017F0000000000
        < 585#C900000000000000
        > 605#A100000000000000
    """)
