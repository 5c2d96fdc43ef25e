"""Add logs to a dataset: what it has is left alone, what is new is decoded by workers and committed part by part."""

from __future__ import annotations

import hashlib
import os
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

import tipforce
from tipforce.errors import InputError
from tipforce.host.dataset.manifest import FOLDER, Change, DataFile, Manifest, Part, Source, commit, read_manifest
from tipforce.host.dataset.run_lock import RunLock
from tipforce.host.dataset.store import Store
from tipforce.host.decoding.log_part import Piece, Reading
from tipforce.host.decoding.recording import Recording, State, Told
from tipforce.host.decoding.services import BusEvent
from tipforce.host.decoding.tally import Tally
from tipforce.host.logs.lines import open_file
from tipforce_tools.decode.dataset_sink import BASE, DatasetSink
from tipforce_tools.decode.events import events_text
from tipforce_tools.decode.parts import InOrder, Sink, Workers, Written
from tipforce_tools.decode.writers import Shape

_HASHED_BYTES = 1 << 16
_COMMIT_S = 2.0
_COMMIT_SHARE = 50  # a commit costs at most this part of the time between commits

Cut = Callable[[str, int], list[Piece]]
"""The pieces of a log from a byte on."""


@dataclass(slots=True)
class _Log:
    """One log to add, from ``start`` on. ``replaced``: parts that are written again."""

    source: Source
    start: int
    replaced: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Chain:
    """Logs that follow each other, to be decoded from ``state`` on."""

    state: State | None
    logs: list[_Log] = field(default_factory=list)


