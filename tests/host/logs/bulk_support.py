"""Text for the bulk reader in tests, and the line parser's answer to compare with."""

from dataclasses import dataclass

import numpy as np

from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.logs.candump import BadLineError, CandumpParser, CandumpText


@dataclass(frozen=True)
class Answer:
    """All that a reader says of a text, in a form that compares."""

    frames: list[tuple[int, int, int, bytes, str, int]]
    bad: dict[str, int]
    bad_lines: list[str]
    fd_frames: int
    dropped: int
    timed: bool
    line_number: int
    error: str


def _answer(frames: FrameArray, names: list[str], parser: CandumpParser, timed: bool, error: str) -> Answer:
    rows = [
        (
            int(row["t_ns"]),
            int(row["can_id"]),
            int(row["length"]),
            row["data"].tobytes(),
            names[row["channel"]],
            int(row["flags"]),
        )
        for row in frames
    ]
    assert not frames["spare"].any()
    bad_lines = [str(bad) for bad in parser.bad_lines]
    if error:  # what a reader knows of the lines behind the bad one does not matter
        return Answer(rows, {}, bad_lines, 0, 0, True, 0, error)
    return Answer(rows, parser.bad, bad_lines, parser.fd_frames, parser.dropped, timed, parser.line_number, error)


def line_by_line(text: bytes, *, strict: bool = False, deltas: bool = False) -> Answer:
    """What the line parser says."""
    lines = text.split(b"\n")
    if not lines[-1]:
        lines.pop()
    parser = CandumpParser(strict=strict, deltas=deltas)
    error = ""
    try:
        block = parser.parse([line.decode("utf-8", "replace") for line in lines])
    except BadLineError as caught:
        block, error = caught.block, str(caught)
    return _answer(block.frames, list(block.names), parser, block.timed, error)


def in_bulk(blocks: list[bytes], *, strict: bool = False, deltas: bool = False) -> Answer:
    """What the bulk reader says of a text in blocks of whole lines."""
    parser = CandumpParser(strict=strict, deltas=deltas)
    bulk = CandumpText(parser)
    found: list[FrameArray] = []
    error = ""
    for block in blocks:
        # What stands around a block must not matter: here it looks like more of the same.
        around = b"9999999#" * 32
        text = bytearray(around + block + around)
        try:
            found += bulk.parse(text, len(around), len(around) + len(block))
        except BadLineError as caught:
            error = str(caught)
            break
    frames: FrameArray = np.concatenate([*found, bulk.take()])
    return _answer(frames, list(parser.names), parser, bulk.timed, error)
