"""Output of `tipforce dump`: candump's lines followed by the decoded values, or JSON lines."""

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

from tipforce.device.codes import ERROR_FLAG, REMOTE_FLAG
from tipforce.dictionary.signals import Signal
from tipforce.host.decoding.decoder import Samples
from tipforce.host.decoding.plan import Key
from tipforce.host.decoding.services import Service
from tipforce.host.frames.fd_frame import BIT_RATE_SWITCH, ERROR_STATE
from tipforce.host.frames.frame_block import CandumpBlock
from tipforce.host.logs.candump_format import CandumpFormat, identifier_text
from tipforce_tools.cli import common

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
        positions = block.positions()
        for samples in decoded.values():
            rows = samples.row.tolist()
            for row, line, words in zip(rows, positions[samples.row].tolist(), _words(samples), strict=True):
                gap = max(_HEX_WIDTH - 3 * lengths[row], 0) if self._aligned else 0
                lines[line] += " " * (gap + 2) + words
        for service in services:
            gap = max(_HEX_WIDTH - 3 * lengths[service.row], 0) if self._aligned else 0
            node = f"node {common.shown_id(service.node_id)} " if service.node_id else ""
            lines[positions[service.row]] += " " * (gap + 2) + node + service.text
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
