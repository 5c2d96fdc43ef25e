"""The manifest of a dataset: parts of logs, their files, and where each log continues; one JSON file per generation in
``DIR/_tipforce``. A generation holds everything, or what it changes. It is created only once: of two writers one
commits, the other merges its changes, or gives up if both changed the same log."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from tipforce.errors import InputError, WriteError
from tipforce.host.dataset.store import FOLDER, Store, generations
from tipforce.host.decoding.recording import State
from tipforce.host.decoding.sample_table import Column

ROWS, EVENTS = "rows", "events"
FORMAT, CHANGED_FORMAT = 2, 3
"""Of a generation's file that holds everything, and of one that holds what changed."""
_NAME = "manifest-{:010d}.json"
NO_DATE = "__HIVE_DEFAULT_PARTITION__"
"""Of a log without times; query engines read it as null."""
_SOURCE = r"[0-9a-f]{12}\d*"
_PLACE = rf"({EVENTS}|{ROWS}/hand=[\w.-]+/date=(\d{{4}}-\d\d-\d\d|{NO_DATE})/node=\d{{1,3}})"
FilePath = Annotated[str, msgspec.Meta(pattern=rf"\A{_PLACE}/{_SOURCE}-\d{{14,}}-\d+-[0-9a-f]{{12}}\.parquet\Z")]
"""Of a file that a run writes: no other is read, and no other removed."""
SourceId = Annotated[str, msgspec.Meta(pattern=rf"\A{_SOURCE}\Z")]
_KEPT_GENERATIONS = 2  # for readers that have just listed them
_PARTS_PER_CHANGE = 1000  # one change for so many parts, then all again: the mean cost of a commit does not grow


class DataFile(msgspec.Struct, frozen=True, array_like=True):
    """Rows of one node on one UTC day in a Parquet file. Times in nanoseconds of the epoch. Parts that were compacted
    share a file, each with its own rows; ``bytes`` and ``sha256`` are of the whole file."""

    path: FilePath
    node: int
    rows: int
    bytes: int
    sha256: str
    first_ns: int
    last_ns: int
    first_row: int = 0

    def joined(self, before: DataFile | None) -> DataFile:
        """Return the file with the rows of the node ``before`` these in it, which may be none."""
        if before is None:
            return self
        first_ns, last_ns = min(before.first_ns, self.first_ns), max(before.last_ns, self.last_ns)
        return msgspec.structs.replace(before, rows=before.rows + self.rows, first_ns=first_ns, last_ns=last_ns)


class Part(msgspec.Struct, frozen=True):
    """What was written at a time: bytes ``start`` to ``end`` of a log (None: all of a log that cannot be cut)."""

    id: str
    source: SourceId
    start: int
    end: int | None
    frames: int
    bad: dict[str, int]
    files: list[DataFile]
    events: DataFile | None = None
    calibrations: list[tuple[str, int, int, int]] = []
    """Changes of the active record (2103h:3), in order: channel, node-id, CRC-32 or 0, time."""

    @property
    def rows(self) -> int:
        """Rows in all files."""
        return sum(file.rows for file in self.files)


def files_of(parts: Iterable[Part]) -> Iterable[DataFile]:
    """Yield all files of parts, those of the events too."""
    for part in parts:
        yield from part.files
        if part.events is not None:
            yield part.events


class Source(msgspec.Struct, frozen=True):
    """One log. ``size``: its bytes that are in the dataset; hashes of its first ``head_bytes`` and of the last ones."""

    id: SourceId
    name: str
    head_bytes: int
    head_sha256: str
    size: int
    tail_sha256: str
    options: str
    """How it was decoded: layouts, signals, buses."""
    version: str
    """Of tipforce."""
    after: str | None
    """The log that this one continues."""
    flushed: bool
    """The rows that were open at its end are written; they are written again with what follows."""
    last_part_start: int
    before_last_part: State | None
    end: State
    begin_sha256: str = ""
    """Of the first bytes of its text, also where it is packed; "" for a short one."""


