"""The words `vcan0,181:7FF` and `run.log` of a command line: buses and texts, with the filters of their frames."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG
from tipforce.errors import InputError
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.live.receiver import Filter, Selection

ANY = "any"
STDIN = "-"

_FILTER = re.compile(r"(?:0[xX])?([0-9A-Fa-f]{1,8})([:~])(?:0[xX])?([0-9A-Fa-f]{1,8})")
_ERROR_FILTER = re.compile(r"#(?:0[xX])?([0-9A-Fa-f]{1,8})")


def parse_target(text: str) -> Selection:
    """Parse `vcan0,181:7FF,182~7FF,#FF,j`. Raises InputError naming an invalid filter."""
    channel, *rules = text.split(",")
    filters: list[Filter] = []
    join, error_mask = False, 0
    if not channel:
        raise InputError(f"{text!r}: no channel before the first comma; write vcan0,181:7FF, or any,181:7FF")
    for rule in rules:
        match, error = _FILTER.fullmatch(rule), _ERROR_FILTER.fullmatch(rule)
        if match is not None:
            extended = EXTENDED_FLAG if len(match[1]) == 8 else 0
            filters.append(Filter(int(match[1], 16) | extended, int(match[3], 16) & ~ERROR_FLAG, match[2] == "~"))
        elif error is not None:
            error_mask = int(error[1], 16) & ~ERROR_FLAG
        elif rule in {"j", "J"}:
            join = True
        else:
            raise InputError(f"filter {rule!r} of {channel}: expected ID:MASK, ID~MASK or #MASK in hexadecimal, or j")
    return Selection(tuple(filters), join, error_mask, channel)


def select(block: CandumpBlock, targets: Sequence[Selection]) -> CandumpBlock:
    """Return the frames of a text that a target selects: all without targets; a bare channel selects all its frames."""
    if not targets:
        return block
    names = block.names
    fd_id = np.array([frame.can_id for frame in block.fd], dtype=np.uint32)
    fd_interface = np.array([frame.interface for frame in block.fd], dtype=np.intp)
    rows = _wanted(names, block.frames["can_id"].astype(np.uint32), block.frames["channel"].astype(np.intp), targets)
    fd_rows = _wanted(names, fd_id, fd_interface, targets)
    return block.take(rows, fd_rows)


def _wanted(
    names: Sequence[str], can_id: npt.NDArray[np.uint32], interface: npt.NDArray[np.intp], targets: Sequence[Selection]
) -> npt.NDArray[np.bool_]:
    wanted = np.zeros(len(can_id), dtype=np.bool_)
    for target in targets:
        here = np.array([target.channel in {name, ANY} for name in names], dtype=np.bool_)[interface]
        wanted |= here if target.everything else here & target.passes(can_id)
    return wanted


def split_targets(texts: Sequence[str]) -> tuple[Path | str | None, tuple[Selection, ...]]:
    """Return the source (a file, STDIN, or None: buses), and the channels. Filters after a file apply to its frames:
    `run.log,181:7FF`. Raises InputError for two sources, a directory, and a missing file."""
    sources: list[Path | str] = []
    targets: list[Selection] = []
    for text in texts:
        path = Path(text)
        name, comma, rules = text.partition(",")
        if comma and not path.exists() and (name == STDIN or Path(name).is_file() or Path(name).is_fifo()):
            sources.append(name if name == STDIN else Path(name))
            targets.append(parse_target(f"{ANY},{rules}"))
        elif text == STDIN:
            sources.append(text)
        elif path.is_file() or path.is_fifo():
            sources.append(path)
        elif path.is_dir():
            raise InputError(f"{text}: is a directory; name a log in it")
        elif path.suffix in {".log", ".txt"} or ("/" in text and "," not in text and not path.exists()):
            raise InputError(f"{text}: no such file")
        else:
            targets.append(parse_target(text))
    if len(sources) > 1:
        raise InputError(f"{' and '.join(map(str, sources))}: only one can be the source of the text")
    return (sources[0] if sources else None), tuple(targets)
