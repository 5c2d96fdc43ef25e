"""SDO server (CiA 301, 7.2.4.3): segmented transfers, toggle bit, aborts, time-out."""

import pytest

from device.tiny import booted

TIMEOUT_US = 1_000_000


def test_segmented_upload() -> None:
    talk = booted()
    assert talk.download(0x2005, 0, bytes(range(1, 11))) == 0
    talk.say("""
        > 605#4005200000000000
        < 585#410520000A000000
        > 605#6000000000000000
        < 585#00.01020304050607
        > 605#7000000000000000
        < 585#19.08090A00000000
    """)


def test_segmented_download_with_size_indicated() -> None:
    talk = booted()
    talk.say("""
        > 605#210620000900.0000
        < 585#6006200000000000
        > 605#00.01020304050607
        < 585#2000000000000000
        > 605#1B.0809FFFFFFFFFF
        < 585#3000000000000000
    """)
    assert talk.upload(0x2006) == bytes(range(1, 10))


def test_segmented_download_without_size_indicated() -> None:
    talk = booted()
    talk.say("""
        > 605#2006200000000000
        < 585#6006200000000000
        > 605#00.01020304050607
        < 585#2000000000000000
        > 605#1B.0809FFFFFFFFFF
        < 585#3000000000000000
    """)
    assert talk.upload(0x2006) == bytes(range(1, 10))


@pytest.mark.parametrize("size", [0, 1, 4, 5, 6, 7, 8, 13, 14, 15, 21, 255, 4096])
def test_every_boundary_of_segments_up_and_down(size: int) -> None:
    talk = booted()
    data = bytes(k * 7 & 0xFF for k in range(size))
    assert talk.download(0x2005, 0, data) == 0
    assert talk.upload(0x2005) == data


def test_string_of_no_bytes() -> None:
    booted().say("""
        > 605#4004200000000000
        < 585#4104200000000000
        > 605#6000000000000000
        < 585#0F00000000000000
    """)


def test_one_to_four_bytes_may_come_in_a_segment_as_well() -> None:
    talk = booted()
    talk.say("""
        > 605#2102200004000000
        < 585#6002200000000000
        > 605#07.01020304000000
        < 585#2000000000000000
    """)
    assert talk.upload(0x2002) == bytes((1, 2, 3, 4))


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("2109200004000000", "8009200002000106"),  # read-only: said at the initiate, not after the data
        ("2009200000000000", "8009200002000106"),
        ("2134120004000000", "8034120000000206"),
        ("2106200008000000", "8006200013000706"),  # eight bytes for nine
        ("210620000A000000", "8006200012000706"),
        ("2105200001100000", "8005200012000706"),  # more than this server buffers
        ("21052000FFFFFFFF", "8005200012000706"),
    ],
)
def test_download_initiate_is_refused(request_: str, answer: str) -> None:
    booted().say(f"> 605#{request_}\n< 585#{answer}")


@pytest.mark.parametrize(
    ("size", "segments", "code"),
    [
        # Fewer bytes than indicated, more than indicated, more than the object takes when nothing was indicated.
        ("09000000", ["00.01020304050607", "1D.08000000000000"], "13000706"),
        ("09000000", ["00.01020304050607", "10.08090A0B0C0D0E"], "12000706"),
        (None, ["00.01020304050607", "10.08090A0B0C0D0E"], "12000706"),
        (None, ["00.01020304050607", "1D.08000000000000"], "13000706"),
    ],
)
def test_length_of_data_does_not_match(size: str | None, segments: list[str], code: str) -> None:
    talk = booted()
    before = talk.upload(0x2006)
    talk.say(f"""
        > 605#{"21062000" + size if size else "2006200000000000"}
        < 585#6006200000000000
        > 605#{segments[0]}
        < 585#2000000000000000
        > 605#{segments[1]}
        < 585#80062000{code}
    """)
    assert talk.upload(0x2006) == before