class Manifest(msgspec.Struct):
    """Everything that a dataset holds; in a file of ``CHANGED_FORMAT`` what one generation adds, and ``removed``."""

    format: int = FORMAT
    generation: int = 0
    sources: list[Source] = []
    parts: list[Part] = []
    columns: list[Column] = []
    """Of all files, in order."""
    replaced: list[FilePath] = []
    """Files of parts that this generation replaced: a writer that ended before it removed them leaves them behind."""
    since: int = 0
    """The last generation whose file holds everything."""
    removed: list[str] = []
    """Ids of parts."""

    def source(self, source_id: str | None) -> Source | None:
        """Return a log by its id."""
        return next((source for source in self.sources if source.id == source_id), None)

    def files(self) -> list[DataFile]:
        """Return each Parquet file of rows once, with all its rows."""
        by_path: dict[str, DataFile] = {}
        for file in (file for part in self.parts for file in part.files):
            by_path[file.path] = file.joined(by_path.get(file.path))
        return list(by_path.values())

    @property
    def first_ns(self) -> int | None:
        """Time of the first row."""
        return min((file.first_ns for file in self.files()), default=None)

    def paths(self) -> set[str]:
        """Return the paths of all files, those of the events too."""
        return {file.path for file in files_of(self.parts)}


@dataclass(slots=True)
class Change:
    """What a writer adds to the manifest that it has ``known``, which is not read again if it is the newest."""

    sources: dict[str, Source] = field(default_factory=dict)
    removed: set[str] = field(default_factory=set)
    """Ids of parts."""
    parts: list[Part] = field(default_factory=list)
    columns: list[Column] = field(default_factory=list)
    known: Manifest = field(default_factory=Manifest)

    def after(self, manifest: Manifest) -> Manifest:
        """Return the next generation's changes. Raises WriteError if another writer changed the same logs or parts."""
        for source_id, source in self.sources.items():
            before, now = self.known.source(source_id), manifest.source(source_id)
            if (now and (now.size, now.flushed)) != (before and (before.size, before.flushed)):
                name = (now or before or source).name
                raise WriteError(f"{name}: another run has added it meanwhile; run again to add what is still missing")
        gone = [part for part in manifest.parts if part.id in self.removed]
        if len(gone) < len(self.removed):
            raise WriteError("another run has replaced the same parts meanwhile; run again if work is left")
        known = {column.name for column in manifest.columns}
        columns = [column for column in self.columns if column.name not in known]
        after = Manifest(CHANGED_FORMAT, manifest.generation + 1, list(self.sources.values()), self.parts, columns)
        after.since, after.removed = manifest.since, sorted(self.removed)
        if gone:
            after.replaced = sorted({file.path for file in files_of(gone)} - with_changes(manifest, [after]).paths())
        return after


def with_changes(manifest: Manifest, changes: Iterable[Manifest]) -> Manifest:
    """Return a manifest with the changes of the generations that follow it."""
    sources = {source.id: source for source in manifest.sources}
    parts = {part.id: part for part in manifest.parts}
    columns, last = list(manifest.columns), manifest
    for last in changes:
        sources.update((source.id, source) for source in last.sources)
        for part_id in last.removed:
            parts.pop(part_id, None)
        parts.update((part.id, part) for part in last.parts)
        columns += last.columns
    everything = list(sources.values()), list(parts.values()), columns, last.replaced
    return Manifest(FORMAT, last.generation, *everything, manifest.since)


def read_manifest(store: Store, known: Manifest | None = None) -> Manifest | None:
    """Return the newest generation, ``known`` if it is this one; None for a directory that is no dataset. Raises
    InputError for a damaged one."""
    for _ in range(3):  # an old generation may vanish between the list and the read
        names = generations(store)
        if not names:
            return None
        if known is not None and names[-1] == _NAME.format(known.generation):
            return known
        with suppress(FileNotFoundError):
            newest = _read(store, names[-1])
            chain = [_read(store, _NAME.format(number)) for number in range(newest.since, newest.generation)]
            if all(file.since == newest.since for file in chain):
                return with_changes(chain[0], [*chain[1:], newest]) if chain else newest
    raise InputError(f"{store.name}: its manifest changes too fast to be read, or a file of it is missing; try again")


