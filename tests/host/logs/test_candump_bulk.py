"""The reader of candump's text, with the compiled core, against the line parser alone: good and broken lines."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_device.core.codes import EXTENDED_FLAG
from tipforce.core import core
from tipforce.host.frames.frame_array import FRAME, FrameArray
from tipforce.host.frames.frame_block import CandumpBlock, FdFrame
from tipforce.host.logs.candump import CandumpParser
from tipforce.host.logs.candump_format import CandumpFormat
from tipforce.host.logs.notes import BadLineError, LogNotes


class Answer(NamedTuple):
    """All that a reader says of a text, in a form that compares: the rows of the frames, the notes, the error."""

    frames: list[tuple[Any, ...]]
    notes: LogNotes
    error: str


def _answer(frames: FrameArray, timed: bool, parser: CandumpParser, error: str) -> Answer:
    notes = parser.notes
    notes.timed = timed
    rows = [(*row.tolist()[:3], row["data"].tobytes(), notes.channels[row["channel"]], row["flags"]) for row in frames]
    assert not frames["spare"].any()
    if error:  # what a reader knows of the lines behind the bad one does not matter
        notes = LogNotes(first_bad=notes.first_bad)
    return Answer(rows, notes, error)


def line_by_line(text: bytes, *, strict: bool = False, deltas: bool = False) -> Answer:
    frames, timed, error = bytearray(), True, ""
    parser = CandumpParser(strict=strict, deltas=deltas)
    for line in text.removesuffix(b"\n").split(b"\n") if text else ():
        try:
            frame = parser.frame(line.decode("utf-8", "replace"))
        except BadLineError as caught:
            error = str(caught)
            break
        if isinstance(frame, FdFrame):
            timed &= frame.t_ns >= 0
        elif frame is not None:
            frames += frame[0]
            timed &= frame[1]
    return _answer(np.frombuffer(frames, FRAME), timed, parser, error)


def in_bulk(blocks: list[bytes], *, strict: bool = False, deltas: bool = False) -> Answer:
    """What the bulk reader says of a text in blocks of whole lines."""
    parser, frames, error = CandumpParser(strict=strict, deltas=deltas), list[FrameArray](), ""
    for block in blocks:
        # What stands around a block must not matter: here it looks like more of the same.
        around = b"9999999#" * 32
        text = bytearray(around + block + around)
        try:
            frames += [full.frames for full in parser.gather(text, len(around), len(around) + len(block))]
        except BadLineError as caught:
            error = str(caught)
            break
    return _answer(np.concatenate([*frames, parser.take().frames]), parser.notes.timed, parser, error)


needs_core = pytest.mark.skipif(core is None, reason="needs the compiled core")
HEX = "0123456789ABCDEF"


def mostly(good: list[str], odd: list[str]) -> st.SearchStrategy[str]:
    """Good ones nine times out of ten: a line has many parts."""
    return st.integers(0, 9).flatmap(lambda number: st.sampled_from(odd if number == 9 else good))


NAMES = mostly(["can0", "vcan1", "a", "can_long_name15", "can0.5"], ["0can", "c#n", "x-y:z", "ä", "(c)", "RX"])
SECONDS = mostly(["1700000000", "1700000001", "0000000000", "003"], ["7", "9223372036", "9223372037", "9999999999"])
FRACTIONS = mostly(["000000", "123456", "999999", "123456789"], ["000000001", "854775807", "12345", "1234567"])
DATES = mostly(["2026-11-21 09:56:39", "2026-11-21 09:56:40"], ["1999-02-29 00:00:00", "2026-11-21 09:56:4a"])
STANDARD = st.integers(0, 0x7FF).map("{:03X}".format)
EXTENDED = st.integers(0, 0x1FFFFFFF).map("{:08X}".format)
ERROR = st.integers(0x20000000, 0x200003FF).map("{:08X}".format)
ODD_ID = st.sampled_from(
    ["800", "FFF", "40000000", "60000001", "18", "1811", "18G", "abc", "7ff", "0000018a", "", "@@@"]
)
IDS = st.integers(0, 9).flatmap(lambda number: [STANDARD, EXTENDED, ERROR, ODD_ID][max(number - 6, 0)])
DATA = st.binary(max_size=8)


@st.composite
def stamps(draw: st.DrawFn) -> str:
    whole = draw(st.integers(0, 3).flatmap(lambda number: DATES if number == 3 else SECONDS))
    return f"({whole}.{draw(FRACTIONS)})" if len(whole) < 19 else f"({whole}.{draw(FRACTIONS)[:6]})"


@st.composite
def log_lines(draw: st.DrawFn) -> str:
    data = draw(DATA).hex()
    odd = [
        data, "R", "R8", "r3", "R9", "##1" + data, data + "0", "00" * 9, data + "_F", data[:-1] + "G", "@" * 16, "  ",
        ".".join(data[k : k + 2] for k in range(0, len(data), 2)),
    ]  # fmt: skip
    payload = draw(mostly([data.upper()], odd))
    spaces = draw(mostly([" "], ["  ", "\t", ""]))
    way = draw(mostly([""], [" R", " T", "  T", " X", " ", "R"]))
    return f"{draw(stamps())}{spaces}{draw(NAMES)} {draw(IDS)}#{payload}{way}"


@st.composite
def screen_lines(draw: st.DrawFn) -> str:
    stamp = draw(st.one_of(st.just(""), stamps().map(lambda text: f" {text}")))
    way = draw(mostly(["", "  RX - -", "  TX - -"], ["  TX B E", "  TX X -"]))
    data = draw(DATA)
    length = draw(mostly([str(len(data))], ["0", "9", "08", "x"]))
    text = data.hex(" ").upper()
    odd = [
        text, "  " + text, " " + text.lower(), " " + text.replace(" ", "-"), " remote request",
        " " + text.ljust(26) + "ERRORFRAME", " " + text + "   '..A'", " " + text + " R",
    ]  # fmt: skip
    payload = draw(mostly([" " + text], odd))
    indent = draw(st.sampled_from(["  ", "       "]))
    return f"{stamp}  {draw(NAMES)}{way}{indent}{draw(IDS)}   [{length}] {payload}"


JUNK = st.one_of(
    st.text(alphabet="()[]# .:0123456789ABCDEFabcdefRTX-\t\x00é", max_size=60),
    st.sampled_from(["", "\t", "\tcontroller-problem{}", "DROPCOUNT: dropped 7 CAN frames on 'c' socket", "\x1b[31m"]),
)
LINES = st.integers(0, 9).flatmap(lambda number: [log_lines(), screen_lines(), JUNK][max(number // 4, 0)])


@st.composite
def texts(draw: st.DrawFn) -> list[bytes]:
    """Blocks of whole lines: some kinds of lines, repeated with other digits, and broken here and there."""
    kinds = draw(st.lists(LINES, min_size=1, max_size=6))
    rows = draw(st.lists(st.integers(0, len(kinds) - 1), min_size=1, max_size=24))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lines = [_changed(kinds[row], random) for row in rows]
    line_end = draw(st.sampled_from([b"\n", b"\n", b"\r\n"]))
    cut = draw(st.integers(0, len(lines)))
    blocks = [b"".join(line + line_end for line in part) for part in (lines[:cut], lines[cut:]) if part]
    if draw(st.booleans()):
        blocks[-1] = blocks[-1].removesuffix(line_end) or b"x"
    return blocks


def _changed(line: str, random: np.random.Generator) -> bytes:
    text = bytearray(line.encode())
    digits = [place for place, byte in enumerate(text) if chr(byte) in HEX]
    for place in random.permutation(digits)[: random.integers(0, 6)]:
        text[place] = ord(HEX[random.integers(0, 10 if random.random() < 0.8 else 16)])
    if text and random.random() < 0.03:
        text[random.integers(0, len(text))] = random.choice([0, 32, 35, 58, 64, 71, 0x80, 0xB5, 0xFF])
    return bytes(text)


@given(texts(), st.booleans(), st.booleans())
def test_bulk_says_what_the_line_parser_says(blocks: list[bytes], strict: bool, deltas: bool) -> None:
    assert in_bulk(blocks, strict=strict, deltas=deltas) == line_by_line(b"".join(blocks), strict=strict, deltas=deltas)


def block_of_traffic(count: int = 500) -> CandumpBlock:
    """Data frames of two interfaces, with 11 and 29 bits and every length."""
    random = np.random.default_rng(11)
    frames: FrameArray = np.zeros(count, dtype=FRAME)
    frames["t_ns"] = (1_700_000_000_000_000 + np.cumsum(random.integers(0, 500_000, count))) * 1000
    extended = random.random(count) < 0.3
    frames["can_id"] = np.where(
        extended, random.integers(0, 1 << 29, count) | EXTENDED_FLAG, random.integers(0, 0x800, count)
    )
    frames["length"] = random.integers(0, 9, count)
    frames["data"] = random.integers(0, 256, (count, 8)) * (np.arange(8) < frames["length"][:, None])
    frames["channel"] = random.integers(0, 2, count)
    frames["flags"] = random.integers(0, 2, count)
    return CandumpBlock(frames, ("can0", "vcan12"))


FORMATS = [
    *({"timestamps": kind, "extra": extra} for kind in ("", *"azdA") for extra in (False, True)),
    {"log": True},
    {"log": True, "extra": True},
]


def lines_seen(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of the lines that the line parser gets from now on."""
    seen: list[int] = []
    frame = CandumpParser.frame

    def noted(parser: CandumpParser, line: str) -> Any:
        seen.append(parser.notes.lines + 1)
        return frame(parser, line)

    monkeypatch.setattr(CandumpParser, "frame", noted)
    return seen


