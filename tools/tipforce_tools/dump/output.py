"""Output of `tipforce dump`: candump's lines followed by the decoded values, or JSON lines."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from canopen_device.core.codes import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from tipforce.dictionary.signals import Signal
from tipforce.errors import InputError
from tipforce.host.decoding.decoder import Samples
from tipforce.host.decoding.plan import Key
from tipforce.host.decoding.services import Service
from tipforce.host.frames.frame_block import BIT_RATE_SWITCH, ERROR_STATE, CandumpBlock
from tipforce.host.live.receiver import Filter, Selection
from tipforce.host.logs.candump_format import CandumpFormat, identifier_text
from tipforce_tools.cli import common

ANY = "any"
STDIN = "-"

_FILTER = re.compile(r"(?:0[xX])?([0-9A-Fa-f]{1,8})([:~])(?:0[xX])?([0-9A-Fa-f]{1,8})")
_ERROR_FILTER = re.compile(r"#(?:0[xX])?([0-9A-Fa-f]{1,8})")


@dataclass(frozen=True, slots=True)
class Target:
    """A channel and the filters of its frames."""

    channel: str
    selection: Selection = field(default_factory=Selection)


def parse_target(text: str) -> Target:
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
    return Target(channel, Selection(tuple(filters), join, error_mask))


def select(block: CandumpBlock, targets: Sequence[Target]) -> CandumpBlock:
    """Return the frames of a text that a target selects: all without targets; a bare channel selects all its frames."""
    if not targets:
        return block
    names = block.names
    fd_id = np.array([frame.can_id for frame in block.fd], dtype=np.uint32)
    fd_interface = np.array([frame.interface for frame in block.fd], dtype=np.intp)
    rows = _wanted(names, block.frames["can_id"].astype(np.uint32), block.interface.astype(np.intp), targets)
    fd_rows = _wanted(names, fd_id, fd_interface, targets)
    return block.take(rows, fd_rows)


def _wanted(
    names: Sequence[str], can_id: npt.NDArray[np.uint32], interface: npt.NDArray[np.intp], targets: Sequence[Target]
) -> npt.NDArray[np.bool_]:
    wanted = np.zeros(len(can_id), dtype=np.bool_)
    for target in targets:
        here = np.array([target.channel in {name, ANY} for name in names], dtype=np.bool_)[interface]
        wanted |= here if target.selection.everything else here & target.selection.passes(can_id)
    return wanted


def split_targets(texts: Sequence[str]) -> tuple[Path | str | None, tuple[Target, ...]]:
    """Return the source of the text (a file, STDIN, or None: buses), and the channels.

    Filters after a file apply to all its frames: `run.log,181:7FF` is `run.log any,181:7FF`. Raises InputError for
    two sources, a directory, and a missing file.
    """
    sources: list[Path | str] = []
    targets: list[Target] = []
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


COUNTER = "counter"
_UNITS = {"degree": "deg"}
_HEX_WIDTH = 24  # of eight data bytes on candump's screen

Decoded = Mapping[Key, Samples]


class Writer(Protocol):
    """Formats a block of frames and its decoded values, with line ends."""

    def text(self, block: CandumpBlock, decoded: Decoded, services: Iterable[Service] = ()) -> str:
        """Return the text of a block."""


class TextWriter:
    """candump's lines; decoded values follow the data, in the same column for every data length."""

    def __init__(self, candump_format: CandumpFormat, *, aligned: bool) -> None:
        self._format = candump_format
        self._aligned = aligned

    def text(self, block: CandumpBlock, decoded: Decoded, services: Iterable[Service] = ()) -> str:
        """Return the text of a block."""
        lines = self._format.lines(block)
        lengths = block.frames["length"].tolist()
        positions = block.positions().tolist()
        meanings: list[tuple[int, str]] = []
        for samples in decoded.values():
            rows = zip(samples.row.tolist(), _words(samples), strict=True)
            meanings += rows
        for service in services:
            node = f"node {common.shown_id(service.node_id)} " if service.node_id else ""
            meanings.append((service.row, node + service.text))
        for row, meaning in meanings:
            gap = max(_HEX_WIDTH - 3 * lengths[row], 0) if self._aligned else 0
            lines[positions[row]] += " " * (gap + 2) + meaning
        return "\n".join(lines) + "\n" if lines else ""