def _read(store: Store, name: str) -> Manifest:
    """Read the file of a generation. Raises InputError, FileNotFoundError."""
    with store.open(f"{FOLDER}/{name}") as file:
        text = file.read()
    try:
        manifest = msgspec.json.decode(text, type=Manifest)
        if manifest.format == FORMAT:
            manifest.since = manifest.generation
        is_change = manifest.format == CHANGED_FORMAT and 0 < manifest.since < manifest.generation
        if (manifest.format == FORMAT or is_change) and name == _NAME.format(manifest.generation):
            return manifest
        reason = f"format {manifest.format}, this tipforce reads {FORMAT}; generation {manifest.generation}"
    except msgspec.MsgspecError as error:
        reason = re.sub("matching regex .* - at", "with the name of a log or a file of a dataset, at", str(error))
    with suppress(msgspec.MsgspecError):
        sources = msgspec.json.decode(text, type=_Earlier).sources
        logs = ", ".join([str(source.get("name", "")) for source in sources[:3]] + ["..."] * (len(sources) > 3))
        raise InputError(
            f"{store.name}: an earlier tipforce wrote this dataset, in a layout that pandas and Polars do not "
            f"open: `tipforce decode LOGS -o NEW/` writes its logs again ({logs})"
        )
    raise InputError(
        f"{store.name}/{FOLDER}/{name}: not a manifest that this tipforce reads ({reason}): update it if a newer one "
        "wrote the dataset; otherwise put back a copy of the file, or decode the logs again into another directory"
    )


class _Earlier(msgspec.Struct):
    """A manifest of format 1, whose rows lie beside the events and the manifests."""

    format: Literal[1]
    sources: list[dict[str, Any]] = []


def commit(store: Store, change: Change) -> Manifest:
    """Add a change as the next generation, and remove what it replaces. Raises WriteError as ``Change.after`` does,
    OSError."""
    while True:
        before = read_manifest(store, change.known) or Manifest()
        remove_replaced(store, before)  # of a writer that ended: no later generation names these files
        written = change.after(before)
        manifest = with_changes(before, [written])
        if not before.since or manifest.generation - before.since > len(manifest.parts) // _PARTS_PER_CHANGE:
            manifest.since, written = manifest.generation, manifest
        if store.create(f"{FOLDER}/{_NAME.format(manifest.generation)}", msgspec.json.encode(written)):
            break
    for old in generations(store)[:-_KEPT_GENERATIONS]:
        if old < _NAME.format(manifest.since):
            store.remove(f"{FOLDER}/{old}")
    remove_replaced(store, manifest)
    return manifest


def remove_replaced(store: Store, manifest: Manifest) -> None:
    """Remove the files that this generation replaced."""
    for path in manifest.replaced:
        store.remove(path)


@contextmanager
def run_lock(store: Store, token: str) -> Iterator[None]:
    """Held while a run writes to a dataset in a directory of this machine. The system releases it with the process."""
    if store.local is None:
        yield
        return
    folder = store.local / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    file = os.open(store.path(f"{FOLDER}/{token}.run"), os.O_CREAT | os.O_RDWR)
    _lock(file)
    try:
        for mark in folder.glob("*.run"):
            if mark.stem != token and re.fullmatch(r"[0-9a-f]{12}\.run", mark.name) and not mark.is_symlink():
                with suppress(OSError):
                    _clean(store, mark)
        yield
    except BaseException:
        _remove_unlisted(store, store.local, token)
        raise
    finally:
        _remove_marks(folder / f"{token}.run")
        os.close(file)


def _clean(store: Store, mark: Path) -> None:
    """Remove what a run that was killed has left; one that still runs holds its lock. Raises OSError."""
    file = os.open(mark, os.O_RDWR)
    try:
        if _lock(file):
            _remove_unlisted(store, mark.parent.parent, mark.stem)
            _remove_marks(mark)
    finally:
        os.close(file)


def _remove_marks(mark: Path) -> None:
    shutil.rmtree(mark.with_suffix(""), ignore_errors=True)
    mark.unlink(missing_ok=True)


def _remove_unlisted(store: Store, root: Path, token: str) -> None:
    listed = (read_manifest(store) or Manifest()).paths()
    for pattern in (f"{ROWS}/hand=*/date=*/node=*/*-{token}.parquet", f"{EVENTS}/*-{token}.parquet"):
        for relative in {path.relative_to(root).as_posix() for path in root.glob(pattern)} - listed:
            store.remove(relative)


def _lock(file: int) -> bool:
    """Lock an open file for this process and those that it starts; False if another one has it."""
    try:
        import fcntl
    except ImportError:  # Windows: marks of other runs are left alone
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
