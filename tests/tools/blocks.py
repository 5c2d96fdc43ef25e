"""Blocks of frames for tests of the log tools: every kind of frame, as candump -L writes it."""

from pathlib import Path

from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump import CandumpParser
from tipforce.host.logs.recorder import open_writer

CONTACTS_LOG = "".join(f"({1700000000 + k / 1000:.6f}) vcan0 285#2E1129239A1103{k:02X}\n" for k in range(50))
"""A contact of node 5 every millisecond."""
MIXED_LOG = """\
(1700000000.000000) vcan0 285#2E1129239A110303
(1700000000.000100) vcan0 285##52E1129239A110303
(1700000000.001000) can1 185#0A0014001E000206
(1700000000.010000) vcan0 080#
(1700000000.010001) vcan0 181#R8
(1700000000.010002) can1 12345678#R
(1700000000.020000) vcan0 20000004#0004000000000000
(1700000000.020001) vcan0 12345678#AB
(1700000000.030000) can1 00000123##0000102030405060708090A0B
"""
MIXED: tuple[tuple[int, str | int], ...] = (
    (0x285, "data"), (0x285, 5), (0x185, "data"), (0x80, "data"), (0x181, "remote"), (0x12345678, "remote"),
    (0x20000004, "error"), (0x12345678, "data"), (0x123, 0),
)  # fmt: skip
"""(identifier, kind) of each line; the kind of a CAN FD frame is its flags."""


def block_of_text(text: str, parser: CandumpParser | None = None) -> CandumpBlock:
    """The frames of candump's text, of less than a full block; by default no line may be bad."""
    parser, content = parser or CandumpParser(strict=True), bytearray(text.encode())
    assert not [*parser.gather(content, 0, len(content))]
    return parser.take()


def written(path: Path, text: str = MIXED_LOG) -> Path:
    """A log of these lines of candump -L, in the format of its suffix."""
    writer = open_writer(path)
    writer.write(block_of_text(text))
    writer.close()
    return path
