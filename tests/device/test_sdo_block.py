"""SDO block transfer (CiA 301, 7.2.4.2.9 to 7.2.4.2.16) byte for byte: the CRC, transfers left, time-outs."""

from collections.abc import Callable

import pytest

from canopen_device.core.sdo_block import crc16, crc16_by_nibbles
from canopen_device.testing import Conversation
from device.tiny import Recorder, booted, tiny

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


def test_pst_0_forbids_the_switch_even_for_nothing() -> None:
    loaded(b"").say("> 605#A40520007F000000\n< 585#C605200000000000")


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


HALF_US = 500_000

BEGIN_DOWNLOAD = "> 605#C605200014000000\n< 585#A40520007F000000\n"
SENT = ["> 605#01.01020304050607\n", "> 605#02.08090A0B0C0D0E\n", "> 605#83.0F1011121314.00\n"]
END = f"> 605#C5{crc(DATA)}0000000000\n"


def test_download_whose_last_segment_is_lost() -> None:
    """After half the time-out the server says what it has; the client goes on from there."""
    talk = booted()
    talk.say(
        BEGIN_DOWNLOAD + SENT[0] + SENT[1] + f"""+ {HALF_US - 1}
        + 1
        < 585#A2027F0000000000
        > 605#81.0F1011121314.00
        < 585#A2017F0000000000
        {END}< 585#A100000000000000"""
    )  # fmt: skip
    assert talk.upload(0x2005) == DATA


def test_download_that_stalls_is_aborted() -> None:
    said = f"+ {HALF_US}\n< 585#A2007F0000000000\n+ {HALF_US - 1}\n+ 1\n< 585#8005200000000405\n+ {TIMEOUT_US}"
    booted().say(BEGIN_DOWNLOAD + said)
    booted().say(BEGIN_DOWNLOAD + "".join(SENT) + f"< 585#A2037F0000000000\n+ {HALF_US}\n< 585#8005200000000405")


def test_frames_of_other_lengths_are_no_sdo() -> None:
    booted().say(BEGIN_DOWNLOAD + "> 605#01.010203\n" + "".join(SENT) + "< 585#A2037F0000000000")