class JsonWriter:
    """One JSON object per frame."""

    def text(self, block: CandumpBlock, decoded: Decoded, services: Iterable[Service] = ()) -> str:
        """Return the text of a block."""
        frames = block.frames
        data = frames["data"].tobytes()
        records = []
        numbers = zip(
            frames["t_ns"].tolist(), frames["can_id"].tolist(), frames["length"].tolist(), block.interface.tolist(),
            strict=True,
        )  # fmt: skip
        for row, (t_ns, can_id, length, interface) in enumerate(numbers):
            record: dict[str, Any] = {
                "t": t_ns / 1_000_000_000 if block.timed else None,  # integers: 1e9 would round t_ns first
                "interface": block.names[interface],
                "id": identifier_text(can_id),
                "data": data[8 * row : 8 * row + length].hex().upper(),
            }
            if can_id & ERROR_FLAG:
                record["error"] = True
            elif can_id & REMOTE_FLAG:
                record |= {"data": "", "remote": True, "length": length}
            records.append(record)
        for samples in decoded.values():
            _add_values(records, samples)
        for service in services:
            node_id = {"node": service.node_id} if service.node_id else {}
            records[service.row] |= {**node_id, "service": service.name, "text": service.text}
        for number, frame in enumerate(block.fd):
            record = {
                "t": frame.t_ns / 1_000_000_000 if block.timed else None,
                "interface": block.names[frame.interface],
                "id": identifier_text(frame.can_id),
                "data": frame.data.hex().upper(),
                "fd": True,
                "bit_rate_switch": bool(frame.flags & BIT_RATE_SWITCH),
                "error_state": bool(frame.flags & ERROR_STATE),
            }
            records.insert(frame.row + number, record)
        return "".join(json.dumps(record) + "\n" for record in records)


def _add_values(records: list[dict[str, Any]], samples: Samples) -> None:
    flags, numbers = _kinds(samples)
    columns = {name: column.tolist() for name, column in samples.columns.items()}
    for position, row in enumerate(samples.row.tolist()):
        record = records[row]
        record["node"] = samples.node_id
        record["message"] = samples.message.name
        values = {signal.name: columns[signal.name][position] for signal in numbers}
        record["values"] = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in values.items()
        }
        record["status"] = [signal.name for signal in flags if columns[signal.name][position]]
        if COUNTER in columns:
            record[COUNTER] = columns[COUNTER][position]


def _words(samples: Samples) -> list[str]:
    """`node 5 (0x05) Contact  P=4.398 N phi=90.01 deg theta=unknown contact calibrated #3`, for each sample."""
    flags, numbers = _kinds(samples)
    parts = [[_value(signal, value) for value in samples.columns[signal.name].tolist()] for signal in numbers]
    parts += [[signal.name if is_set else "" for is_set in samples.columns[signal.name].tolist()] for signal in flags]
    if COUNTER in samples.columns:
        parts.append([f"#{count}" for count in samples.columns[COUNTER].tolist()])
    start = f"node {common.shown_id(samples.node_id)} {samples.message.name}  "
    return [start + " ".join(filter(None, words)) for words in zip(*parts, strict=True)] if parts else []


def _kinds(samples: Samples) -> tuple[list[Signal], list[Signal]]:
    """Return the flags, and the numbers except the counter."""
    signals = [signal for signal in samples.message.signals if signal.name in samples.columns]
    flags = [signal for signal in signals if signal.bits == 1]
    return flags, [signal for signal in signals if signal.bits > 1 and signal.name != COUNTER]


def _value(signal: Signal, value: float) -> str:
    if isinstance(value, int):
        return f"{signal.name}={value}"
    if math.isnan(value):
        return f"{signal.name}=unknown"
    text = f"{value:g}" if signal.real else f"{value:.{max(-math.floor(math.log10(signal.scale)), 0)}f}"
    return f"{signal.name}={text} {_UNITS.get(signal.unit, signal.unit)}".rstrip()
