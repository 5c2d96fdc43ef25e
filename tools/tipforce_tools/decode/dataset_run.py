"""Add logs to a dataset: what it has is left alone, what is new is decoded by workers and committed part by part."""

import hashlib
import os
import time
import uuid
import zlib
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path

import msgspec

import tipforce
from canopen_device.visible_text import visible
from tipforce.errors import InputError
from tipforce.host.dataset import manifest as manifests
from tipforce.host.dataset.manifest import Change, DataFile, Manifest, Part, Source, commit, files_of, read_manifest
from tipforce.host.dataset.reader import need_pyarrow
from tipforce.host.dataset.store import FOLDER, Store, url_of
from tipforce.host.decoding.log_part import Piece, Reading
from tipforce.host.decoding.recording import Recording, State
from tipforce.host.logs.lines import decompressed, open_file
from tipforce.host.logs.reader import log_kind
from tipforce_tools.decode.workers import Done, InOrder, Sink, Workers
from tipforce_tools.writing.dataset_files import DatasetSink, events_file, joined_parts
from tipforce_tools.writing.text_rows import BASE
from tipforce_tools.writing.writers import Shape

HASHED_BYTES = 1 << 16
_COMPARED_BYTES = 1 << 12


def begin_hash(name: str) -> str:
    """Return the SHA-256 of the first bytes of a text, packed or not; of another log, which has a header, of all."""
    start = bytearray()
    with open_file(Path(name)) as file, suppress(OSError, EOFError, zlib.error):
        if log_kind(Path(name)) != "text":
            return hashlib.file_digest(file, "sha256").hexdigest()
        unpacked, block = decompressed(file, name), bytearray(_COMPARED_BYTES)
        while len(start) < _COMPARED_BYTES and (count := unpacked.readinto(block)):
            start += block[:count]
    return hashlib.sha256(start[:_COMPARED_BYTES]).hexdigest()


def is_whole(root: Path, file: DataFile) -> bool:
    """Return whether a file of a dataset is there, with its size."""
    path = root / file.path
    return path.is_file() and path.stat().st_size == file.bytes


def hash_of(name: str, start: int, end: int) -> str:
    """Return the SHA-256 of bytes of a log. Raises InputError for a log that can't be opened."""
    with open_file(Path(name)) as file:
        file.seek(start)
        return hashlib.sha256(file.read(end - start) or b"").hexdigest()


def tail_hash(name: str, end: int) -> str:
    """Return the SHA-256 of the last bytes in front of ``end``."""
    return hash_of(name, max(end - HASHED_BYTES, 0), end)


def options_of(reading: Reading, hand: str | None) -> str:
    """Return what the rows of a log depend on besides its bytes."""
    layouts = reading.layouts
    words = [f"gauges {layouts.gauges}"]
    start, end = ("" if ns is None else f"{ns} ns" for ns in reading.limits(reading.origin_ns or 0))
    given = (
        ("nodes", layouts.nodes), ("signals", reading.signals), ("buses", reading.buses), ("hand", hand),
        ("from", start), ("to", end), ("deltas", reading.deltas), ("dbc", layouts.dbc), ("eds", layouts.eds),
    )  # fmt: skip
    words += [f"{name} {value}" for name, value in given if value]
    if layouts.pdos:
        words.append(f"layouts {hashlib.sha256(repr(layouts).encode()).hexdigest()[:12]}")
    return visible(", ".join(words))  # JSON has no surrogates, which names of files may have


_COMMIT_S = 2.0

Cut = Callable[[str, int], list[Piece]]
"""The pieces of a log from a byte on."""


@dataclass(slots=True)
class _Log:
    """One log to add, from ``start`` on. ``replaced``: parts that are written again. ``size``: of the file."""

    source: Source
    start: int
    replaced: list[str] = field(default_factory=list)
    size: int = 0


@dataclass(slots=True)
class _Chain:
    """Logs that follow each other, to be decoded from ``state`` on. ``ends``: no log of the dataset follows."""

    state: State | None
    logs: list[_Log] = field(default_factory=list)
    ends: bool = True