class DatasetRun:
    """One run that adds logs to the dataset ``directory``."""

    def __init__(self, directory: str, reading: Reading, hand: str | None = None) -> None:
        """Raises InputError for a directory that is not a dataset and not empty."""
        self._reading = reading
        self.store = Store(directory)
        self.manifest = read_manifest(self.store) or _new(self.store)
        self._options = _options(reading, hand)
        self._token = uuid.uuid4().hex[:12]
        self._hand = hand
        self._change = Change()
        self._committed, self._cost_s = time.monotonic(), 0.0
        self._parts = 0
        self.added = 0
        """Parts of this run."""
        self.told = Told(Tally(), [])
        """What the logs of this run tell besides their rows."""

    def add(
        self,
        names: Sequence[str],
        cut: Cut,
        workers: Callable[[Sink, int], Workers],
        each: Callable[[Written], None],
    ) -> None:
        """Add what the dataset does not have. Raises InputError, WriteError, OSError; what was committed stays."""
        with RunLock(self.store, self._token):
            self.manifest = read_manifest(self.store) or _new(self.store)
            for chain in list(self._chains(names)):
                self._add_chain(chain, cut, workers, each)

    # --- what is to be done -----------------------------------------------------------------------------------

    def _chains(self, names: Sequence[str]) -> Iterator[_Chain]:
        chain: _Chain | None = None
        before: Source | None = None
        for name in names:
            known = self._known(name)
            if known is None:
                source = self._new_source(name, before)
                if chain is None:
                    chain = self._continued(before)
                chain.logs.append(_Log(source, 0))
            else:
                source = known
                if os.path.getsize(name) > known.size:
                    if chain is not None:
                        yield chain
                    chain = self._grown(known, name)
                elif chain is not None:
                    yield chain
                    chain = None
            before = source
        if chain is not None:
            yield chain

    def _known(self, name: str) -> Source | None:
        """Return the log if the dataset has it, by its content. Raises InputError if it was decoded in another way."""
        for source in self.manifest.sources:
            if os.path.getsize(name) < source.head_bytes or _hash(name, 0, source.head_bytes) != source.head_sha256:
                continue
            if os.path.getsize(name) < source.size:
                raise InputError(f"{name}: is shorter than what the dataset has of it ({source.size} bytes)")
            if _tail(name, source.size) != source.tail_sha256:
                continue
            if source.options != self._options:
                raise InputError(
                    f"{name}: the dataset has it decoded with {source.options}, now it is {self._options}; "
                    "choose another directory"
                )
            return source
        return None

    def _new_source(self, name: str, before: Source | None) -> Source:
        head = min(os.path.getsize(name), _HASHED_BYTES)
        # The same for two writers, so that one of them learns of the other.
        digest = _hash(name, 0, head)
        same = sum(one.head_sha256 == digest for one in self.manifest.sources)
        return Source(
            f"{digest[:12]}{same or ''}", str(name), head, digest, 0, "", self._options, tipforce.__version__,
            before.id if before else None, False, 0, None, Recording(self._reading).state(),
        )  # fmt: skip

    def _continued(self, before: Source | None) -> _Chain:
        """Return a chain behind a log. Its last rows were written as if nothing followed: that part comes again."""
        if before is None:
            return _Chain(None)
        if not before.flushed:
            return _Chain(before.end)
        return _Chain(before.before_last_part, [self._again(before)])

    def _grown(self, source: Source, name: str) -> _Chain:
        follower = next((one for one in self.manifest.sources if one.after == source.id), None)
        if follower is not None:
            raise InputError(f"{name}: has grown after {follower.name} was added behind it; use another directory")
        if not source.flushed:
            return _Chain(source.end, [_Log(source, source.size)])
        return _Chain(source.before_last_part, [self._again(source)])

    def _again(self, source: Source) -> _Log:
        start = source.last_part_start
        replaced = [part.id for part in self.manifest.parts if part.source == source.id and part.start >= start]
        return _Log(source, start, replaced)

    # --- the work ---------------------------------------------------------------------------------------------

    def _add_chain(
        self, chain: _Chain, cut: Cut, workers: Callable[[Sink, int], Workers],
        each: Callable[[Written], None],
    ) -> None:  # fmt: skip
        sink = DatasetSink(self.store.name, self._token, self._hand)
        pieces: list[Piece] = []
        logs: list[_Log] = []
        for log in chain.logs:
            self._change.expected.setdefault(log.source.id, self.manifest.source(log.source.id))
            self._change.removed.update(log.replaced)
            for piece in cut(log.source.name, log.start):
                pieces.append(piece)
                logs.append(log)
                self._parts += 1  # a part that is written again has another name
                sink.names.append(f"{log.source.id}-{piece.start:014d}-{self._parts}-{self._token}")
        if not pieces:
            return
        recording = Recording(self._reading, chain.state)
        shape = Shape(BASE)
        shape.take(self.manifest.columns, ())
        state = recording.state()
        for written in InOrder(pieces, recording, shape, workers(sink, len(pieces)), asked=self._reading.signals):
            assert written.state is not None
            last = written.number == len(pieces) - 1
            self._take(written, logs[written.number], sink.names[written.number], state, last)
            state = written.state
            each(written)
            if last:
                self._tell(recording.told)
            if last or time.monotonic() - self._committed > max(_COMMIT_S, _COMMIT_SHARE * self._cost_s):
                self._commit()

    def _take(self, written: Written, log: _Log, name: str, before: State, last: bool) -> None:
        """Note a part as one to be committed."""
        assert written.state is not None
        piece = written.piece
        end = os.path.getsize(piece.name) if piece.end is None else piece.end
        log.source = msgspec.structs.replace(
            log.source, name=piece.name, size=end, tail_sha256=_tail(piece.name, end), flushed=last,
            last_part_start=piece.start, before_last_part=before, end=written.state, version=tipforce.__version__,
        )  # fmt: skip
        self._change.sources[log.source.id] = log.source
        events = self._events(name, written.events)
        self._change.parts.append(
            Part(name, log.source.id, piece.start, end, written.frames, written.bad, written.record.files, events)
        )
        known = {one.name for one in self._change.columns}
        self._change.columns += [column for column in written.record.columns if column.name not in known]
        self.added += 1

    def _tell(self, told: Told) -> None:
        self.told.notes += told.notes
        self.told.tally.append(told.tally)
        self.told.unseen = sorted({*self.told.unseen, *told.unseen})
        self.told.bus.found += told.bus.found

    def _events(self, name: str, events: Sequence[BusEvent]) -> DataFile | None:
        if not events:
            return None
        text = events_text(events).encode()
        path = f"events/{name}.csv"
        self.store.create(path, text)
        times = [event.t_ns for event in events]
        return DataFile(path, 0, len(events), len(text), hashlib.sha256(text).hexdigest(), min(times), max(times))

    def _commit(self) -> None:
        """Commit what is noted; then remove the files that it replaces."""
        began = time.monotonic()
        change, self._change = self._change, Change()
        old = [part for part in self.manifest.parts if part.id in change.removed]
        self.manifest = commit(self.store, change)
        for part in old:
            for file in [*part.files, *([part.events] if part.events else [])]:
                self.store.remove(file.path)
        for source_id in change.expected:  # a chain is committed in steps
            self._change.expected[source_id] = self.manifest.source(source_id)
        self._committed = time.monotonic()
        self._cost_s = self._committed - began


def _new(store: Store) -> Manifest:
    names = store.names("")
    if names and FOLDER not in names:
        raise InputError(f"--output {store.name}/: is not empty and not a dataset; choose another directory")
    return Manifest()


def _options(reading: Reading, hand: str | None) -> str:
    """Return what the rows of a log depend on besides its bytes."""
    layouts = reading.layouts
    words = [f"gauges {layouts.gauges}"]
    given = (
        ("nodes", layouts.nodes), ("signals", reading.signals), ("buses", reading.buses), ("hand", hand),
        ("from", reading.start), ("to", reading.end), ("dbc", layouts.dbc), ("eds", layouts.eds),
    )  # fmt: skip
    words += [f"{name} {value}" for name, value in given if value]
    if layouts.pdos:
        words.append(f"layouts {hashlib.sha256(repr(layouts).encode()).hexdigest()[:12]}")
    return ", ".join(words)


def _hash(name: str, start: int, end: int) -> str:
    with open_file(Path(name)) as file:
        file.seek(start)
        return hashlib.sha256(file.read(end - start) or b"").hexdigest()


def _tail(name: str, end: int) -> str:
    return _hash(name, max(end - _HASHED_BYTES, 0), end)
