"""Read a log of any format as blocks with every kind of frame: classic, remote, error and CAN FD frames."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from tipforce.errors import InputError, TipforceError
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump import BadLineError, CandumpParser
from tipforce.host.logs.lines import open_file
from tipforce.host.logs.unpacking import decompressed
from tipforce_tools.dump.text_source import text_blocks

STDIN = "-"
_CHUNK_BYTES = 1 << 18
_BLOCK_FRAMES = 4096
_TEXT_SUFFIXES = {"", ".log", ".txt"}  # python-can's reader of .log supports neither error frames nor CAN FD flags


def log_blocks(name: str, parser: CandumpParser) -> Iterator[CandumpBlock]:
    """Yield the frames of a log in bounded memory: candump text (also .gz and .zst), or a format of python-can.

    ``parser`` counts the bad lines of text; if it is strict, BadLineError is raised at the first, after the frames
    before it. Raises InputError for a file that cannot be read.
    """
    if name == STDIN:
        return text_blocks(sys.stdin.fileno(), parser)
    path = Path(name)
    if _format(path) in _TEXT_SUFFIXES:
        return _text_blocks(path, parser)
    return _message_blocks(path)


def _format(path: Path) -> str:
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] and suffixes[-1] in {".gz", ".zst"}:
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def _text_blocks(path: Path, parser: CandumpParser) -> Iterator[CandumpBlock]:
    buffer = bytearray(_CHUNK_BYTES)
    rest = b""
    with open_file(path) as file:
        text = decompressed(file, str(path))
        try:
            while count := text.readinto(buffer):
                *lines, rest = (rest + buffer[:count]).split(b"\n")
                if len(rest) > _CHUNK_BYTES:  # no text
                    lines, rest = [*lines, rest], b""
                yield from _parsed(lines, parser)
        except (OSError, EOFError) as error:
            raise InputError(f"{path}: {error}") from error
        if rest:
            yield from _parsed([rest], parser)


def _parsed(lines: list[bytes], parser: CandumpParser) -> Iterator[CandumpBlock]:
    try:
        yield parser.parse([line.decode("utf-8", "replace") for line in lines])
    except BadLineError as error:
        yield error.block
        raise


def _message_blocks(path: Path) -> Iterator[CandumpBlock]:
    from tipforce.host.live.receive_python_can import message_block
    from tipforce.host.logs.library_formats import message_reader

    names: dict[str, int] = {}
    try:
        with message_reader(path) as reader:
            messages = iter(reader)
            while chunk := list(islice(messages, _BLOCK_FRAMES)):
                for message in chunk:
                    if isinstance(message.channel, int):
                        message.channel = f"can{message.channel}"
                yield message_block(chunk, names)
    except TipforceError:
        raise
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    except Exception as error:  # python-can's readers raise any exception on a damaged file
        raise InputError(f"{path}: {error}") from error