class DatasetRun:
    """One run that adds logs to the dataset ``directory``."""

    def __init__(
        self, directory: str, reading: Reading, recording: Recording, hand: str | None, cut: Cut,
        workers: Callable[[Sink, int], Workers],
    ) -> None:  # fmt: skip
        """``recording`` gets what the logs have besides rows. Raises InputError for a directory of other files."""
        self._cut, self._workers, self._reading, self._hand = cut, workers, reading, hand
        need_pyarrow(directory)
        self.store = Store(directory)
        self.manifest = read_manifest(self.store) or _new(self.store)
        self._options = options_of(reading, hand)
        self._token = uuid.uuid4().hex[:12]
        self._change = Change()
        self._committed = time.monotonic()
        self._parts = 0
        self._new: list[Source] = []  # of this run
        self.added = 0
        """Parts of this run."""
        self._recording = recording

    def add(self, names: Sequence[str]) -> Generator[Done]:
        """Add what the dataset does not have, and what was removed from it; yield each part before it is committed.
        Raises InputError, WriteError, OSError; what was committed stays. What ends the iteration ends the run."""
        with manifests.run_lock(self.store, self._token):
            self.manifest = read_manifest(self.store) or _new(self.store)
            manifests.remove_replaced(self.store, self.manifest)
            names = [name for name in names if os.path.getsize(name)] or names[:1]  # empty logs do not differ
            for chains in (self._repairs, self._chains):
                for chain in list(chains(names)):
                    yield from self._add_chain(chain)

    def _chains(self, names: Sequence[str]) -> Iterator[_Chain]:
        chain: _Chain | None = None
        before: Source | None = None
        for name in names:
            known = self._known(name)
            if known is None:
                source = self._new_source(name, before)
                if chain is None:  # the last rows of the log in front were written as if nothing followed
                    chain = _Chain(None) if before is None else self._again(before)
                chain.logs.append(_Log(source, 0))
                before = source
                continue
            if chain is not None:
                yield chain
            followed = self._follower(known) is not None
            left = os.path.getsize(name) > known.size or not (known.flushed or followed)
            chain = self._grown(known, name) if left else None
            before = None if followed else known
        if chain is not None:
            yield chain

    def _repairs(self, names: Sequence[str]) -> Iterator[_Chain]:
        root = self.store.local
        for name in names if root is not None else ():
            source = self._known(name)
            parts = [part for part in self.manifest.parts if source is not None and part.source == source.id]
            if source is None or root is None or all(is_whole(root, file) for file in files_of(parts)):
                continue
            if os.path.getsize(name) > source.size:
                self._grown(source, name)
            before = self.manifest.source(source.after)
            log = _Log(source, 0, [part.id for part in parts])
            yield _Chain(None if before is None else before.end, [log], self._follower(source) is None)

    def _known(self, name: str) -> Source | None:
        """Return the log if the dataset has it, by its content. Raises InputError if it was decoded in another way."""
        size, found, longer = os.path.getsize(name), None, None
        head_sha256 = cache(partial(hash_of, name, 0))  # the sources are many, their sizes of heads are few
        for source in self.manifest.sources:
            if not source.size and size and source.name != str(name):
                continue  # every log begins like an empty one
            if size < source.head_bytes or head_sha256(source.head_bytes) != source.head_sha256:
                continue
            if size < source.size:
                longer = source
            elif tail_hash(name, source.size) == source.tail_sha256 and (found is None or source.size > found.size):
                found = source
        if found is None and longer is not None:
            size = longer.size
            raise InputError(f"{name}: is shorter than what the dataset has of it ({size} bytes): name the whole log")
        if found is not None and found.options != self._options:
            decoded = f"{found.options}, now it is {self._options}"
            raise InputError(f"{name}: the dataset has it decoded with {decoded}; choose another directory")
        # A dataset may outlive the place of its logs.
        return found and msgspec.structs.replace(found, name=str(name))

    def _new_source(self, name: str, before: Source | None) -> Source:
        head = min(os.path.getsize(name), HASHED_BYTES)
        # The same for two writers, so that one of them learns of the other.
        digest, begin = hash_of(name, 0, head), begin_hash(name)
        sources = *self.manifest.sources, *self._new
        known = {source.begin_sha256: source.name for source in sources}
        if begin in known:
            raise InputError(
                f"{name}: begins like {known[begin]}: it is a copy, or one was changed, packed or shortened; leave one "
                "out, or decode into another directory"
            )
        same = sum(source.head_sha256 == digest for source in sources)
        self._new.append(Source(
            f"{digest[:12]}{same or ''}", str(name), head, digest, 0, "", self._options, tipforce.__version__,
            before.id if before else None, False, 0, None, Recording(self._reading).state(), begin,
        ))  # fmt: skip
        return self._new[-1]

    def _grown(self, source: Source, name: str) -> _Chain:
        if (follower := self._follower(source)) is not None:
            raise InputError(f"{name}: has grown after {follower.name} was added behind it; use another directory")
        return self._again(source)

    def _again(self, source: Source) -> _Chain:
        start = source.last_part_start
        replaced = [part.id for part in self.manifest.parts if part.source == source.id and part.start >= start]
        return _Chain(source.before_last_part, [_Log(source, start, replaced)])

    def _follower(self, source: Source) -> Source | None:
        return next((one for one in self.manifest.sources if one.after == source.id), None)

    def _add_chain(self, chain: _Chain) -> Iterator[Done]:
        sink = DatasetSink(self.store.name, self._token, self._hand)
        pieces: list[Piece] = []
        logs: list[_Log] = []
        for log in chain.logs:
            self._change.removed.update(log.replaced)
            log.size = os.path.getsize(log.source.name)  # a log that cannot be cut may grow while it is read
            for piece in self._cut(log.source.name, log.start):
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
        for number, done in enumerate(InOrder(pieces, recording, shape, self._workers(sink, len(pieces)), chain.ends)):
            last = number == len(pieces) - 1
            self._take(done, logs[number], sink.names[number], state, last and chain.ends)
            state = done.state
            if last:
                self._recording.append(recording)
            yield done
            due = time.monotonic() - self._committed > _COMMIT_S
            if last or (due and recording.tally.messages):  # what is not a log of fingertips is not committed
                self._commit()

    def _take(self, done: Done, log: _Log, name: str, before: State, last: bool) -> None:
        piece, written, state, notes, events = done
        end = log.size if piece.end is None else piece.end
        log.source = msgspec.structs.replace(
            log.source, name=visible(url_of(piece.name)), size=end, tail_sha256=tail_hash(piece.name, end),
            flushed=last, last_part_start=piece.start, before_last_part=before, end=state,
            version=tipforce.__version__,
        )  # fmt: skip
        self._change.sources[log.source.id] = log.source
        self._change.parts.append(Part(
            name, log.source.id, piece.start, end, notes.frames, notes.bad, written.record,
            events_file(self.store, self._token, name, events),
            [(event.channel, event.node_id, event.code, event.t_ns) for event in events if event.kind == "calibration"],
        ))  # fmt: skip
        known = {column.name for column in self._change.columns}
        self._change.columns += [column for column in written.shape.columns if column.name not in known]
        self.added += 1

    def _commit(self) -> None:
        change, self._change = self._change, Change()
        change.known = self.manifest
        self._separate(change)
        self.manifest = commit(self.store, change)
        self._committed = time.monotonic()

    def _separate(self, change: Change) -> None:
        """Write the rows of compacted parts again that share files with the parts that are removed."""
        removed = [part for part in self.manifest.parts if part.id in change.removed]
        if not (gone := {file.path: file for file in files_of(removed)}):
            return
        stay = [part for part in self.manifest.parts if part.id not in change.removed]
        stay = [part for part in stay if any(file.path in gone for file in files_of([part]))]
        if stay:
            root = self.store.local  # a file that is damaged stays, until all its logs are added again
            damaged = {path for path, file in gone.items() if root is not None and not is_whole(root, file)}
            self._parts += 1
            name = f"{stay[0].source}-{stay[0].start:014d}-{self._parts}-{self._token}"
            change.removed |= {part.id for part in stay}
            change.parts += joined_parts(self.store, self.manifest, stay, name, damaged)


def _new(store: Store) -> Manifest:
    names = store.names("")  # behind a URL, a run that ended early leaves files and no manifest
    if FOLDER not in names and any(name not in (manifests.ROWS, manifests.EVENTS) for name in names):
        raise InputError(f"--output {store.name}/: is not empty and not a dataset; choose another directory")
    return Manifest()
