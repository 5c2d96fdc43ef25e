"""candump's text read and written: round trips, every kind of bad line, blocks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.host.frames.frame_array import RawFrame, frame_array
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump import CandumpParser
from tipforce.host.logs.candump_format import CandumpFormat, error_text
from tipforce.host.logs.notes import EXPECTED, BadLine, BadLineError
from tools.blocks import block_of_text

STANDARD = st.integers(0, 0x7FF)
EXTENDED = st.integers(0, 0x1FFFFFFF).map(lambda number: number | EXTENDED_FLAG)
ERROR = st.integers(0, 0x1FFFFFFF).map(lambda number: number | ERROR_FLAG)
T_NS = st.integers(0, 9_223_372_036_854_775).map(lambda t_us: t_us * 1000)
DATA_FRAMES = st.tuples(T_NS, st.one_of(STANDARD, EXTENDED, ERROR), st.binary(max_size=8))
REMOTE_FRAMES = st.tuples(
    T_NS, st.one_of(STANDARD, EXTENDED).map(lambda can_id: can_id | REMOTE_FLAG), st.integers(0, 8).map(bytes)
)
ROWS = st.lists(st.tuples(st.one_of(DATA_FRAMES, REMOTE_FRAMES), st.sampled_from(["vcan0", "can10", "c"])), max_size=12)


def block_of(rows: list[tuple[RawFrame, str]]) -> CandumpBlock:
    names = tuple(dict.fromkeys(name for _, name in rows))
    frames = frame_array([frame for frame, _ in rows])
    frames["channel"] = [names.index(name) for _, name in rows]
    return CandumpBlock(frames, names)


@settings(derandomize=True, max_examples=200, deadline=None)
@given(rows=ROWS, log=st.booleans(), extra=st.booleans(), timestamps=st.sampled_from(["", "a"]))
def test_what_is_written_reads_back(rows: list[tuple[RawFrame, str]], log: bool, extra: bool, timestamps: str) -> None:
    block = block_of(rows)
    back = block_of_text("\n".join(CandumpFormat(timestamps, log=log, extra=extra).lines(block)))
    for field in ("can_id", "length", "data"):
        np.testing.assert_array_equal(back.frames[field], block.frames[field])
    assert [back.names[k] for k in back.frames["channel"]] == [name for _, name in rows]
    assert back.timed == (bool(timestamps) or log or not rows)
    np.testing.assert_array_equal(back.frames["t_ns"], block.frames["t_ns"] if back.timed else 0)


BAD = [
    ("hello", "not a candump line"), ("(1700000000.123456) vcan0", "not a candump line"),
    ("  vcan0  181   8  00", "not a candump line"), ("(1700000000.12345) vcan0 181#00", "timestamp"),
    ("(yesterday) vcan0 181#00", "timestamp"), ("(2023-13-01 00:00:00.000000) vcan0 181#00", "timestamp"),
    ("(99999999999.000000) vcan0 181#00", "timestamp"), ("(9223372036.854776) vcan0 181#00", "timestamp"),
    ("(1700000000.123456) vcan0 18#00", "identifier"), ("(1700000000.123456) vcan0 1 81#00", "not a candump line"),
    ("(1700000000.123456) vcan0 800#00", "identifier"), ("(1700000000.123456) vcan0 18G#00", "identifier"),
    ("(1700000000.123456) vcan0 40000000#00", "identifier"), ("(1700000000.123456) vcan0 181#0", "data"),
    ("(1700000000.123456) vcan0 181#0G", "data"), ("(1700000000.123456) vcan0 181#000102030405060708", "length"),
    ("(1700000000.123456) vcan0 181#R9", "length"), ("(1700000000.123456) vcan0 181#RX", "data"),
    ("  vcan0  181   [2]  00", "length"), ("  vcan0  181   [9]  00", "length"), ("  vcan0  181   [1]  0", "data"),
    ("  vcan0  181   [2]  02`01", "data"), ("  vcan0  181   [1]  00000001", "data"),
    ("  vcan0  1811  [1]  00", "identifier"), ("\N{REPLACEMENT CHARACTER}\0", "not a candump line"),
]  # fmt: skip


@pytest.mark.parametrize(("line", "reason"), BAD)
def test_a_bad_line_is_counted_and_strict_says_where_what_and_what_was_expected(line: str, reason: str) -> None:
    good = "(1700000000.123456) vcan0 181#0102\n"
    parser, strict = CandumpParser(), CandumpParser(strict=True)
    assert len(block_of_text(f"{good}{line}\n{good}", parser).frames) == 2
    assert (parser.notes.bad, parser.notes.first_bad) == ({reason: 1}, BadLine(2, line, reason))
    with pytest.raises(BadLineError) as caught:
        block_of_text(f"{good}{line}\n{good}", strict)
    assert str(caught.value) == str(parser.notes.first_bad) == f"line 2: {line!r}: {reason}: {EXPECTED[reason]}"
    assert len(strict.take().frames) == 1


def test_many_bad_lines_are_counted_and_the_first_is_shortened() -> None:
    parser = CandumpParser()
    block_of_text("\n".join(f"bad {k}" * 200 for k in range(1000)), parser)
    assert parser.notes.bad == {"not a candump line": 1000}
    assert len(str(parser.notes.first_bad)) < 300


def test_what_is_no_classic_frame_is_counted() -> None:
    parser = CandumpParser(strict=True)
    lines = [
        "", "(1700000000.123456) vcan0 123##5000102030405060708090A0B",
        "  vcan0  123  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B",
        "  vcan0  123  [08]  00 01 02 03 04 05 06 07",
        "DROPCOUNT: dropped 7 CAN frames on 'vcan0' socket (total drops 9)",
        "DROPCOUNT: dropped 1 CAN frame on 'vcan0' socket (total drops 10)", "\tcontroller-problem{rx-error-warning}",
    ]  # fmt: skip
    assert len(block_of_text("\n".join(lines), parser).frames) == 0
    assert (parser.notes.skipped, parser.notes.bad) == ({"CAN FD frame": 3, "frame dropped by candump": 8}, {})


def test_other_writers_of_the_log_format() -> None:
    lines = [
        "(1700000000.123456789) can0 123#00.11.22",  # nanoseconds; the separators that cansend takes
        "(1700000000.123456) can0 123#1122334455667788_E",  # the raw DLC of can-utils' -8
        "(1700000000.123456) can0 123#aabb R\r",  # python-can
        "(0000000000.000001) can0 123#r",
    ]
    block = block_of_text("\n".join(lines))
    assert block.frames["t_ns"].tolist()[0] == 1700000000_123456789
    assert block.frames["length"].tolist() == [3, 8, 2, 0]
    assert block.frames["data"][2].tolist() == [0xAA, 0xBB, 0, 0, 0, 0, 0, 0]
    assert block.frames["can_id"][3] == 0x123 | REMOTE_FLAG


def test_time_that_goes_back_shows_as_zero_not_as_garbage() -> None:
    block = block_of([((5_000_000_000, 0x181, b""), "c"), ((4_000_000_000, 0x181, b""), "c")])
    for kind in "zd":
        assert CandumpFormat(kind).lines(block)[1].startswith(" (000.000000)  c")


def test_an_error_class_that_candump_does_not_know() -> None:
    assert error_text(ERROR_FLAG | 0x400, b"") == "error class 0x400 is unknown"
    assert error_text(ERROR_FLAG | 8, bytes([0, 0, 1, 0x10])) == "protocol-violation{{single-bit-error}{unspecified}}"
    assert error_text(ERROR_FLAG | 8, bytes([0, 0, 0, 0x20])) == "protocol-violation{{}{}}"