@needs_core
@pytest.mark.parametrize("options", FORMATS, ids=str)
@pytest.mark.parametrize("line_end", [b"\n", b"\r\n"], ids=["LF", "CRLF"])
def test_data_frames_of_every_format_are_taken_in_bulk(
    options: dict[str, Any], line_end: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    block = block_of_traffic()
    lines = CandumpFormat(**options).lines(block)
    expected = line_by_line("\n".join(lines).encode())
    assert len(expected.frames) == len(lines)

    seen = lines_seen(monkeypatch)
    text = b"".join(line.encode() + line_end for line in lines)
    found = in_bulk([text])
    assert found == expected
    dates = {row[0] // 10**9 for row in found.frames} if options.get("timestamps") == "A" else set()
    assert len(seen) <= 2 + len(dates)  # the first of each interface, and of each second's date


@needs_core
def test_nanoseconds_and_lower_case_are_taken_in_bulk(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [f"(1700000{k:03d}.{k * 7919 % 1_000_000_000:09d}) can0 {k:03x}#{k * 0xABCDEF:012x}" for k in range(300)]
    expected = line_by_line("\n".join(lines).encode())
    seen = lines_seen(monkeypatch)
    assert in_bulk(["".join(line + "\n" for line in lines).encode()]) == expected
    assert seen == [1]


@pytest.mark.parametrize("character", [chr(code) for code in (*range(0x20, 0x30), *range(0x3A, 0x40), 0x70, 0xB0)])
def test_a_fraction_has_digits_only(character: str) -> None:
    """All six are read at a time: what is near the digits, or has their lowest bits, is none, wherever it is."""
    for place in range(6):
        fraction = "123456"[:place] + character + "123456"[place + 1 :]
        text = f"(1700000000.000001) can0 181#\n(1700000000.{fraction}) can0 181#07\n".encode()
        assert in_bulk([text]) == line_by_line(text)
        assert sum(in_bulk([text]).notes.bad.values()) == 1


def test_many_shapes_of_lines() -> None:
    text = "".join(f"(1700000000.{k:06d}) {'n' * (k % 15 + 1)}{k % 10} {k:03X}#{k:02X}\n" for k in range(256)).encode()
    assert in_bulk([text]) == line_by_line(text)


def test_lines_that_only_look_as_long_as_the_first() -> None:
    line = b"(1700000000.000000) can0 181#0102030405060708\n"
    # Two lines in the room of one, a line end where data should be, and one line over two rooms.
    halves = b"(1700000000.000000) a 12#\n" + b"x" * (len(line) - 27) + b"\n"
    broken = line[:35] + b"\n" + line[36:]
    double = line[:-1] + b"0" + line[1:]
    for text in (line * 5 + part + line * 5 for part in (halves, broken, double)):
        assert in_bulk([text]) == line_by_line(text)
        assert len(in_bulk([text]).frames) >= 10
