"""candump text from a file descriptor: large blocks from a file, each line at once from a live source."""

import os
import select
from collections.abc import Iterator, Sequence

from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump import BadLineError, CandumpParser

CHUNK_BYTES = 1 << 18
_LONGEST_LINE_BYTES = 1 << 16  # a longer line is not text; bounds the memory


def text_blocks(descriptor: int, parser: CandumpParser, timeout_ms: int | None = None) -> Iterator[CandumpBlock]:
    """Yield blocks of frames until the text ends, or until nothing arrives for ``timeout_ms``.

    Raises BadLineError at a bad line if ``parser`` is strict, after the frames before it.
    """
    rest = b""
    while _ready(descriptor, timeout_ms):
        chunk = os.read(descriptor, CHUNK_BYTES)
        if not chunk:
            break
        *lines, rest = (rest + chunk).split(b"\n")
        if len(rest) > _LONGEST_LINE_BYTES:
            lines, rest = [*lines, rest], b""
        yield from _parsed(parser, lines)
    if rest:
        yield from _parsed(parser, [rest])


def _parsed(parser: CandumpParser, lines: Sequence[bytes]) -> Iterator[CandumpBlock]:
    try:
        yield parser.parse([line.decode("utf-8", "replace") for line in lines])
    except BadLineError as error:
        yield error.block
        raise


def _ready(descriptor: int, timeout_ms: int | None) -> bool:
    if timeout_ms is None:
        return True
    return bool(select.select([descriptor], [], [], timeout_ms / 1000)[0])