def test_data_without_an_end_is_cut_off() -> None:
    talk = booted()
    talk.say("> 605#2005200000000000\n< 585#6005200000000000")
    toggle = 0
    for _ in range(4096 // 7):
        talk.say(f"> 605#{toggle:02X}01020304050607\n< 585#{0x20 | toggle:02X}00000000000000")
        toggle ^= 0x10
    talk.say(f"> 605#{toggle:02X}01020304050607\n< 585#8005200012000706")


def test_toggle_bit_not_alternated_in_a_download() -> None:
    talk = booted()
    talk.say("""
        > 605#2106200009000000
        < 585#6006200000000000
        > 605#00.01020304050607
        < 585#2000000000000000
        > 605#0B.08090000000000
        < 585#8006200000000305
        > 605#1B.08090000000000
        < 585#8008090001000405  -- the transfer is over: the segment belongs to none
    """)
    assert talk.upload(0x2006) == bytes(9)


def test_toggle_bit_not_alternated_in_an_upload() -> None:
    booted().say("""
        > 605#4006200000000000
        < 585#4106200009000000
        > 605#7000000000000000
        < 585#8006200000000305
    """)


@pytest.mark.parametrize("command", ["E0", "00", "E5"])
def test_unknown_command_ends_an_upload(command: str) -> None:
    booted().say(f"""
        > 605#4006200000000000
        < 585#4106200009000000
        > 605#{command}00000000000000
        < 585#8006200001000405
        > 605#6000000000000000
        < 585#8000000001000405
    """)


def test_upload_segment_request_ends_a_download() -> None:
    booted().say("""
        > 605#2106200009000000
        < 585#6006200000000000
        > 605#6000000000000000
        < 585#8006200001000405
    """)


def test_abort_by_the_client_ends_the_transfer() -> None:
    talk = booted()
    talk.say("""
        > 605#2106200009000000
        < 585#6006200000000000
        > 605#00.01020304050607
        < 585#2000000000000000
        > 605#8006200000000008
        + 5000000
        > 605#1B.08090000000000
        < 585#8008090001000405
    """)
    assert talk.upload(0x2006) == bytes(9)


def test_new_initiate_replaces_the_transfer() -> None:
    talk = booted()
    talk.say("""
        > 605#2106200009000000
        < 585#6006200000000000
        > 605#00.01020304050607
        < 585#2000000000000000
        > 605#2106200009000000
        < 585#6006200000000000
        > 605#00.11121314151617
        < 585#2000000000000000
        > 605#1B.18190000000000
        < 585#3000000000000000
        > 605#4006200000000000
        < 585#4106200009000000
        > 605#4000200000000000
        < 585#4F00200011000000
        + 5000000
    """)
    assert talk.upload(0x2006) == bytes(range(0x11, 0x1A))


@pytest.mark.parametrize("initiate", ["4006200000000000", "2106200009000000"])
def test_silent_client_is_timed_out_once(initiate: str) -> None:
    talk = booted()
    talk.step([(0x605, bytes.fromhex(initiate))])
    talk.take()
    talk.say(f"+ {TIMEOUT_US - 1}\n+ 1\n< 585#8006200000000405\n+ 9000000")


def test_each_segment_starts_the_time_out_anew() -> None:
    booted().say("""
        > 605#2106200009000000
        < 585#6006200000000000
        + 999999
        > 605#00.01020304050607
        < 585#2000000000000000
        + 999999
        > 605#1B.08090000000000
        < 585#3000000000000000
        + 9000000
    """)


def test_an_upload_shows_one_value_although_it_changes_meanwhile() -> None:
    talk = booted()
    assert talk.download(0x2006, 0, bytes(range(9))) == 0
    talk.say("> 605#4006200000000000\n< 585#4106200009000000\n> 605#6000000000000000\n< 585#00.00010203040506")
    talk.device.od.values[0x200600] = bytes((0xFF,)) * 9
    talk.say("> 605#7000000000000000\n< 585#1B.07080000000000")
