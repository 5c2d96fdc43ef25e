"""A log, or a part of one, as blocks of the selected frames, with notes on what else it holds."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from tipforce.errors import InputError
from tipforce.host.decoding.decoder import Decoder
from tipforce.host.decoding.health import EMCY, STATE, joins
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.logs.notes import BadLine
from tipforce.host.logs.reader import LogReader, within


class StrictError(InputError):
    """The first bad line of a log that is read strictly; the text names the log and the place. ``bad`` is the line, if
    known; ``goes_on``: its number counts within a part that is not the first."""

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
    stop: Callable[[], bool] | None = None
    """Ends a log that grows, and stdin, by returning True; a reading with another than ``never`` stays here."""
    deltas: bool = False
    reasons: bool = True
    """Count the missing values by their reasons."""
    rows: bool = True
    """The rows are shown: unwrap their counters."""

    def decoder(self) -> Decoder:
        """Return a separate decoder for each bus whose layouts may change; otherwise all have one."""
        made = self.layouts.decoder if self.layouts.eds else partial(_decoder, self.layouts)
        return made(services=joins(self.signals))

    def limits(self, origin_ns: int) -> list[int | None]:
        """Return ``start`` and ``end`` in nanoseconds of the epoch; ``origin_ns``: time of the first frame."""
        return [limit and limit.ns + (origin_ns if limit.relative else 0) for limit in (self.start, self.end)]

    @property
    def wanted(self) -> tuple[str, ...] | None:
        """The signals to decode: those asked for, and what the faults of 2124h are joined from."""
        if self.signals is None or self.layouts.dbc is not None or not joins(self.signals):
            return self.signals
        return *self.signals, EMCY, STATE


@lru_cache(1)
def _decoder(layouts: Layouts, services: bool) -> Decoder:
    """Return a decoder for all parts that this process reads: to make its plan takes as long as ten thousand frames."""
    return layouts.decoder(services=services)


Progress = Callable[[float], None]
"""Takes the bytes of a log that are read since its last call."""


class Source(LogReader):
    """The selected frames of one log, in blocks; its notes, complete at the end, are on all frames."""

    def __init__(self, piece: Piece, reading: Reading, progress: Progress | None = None) -> None:
        """Open the log. Raises InputError if that fails."""
        super().__init__(
            piece.name, strict=reading.strict, follow=reading.follow and piece.name != "-", deltas=reading.deltas,
            part=(piece.start, piece.end), stop=reading.stop,
        )  # fmt: skip
        self._reading, self.origin_ns, self._progress = reading, reading.origin_ns, progress

    def __iter__(self) -> Iterator[FrameArray]:
        """Yield blocks of frames, none empty. Raises InputError, StrictError."""
        done = 0
        with self:
            for block in self._read():
                frames = self._chosen(block)
                if self._progress is not None:
                    position = self.position  # a thread reads ahead
                    self._progress(position - done)
                    done = position
                if len(frames):
                    yield frames

    def _read(self) -> Iterator[FrameArray]:
        try:
            yield from super().__iter__()
        except InputError as error:
            if not self.strict:
                raise
            text, name = str(error), "stdin" if self.source == "-" else self.source
            strict = StrictError(text if text.startswith(name) else f"{name}: {text}")
            strict.bad, strict.goes_on = self.first_bad if isinstance(self.first_bad, BadLine) else None, self.goes_on
            raise strict from None

    def _chosen(self, block: FrameArray) -> FrameArray:
        reading = self._reading
        if reading.start is not None or reading.end is not None:
            if not self.timed:
                raise InputError(f"{self.source}: the log has no timestamps, so --from and --to are not possible")
            if self.origin_ns is None:
                self.origin_ns = int(block["t_ns"][0])
            block = within(block, *reading.limits(self.origin_ns))
        if reading.buses is not None:
            wanted = np.array([name in reading.buses for name in self.channels] or [False])
            block = block.compress(wanted[block["channel"]])
        return block
