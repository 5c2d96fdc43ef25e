"""Decode the parts of a recording with any number of workers, each of which writes the rows of its parts itself.

A worker decodes a part and keeps its rows; the parts' ends come here, where a pass in order (``Recording.follow``)
finds what each part cannot know; then the worker completes and writes its rows. What comes back is a record of what
was written, never a row. A part is repeated if its worker dies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple, Protocol

from tipforce.errors import TipforceError
from tipforce.host.decoding.decoded_part import DecodedPart, Ends
from tipforce.host.decoding.duplicates import services
from tipforce.host.decoding.log_part import Notes, Piece, Reading, StrictError
from tipforce.host.decoding.recording import Recording, State
from tipforce.host.decoding.sample_table import Table
from tipforce.host.decoding.services import BusEvent
from tipforce.host.frames.frame_array import FrameArray
from tipforce_tools.decode.summary import Summary
from tipforce_tools.decode.writers import Shape


class Sink(Protocol):
    """Writes the rows of a part; it can be sent to another process."""

    def write(self, number: int, tables: Iterable[Table], shape: Shape) -> Any:
        """Write the rows of part ``number`` with the columns of ``shape``; return a record. Raises OSError."""


@dataclass(slots=True)
class Written:
    """What was written of a part. ``shape``: its columns, and those of the parts in front."""

    number: int
    piece: Piece
    record: Any
    shape: Shape
    summary: Summary
    state: State | None = None
    """Of the recording after it."""
    notes: Notes | None = None
    """Of a part that was decoded after the ones in front, as ``services``: the frames that ``BusEvents`` looks at."""
    services: list[FrameArray] = field(default_factory=list)
    frames: int = 0
    bad: dict[str, int] = field(default_factory=dict)
    """Bad lines by reason."""
    events: list[BusEvent] = field(default_factory=list)


class Event(NamedTuple):
    """What a worker says of part ``number``: its Ends, what was Written, or an error."""

    number: int
    told: Ends | Written | Exception


class Workers(Protocol):
    """Workers for a sequence of parts."""

    @property
    def free(self) -> int:
        """How many parts can be begun now."""

    def decode(self, number: int, piece: Piece) -> None:
        """Begin to decode a part."""

    def write(self, number: int, before: State, apart: bool, shape: Shape, last: bool) -> None:
        """Complete and write a part after ``before``: as it was decoded apart, or decode it now."""

    def next(self) -> Event:
        """Wait for the next event. Raises EnvironmentLackError if a part cannot be finished."""

    def close(self) -> None:
        """End all work."""


class Work:
    """What a worker does with one part, in whatever process."""

    def __init__(self, number: int, piece: Piece, reading: Reading) -> None:
        self._number, self._piece, self._reading = number, piece, reading
        self._part: DecodedPart | None = None

    def decode(self) -> Ends:
        """Decode the part and keep its rows. Raises TipforceError, OSError."""
        self._part = DecodedPart(self._piece, self._reading)
        return self._part.ends

    def write(self, sink: Sink, before: State, apart: bool, shape: Shape, last: bool) -> Written:
        """Complete and write the rows, see ``Workers``. Raises TipforceError, OSError."""
        if apart:
            assert self._part is not None
            return self._written(self._part.rows(before, last=last), shape, sink)
        recording = Recording(self._reading, before)
        few: list[FrameArray] = []
        tables = recording.tables_of_piece(self._piece, tap=lambda block, _: few.append(services(block)))
        found = self._written(chain(tables, recording.finish() if last else ()), shape, sink)
        found.state, found.notes, found.services = recording.state(), recording.told.notes[0], few
        return found

    def _written(self, tables: Iterable[Table], shape: Shape, sink: Sink) -> Written:
        summary = Summary()
        record = sink.write(self._number, summary.passing(tables), shape)
        return Written(self._number, self._piece, record, shape, summary)


class Here:
    """This process as the only worker: each part is decoded after the ones in front."""

    def __init__(self, reading: Reading, sink: Sink) -> None:
        self._reading, self._sink = reading, sink
        self._pieces: dict[int, Piece] = {}
        self._events: list[Event] = []

    @property
    def free(self) -> int:
        """1 while no part is in work."""
        return int(not self._pieces)

    def decode(self, number: int, piece: Piece) -> None:
        """Do nothing yet."""
        self._pieces[number] = piece
        self._events.append(Event(number, Ends((), Notes(piece.name))))

    def write(self, number: int, before: State, apart: bool, shape: Shape, last: bool) -> None:
        """Decode and write a part."""
        work = Work(number, self._pieces.pop(number), self._reading)
        try:
            self._events.append(Event(number, work.write(self._sink, before, apart, shape, last)))
        except (TipforceError, OSError) as error:
            self._events.append(Event(number, error))

    def next(self) -> Event:
        """Return the next event."""
        return self._events.pop(0)

    def close(self) -> None:
        """Do nothing."""


class InOrder:
    """The pass over the parts of a recording in order, while workers decode and write them."""

    def __init__(
        self, pieces: Sequence[Piece], recording: Recording, shape: Shape, workers: Workers, *, ends: bool = True
    ) -> None:
        """``ends``: the recording ends with the last part."""
        self._pieces, self._recording, self._shape = pieces, recording, shape
        self._workers, self._ends = workers, ends
        self._known: dict[int, Ends | Exception] = {}
        self._written: dict[int, Written] = {}
        self._told: dict[int, tuple[State, int, dict[str, int], list[BusEvent]]] = {}
        self._begun = self._followed = self._given = 0
        self._alone = False

    def __iter__(self) -> Iterator[Written]:
        """Yield what was written, in order. Raises the errors of the decoding and the writing in order, too."""
        try:
            while self._given < len(self._pieces):
                while self._begun < len(self._pieces) and self._workers.free:
                    self._workers.decode(self._begun, self._pieces[self._begun])
                    self._begun += 1
                self._take(self._workers.next())
                self._follow()
                while self._given in self._written:
                    found = self._written.pop(self._given)
                    found.state, found.frames, found.bad, found.events = self._told.pop(found.number)
                    self._given += 1
                    yield found
        finally:
            self._workers.close()

    def _take(self, event: Event) -> None:
        number, told = event
        if not isinstance(told, Written):
            if isinstance(told, Exception) and self._alone and number == self._followed:
                self._raise(told)
            elif isinstance(told, Exception) and number < self._followed:
                raise told
            self._known[number] = told
            return
        self._written[number] = told
        if told.state is not None and told.notes is not None and number == self._followed:
            events = len(self._recording.told.bus.found)
            self._recording.resume(told.state, told.notes, told.services)
            self._shape = told.shape.copy()
            self._passed(number, told.notes, events)
            self._known.pop(number, None)
            self._alone = False

    def _follow(self) -> None:
        """Tell the parts whose turn it is what the parts in front leave."""
        while not self._alone and self._followed in self._known:
            number, ends = self._followed, self._known.pop(self._followed)
            if isinstance(ends, Exception):
                self._raise(ends)
                return
            last = self._ends and number == len(self._pieces) - 1
            before, events = self._recording.state(), len(self._recording.told.bus.found)
            columns = self._recording.follow(ends, last=last)
            if columns is None:
                self._alone = True
            else:
                self._shape.take(columns, self._recording.channels)
                self._passed(number, ends.notes, events)
            self._workers.write(number, before, not self._alone, self._shape.copy(), last)

    def _passed(self, number: int, notes: Notes, events: int) -> None:
        """Note what the recording knows after a part, which had so many ``events`` before it."""
        found = self._recording.told.bus.found[events:]
        self._told[number] = self._recording.state(), notes.frames, notes.bad, found
        self._followed = number + 1

    def _raise(self, error: Exception) -> None:
        raise self._recording.numbered(error) if isinstance(error, StrictError) else error
