"""A log, or a part of one, as blocks of the selected frames, with notes on what else it holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from tipforce.errors import InputError
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.decoding.health import joins, with_services
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.logs.lines import never
from tipforce.host.logs.notes import BadLine
from tipforce.host.logs.reader import LogReader, open_log


class StrictError(InputError):
    """The first bad line of a log that is read strictly; the text names the log and the place.

    ``bad`` is the line, if known; ``goes_on``: its number counts within a part that is not the first.
    """

    bad: BadLine | None = None
    goes_on: bool = False


class Piece(NamedTuple):
    """A log, or, of a large one, the bytes from ``start`` to ``end`` (None: to its end)."""

    name: str
    start: int = 0
    end: int | None = None


class When(NamedTuple):
    """A time limit: nanoseconds of the epoch, or since the first frame."""

    ns: int
    relative: bool


@dataclass(frozen=True, slots=True)
class Reading:
    """Selection and options of a log to read; it can be sent to another process."""

    layouts: Layouts
    signals: tuple[str, ...] | None = None
    buses: tuple[str, ...] | None = None
    start: When | None = None
    end: When | None = None
    origin_ns: int | None = None
    strict: bool = False
    follow: bool = False
    stop: Callable[[], bool] = never
    """Ends a log that grows, and stdin, by returning True; a reading with another than ``never`` stays here."""
    deltas: bool = False
    reasons: bool = True
    """Count the missing values by their reasons."""

    def decoder(self) -> Decoder:
        """Return a separate decoder for each bus whose layouts may change; otherwise all have one."""
        made = self.layouts.decoder if self.layouts.eds else partial(_decoder, self.layouts)
        return made(services=joins(self.signals))

    @property
    def wanted(self) -> tuple[str, ...] | None:
        """The signals to decode: those asked for, and what the faults of 2124h are joined from."""
        return self.signals if self.layouts.dbc is not None else with_services(self.signals)


@lru_cache(1)
def _decoder(layouts: Layouts, services: bool) -> Decoder:
    """Return a decoder for all parts that this process reads: to make its plan takes as long as ten thousand frames."""
    return layouts.decoder(services=services)


@dataclass(slots=True)
class Notes:
    """Notes on one log after it was read. ``goes_on``: it belongs to the same log as the part before.

    ``first_bad_line`` is numbered within the part; ``lines`` is its number of lines.
    """

    source: str
    frames: int = 0
    bad: dict[str, int] = field(default_factory=dict)
    first_bad: str | None = None
    skipped: dict[str, int] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    timed: bool = True
    goes_on: bool = False
    first_bad_line: BadLine | None = None
    lines: int = 0
    extended: int = 0

    def append(self, other: Notes) -> None:
        """Add the notes of the next part of the same log."""
        if self.first_bad is None and other.first_bad is not None:
            line = other.first_bad_line
            moved = line is not None and other.first_bad == str(line)
            self.first_bad = str(numbered_from(self.lines, line)) if moved and line is not None else other.first_bad
        self.frames += other.frames
        self.extended += other.extended
        self.lines += other.lines
        for mine, more in ((self.bad, other.bad), (self.skipped, other.skipped)):
            for reason, count in more.items():
                mine[reason] = mine.get(reason, 0) + count
        self.channels += tuple(name for name in other.channels if name not in self.channels)
        self.timed = self.timed and other.timed


def numbered_from(lines: int, bad: BadLine) -> BadLine:
    """Return the bad line of a part with ``lines`` lines before it."""
    return replace(bad, number=lines + bad.number)


Progress = Callable[[int], None]


class Source:
    """The selected frames of one log, in blocks; ``notes`` are complete at the end."""

    def __init__(self, piece: Piece, reading: Reading, progress: Progress | None = None) -> None:
        """Open the log. Raises InputError if that fails."""
        name = piece.name
        self._reading = reading
        self._origin = reading.origin_ns
        self._progress = progress
        self.log: LogReader = open_log(
            name, strict=reading.strict, follow=reading.follow and name != "-", deltas=reading.deltas,
            part=(piece.start, piece.end), stop=reading.stop,
        )  # fmt: skip
        self.notes = Notes(name, goes_on=piece.start > 0)

    @property
    def channels(self) -> list[str]:
        """The interfaces, by number; grows during the iteration."""
        return self.log.channels

    def __iter__(self) -> Iterator[FrameArray]:
        with self.log as log:
            try:
                for block in self._blocks(log):
                    self.notes.frames += len(block)
                    frames = self._chosen(block)
                    if self._progress is not None:
                        self._progress(log.position)
                    if len(frames):
                        yield frames
            finally:
                self._take_notes(log)

    def _blocks(self, log: LogReader) -> Iterator[FrameArray]:
        try:
            yield from log
        except InputError as error:
            if not self._reading.strict:
                raise
            text = str(error)
            name = "stdin" if self.notes.source == "-" else self.notes.source
            strict = StrictError(text if text.startswith(name) else f"{name}: {text}")
            strict.bad, strict.goes_on = log.first_bad_line, self.notes.goes_on
            raise strict from None

    def _take_notes(self, log: LogReader) -> None:
        notes = self.notes
        notes.bad, notes.first_bad, notes.skipped = dict(log.bad), log.first_bad, dict(log.skipped)
        notes.channels, notes.timed = tuple(log.channels), log.timed
        notes.first_bad_line, notes.lines, notes.extended = log.first_bad_line, log.lines, log.extended

    def _chosen(self, block: FrameArray) -> FrameArray:
        reading = self._reading
        if reading.start is not None or reading.end is not None:
            block = self._in_time(block, reading.start, reading.end)
        if reading.buses is not None:
            wanted = np.array([name in reading.buses for name in self.log.channels] or [False])
            block = block.compress(wanted[block["channel"]])
        return block

    def _in_time(self, block: FrameArray, start: When | None, end: When | None) -> FrameArray:
        if not self.log.timed:
            raise InputError(f"{self.notes.source}: the log has no timestamps, so --from and --to are not possible")
        if self._origin is None:
            self._origin = int(block["t_ns"][0])
        keep = np.ones(len(block), dtype=np.bool_)
        if start is not None:
            keep &= block["t_ns"] >= start.ns + (self._origin if start.relative else 0)
        if end is not None:
            keep &= block["t_ns"] < end.ns + (self._origin if end.relative else 0)
        return block.compress(keep)
