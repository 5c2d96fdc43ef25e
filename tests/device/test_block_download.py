"""SDO block download (CiA 301, 7.2.4.2.9 to 7.2.4.2.12) byte for byte: losses, resends, time-outs, CRC, lengths."""

import pytest

from device.test_block import DATA, crc
from device.tiny import booted

HALF_US, TIMEOUT_US = 500_000, 1_000_000

BEGIN_DOWNLOAD = "> 605#C605200014000000\n< 585#A40520007F000000\n"
SENT = ["> 605#01.01020304050607\n", "> 605#02.08090A0B0C0D0E\n", "> 605#83.0F1011121314.00\n"]
END = f"> 605#C5{crc(DATA)}0000000000\n"


def test_download() -> None:
    talk = booted()
    talk.say(
        BEGIN_DOWNLOAD + "".join(SENT) + "< 585#A2037F0000000000\n" + END
        + f"< 585#A100000000000000\n+ {2 * TIMEOUT_US}"
    )  # fmt: skip
    assert talk.upload(0x2005) == DATA


def test_download_of_a_fixed_length_without_size_and_crc() -> None:
    talk = booted()
    talk.say("""
        > 605#C006200000000000
        < 585#A40620007F000000
        > 605#01.01020304050607
        > 605#82.08090000000000
        < 585#A2027F0000000000
        > 605#D500000000000000
        < 585#A100000000000000
    """)
    assert talk.upload(0x2006) == bytes(range(1, 10))


def test_download_of_more_than_one_block() -> None:
    data = bytes(k * 3 & 0xFF for k in range(1500))
    parts = [data[k : k + 7] for k in range(0, len(data), 7)]
    talk = booted()
    talk.say("> 605#C6052000DC050000\n< 585#A40520007F000000")
    for k in range(127):
        talk.say(f"> 605#{k + 1:02X}{parts[k].hex()}" + ("\n< 585#A27F7F0000000000" if k == 126 else ""))
    for k in range(127, len(parts)):
        last = k == len(parts) - 1
        command = k - 126 | last << 7
        talk.say(
            f"> 605#{command:02X}{parts[k].ljust(7, bytes(1)).hex()}" + ("\n< 585#A2587F0000000000" if last else "")
        )
    talk.say(f"> 605#{0xC1 | 5 << 2:02X}{crc(data)}0000000000\n< 585#A100000000000000")
    assert talk.upload(0x2005) == data


def test_download_with_a_segment_lost_or_doubled_or_late() -> None:
    """What came in order counts; the client resends the rest, numbered from 1 again."""
    talk = booted()
    talk.say(
        BEGIN_DOWNLOAD + SENT[0] + SENT[0] + SENT[2] + f"""< 585#A2017F0000000000
        > 605#01.08090A0B0C0D0E
        > 605#82.0F1011121314.00
        < 585#A2027F0000000000
        {END}< 585#A100000000000000"""
    )  # fmt: skip
    assert talk.upload(0x2005) == DATA


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


@pytest.mark.parametrize(
    ("size", "segments", "end", "code"),
    [
        ("14", SENT, "C50000", "04000405"),  # CRC
        ("15", SENT, "C5" + crc(DATA), "13000706"),
        ("15", SENT, "E1" + "0000", "01000405"),  # no such subcommand
        ("0C", SENT[:2], "", "12000706"),  # two full segments are 14 bytes, at least 8
        ("14", ["> 605#00.01020304050607\n"], "", "03000405"),
    ],
)
def test_download_that_is_wrong_changes_nothing(size: str, segments: list[str], end: str, code: str) -> None:
    talk = booted()
    said = f"> 605#C6052000{size}000000\n< 585#A40520007F000000\n" + "".join(segments)
    if end:
        said += f"< 585#A2037F0000000000\n> 605#{end}0000000000\n"
    talk.say(said + f"< 585#80052000{code}\n+ {TIMEOUT_US}")
    assert talk.upload(0x2005) == b""


def test_download_that_is_longer_than_it_said() -> None:
    talk = booted()
    talk.say("> 605#C60520000F000000\n< 585#A40520007F000000\n" + "".join(SENT) + "< 585#A2037F0000000000")
    talk.say(f"{END}< 585#8005200012000706")


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("C600200002000000", "12000706"),
        ("C606200008000000", "13000706"),
        ("C609200004000000", "02000106"),  # read-only: said at the initiate
        ("C234120004000000", "00000206"),
        ("C605200001100000", "12000706"),  # more than this server buffers
        ("C705200004000000", "01000405"),  # a subcommand that does not exist here
    ],
)
def test_download_initiate_is_refused(request_: str, code: str) -> None:
    booted().say(f"> 605#{request_}\n< 585#80{request_[2:8]}{code}")


def test_a_value_outside_its_limits_is_refused_at_the_end() -> None:
    talk = booted()
    data = b"\x15\x00"
    talk.say(f"""
        > 605#C607200002000000
        < 585#A40720007F000000
        > 605#81.15000000000000
        < 585#A2017F0000000000
        > 605#D5{crc(data)}0000000000
        < 585#8007200031000906
    """)
    assert talk.get("H", 0x2007) == 15


def test_the_client_gives_a_download_up() -> None:
    talk = booted()
    talk.say(BEGIN_DOWNLOAD + SENT[0] + f"> 605#8005200000000008\n+ {TIMEOUT_US}")
    assert talk.upload(0x2005) == b""


def test_stopped_ends_a_block_transfer() -> None:
    talk = booted()
    talk.say(BEGIN_DOWNLOAD + SENT[0] + f"> 000#0205\n+ {TIMEOUT_US}\n> 000#8005")
    talk.say("> 605#4000200000000000\n< 585#4F00200011000000")


def test_frames_of_other_lengths_are_no_sdo() -> None:
    booted().say(BEGIN_DOWNLOAD + "> 605#01.010203\n" + "".join(SENT) + "< 585#A2037F0000000000")
