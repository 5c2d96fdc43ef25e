"""The Parquet files of a dataset: written by part, ``rows/hand=/date=/node=``, and joined to fewer ones."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import reduce
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import numpy.typing as npt

from tipforce.host.dataset import manifest as manifests
from tipforce.host.dataset.manifest import Change, DataFile, Manifest, Part, commit, files_of, read_manifest, run_lock
from tipforce.host.dataset.reader import damage_named
from tipforce.host.dataset.store import FOLDER, Store
from tipforce.host.decoding.sample_table import Table, place_of
from tipforce_tools.writing.text_rows import BASE, NODE
from tipforce_tools.writing.writers import Shape

if TYPE_CHECKING:
    from tipforce.host.decoding.services import BusEvent
    from tipforce_tools.writing.parquet import Parts

_DAY_NS = 86_400 * 10**9


class DatasetSink:
    """Writes files whose names contain ``token``, which no other run has. It can be sent to another process."""

    def __init__(self, directory: str, token: str, hand: str | None) -> None:
        """``hand``: value of the first partition; None: the name of the interface."""
        self._directory, self._token, self._hand = directory, token, hand
        self.names: list[str] = []
        """Of the parts by number."""

    def write(self, number: int, tables: Iterable[Table], shape: Shape) -> list[DataFile]:
        """Write the rows of a part, ``shape`` grows by their columns; each file appears when it is complete."""
        store, name = Store(self._directory), self.names[number]
        parts: dict[str, Parts] = {}  # by path in the dataset, as the files
        files: dict[str, DataFile] = {}
        with store.scratch(f"{FOLDER}/{self._token}") as scratch, ExitStack() as stack:
            for table in tables:
                from tipforce_tools.writing.parquet import Parts, arrow_table  # not before there are rows

                shape.take(table.columns, table.channels)
                order, cuts = _partitions(table)
                ordered = replace(table, t_ns=table.t_ns // 1000 * 1000).take(order)  # as the file has it
                rows = arrow_table(ordered, rows_schema(shape))
                for start, end in pairwise(cuts):
                    path = f"{_place(ordered, start, self._hand)}/{name}.parquet"
                    if path not in parts:
                        parts[path] = stack.enter_context(Parts(scratch / f"{name}-{len(parts)}"))
                    parts[path].add(rows.slice(start, end - start))
                    node, times = int(ordered.node[start]), ordered.t_ns[start:end]
                    file = DataFile(path, node, end - start, 0, "", int(times.min()), int(times.max()))
                    files[path] = file.joined(files.get(path))
            for path, part in parts.items():
                part.finish(rows_schema(shape), shape.channel)
                files[path] = put_file(store, part.path, files[path])
        return list(files.values())


def rows_schema(shape: Shape) -> Any:
    """Return the schema of a file of rows: the node stands in its path."""
    from tipforce_tools.writing.parquet import schema_of

    schema = schema_of(shape)
    return schema.remove(schema.get_field_index(NODE.name))


def put_file(store: Store, place: Path, file: DataFile) -> DataFile:
    """Move a complete local file into a dataset; return it with its size and its hash. Raises OSError."""
    with place.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    size = os.path.getsize(place)
    store.put(place, file.path)
    return msgspec.structs.replace(file, bytes=size, sha256=digest)


def events_file(store: Store, token: str, name: str, events: Sequence[BusEvent]) -> DataFile | None:
    """Write the events of a part; return their file, None for none. Raises OSError."""
    if not events:
        return None
    import pyarrow.parquet

    from tipforce_tools.writing.parquet import events_table

    times = [max(event.t_ns, 0) // 1000 * 1000 for event in events]
    file = DataFile(f"{manifests.EVENTS}/{name}.parquet", 0, len(events), 0, "", min(times), max(times))
    with store.scratch(f"{FOLDER}/{token}") as folder:
        pyarrow.parquet.write_table(events_table(events), folder / "events")
        return put_file(store, folder / "events", file)


def _partitions(table: Table) -> tuple[npt.NDArray[np.intp], list[int]]:
    day = table.t_ns // _DAY_NS if table.timed else np.zeros(len(table), dtype=np.int64)
    order = np.argsort(table.key, kind="stable") if (day == day[0]).all() else np.lexsort((day, table.key))
    key, day = table.key[order], day[order]
    cuts = np.flatnonzero((key[1:] != key[:-1]) | (day[1:] != day[:-1])) + 1
    return order, [0, *cuts.tolist(), len(key)]


def _place(table: Table, row: int, hand: str | None) -> str:
    channel, node = place_of(table.channels, int(table.key[row]))
    date = str(np.datetime64(int(table.t_ns[row]), "ns"))[:10] if table.timed else manifests.NO_DATE
    # Without characters that a path or a partition cannot have.
    name = "".join(mark if mark.isalnum() or mark in "-_." else "_" for mark in hand or channel)
    return f"{manifests.ROWS}/hand={name or '_'}/date={date}/node={node}"


def first_ns(parts: Iterable[Part]) -> int:
    """Return the time of the first row or event."""
    return min(file.first_ns for file in files_of(parts))


def joined_parts(
    store: Store, manifest: Manifest, parts: list[Part], name: str, left: Collection[str] = ()
) -> list[Part]:
    """Write the rows of these parts in files ``name``, and return the parts. All files get the columns of the manifest.
    Files at the paths ``left`` stay as they are. Raises LogError for a damaged file, OSError."""
    begins = {part.source: first_ns(one for one in parts if one.source == part.source) for part in parts}
    order = sorted(parts, key=lambda part: (begins[part.source], part.source, part.start))
    runs = _runs(manifest, order)
    places: dict[str, list[tuple[int, DataFile]]] = {}
    found: list[list[DataFile]] = [[file for file in files_of(run) if file.path in left] for run in runs]
    for number, run in enumerate(runs):
        for file in files_of(run):
            if file.path not in left:
                places.setdefault(file.path.rpartition("/")[0], []).append((number, file))
    for place, files in places.items():
        for number, file in _joined_files(store, manifest, files, f"{place}/{name}.parquet"):
            found[number].append(file)
    return [_part(run, files, f"{name}/{number}") for number, (run, files) in enumerate(zip(runs, found, strict=True))]


def _runs(manifest: Manifest, parts: list[Part]) -> list[list[Part]]:
    """Return parts of a log that follow each other together; its last one alone, which may be written again."""
    last_starts = {source.id: source.last_part_start for source in manifest.sources}
    runs: list[list[Part]] = []
    for part in parts:
        before = runs[-1][-1] if runs else None
        follows = before is not None and (before.source, before.end) == (part.source, part.start)
        if follows and part.start < last_starts[part.source]:
            runs[-1].append(part)
        else:
            runs.append([part])
    return runs


def _part(run: list[Part], files: list[DataFile], name: str) -> Part:
    bad: Counter[str] = sum((Counter(part.bad) for part in run), Counter())
    return msgspec.structs.replace(
        run[0], id=name, end=run[-1].end, frames=sum(part.frames for part in run), bad=dict(bad),
        files=[file for file in files if not _of_events(file.path)],
        events=next((file for file in files if _of_events(file.path)), None),
        calibrations=[one for part in run for one in part.calibrations],
    )  # fmt: skip


def _of_events(path: str) -> bool:
    return path.startswith(f"{manifests.EVENTS}/")


def _joined_files(
    store: Store, manifest: Manifest, files: list[tuple[int, DataFile]], path: str
) -> Iterator[tuple[int, DataFile]]:
    """Write the rows of files one after the other; yield by number the rows of each in the new one."""
    import pyarrow.parquet as pq

    from tipforce_tools.writing import parquet

    shape, first_row = Shape(BASE), 0
    shape.take(manifest.columns, ())
    schema = parquet.EVENTS if _of_events(path) else rows_schema(shape)
    with store.scratch(f"{FOLDER}/{path.rpartition('-')[2].removesuffix('.parquet')}") as folder:
        scratch = folder / "joined"
        with parquet.Parts(scratch) as parts:
            for place, some in groupby((file for _, file in files), key=lambda file: file.path):
                with damage_named(store, place), store.open(place) as stream:
                    rows = parquet.widened(pq.ParquetFile(stream).read(), schema, "")
                for file in some:
                    parts.add(rows.slice(file.first_row, file.rows))
            parts.finish(schema, "")
        written = put_file(store, scratch, msgspec.structs.replace(files[0][1], path=path, first_row=0))
    for number, same in groupby(files, key=lambda numbered: numbered[0]):
        whole = reduce(lambda before, file: file.joined(before), [file for _, file in same])
        of_run = whole.rows, written.bytes, written.sha256, whole.first_ns, whole.last_ns, first_row
        yield number, DataFile(path, whole.node, *of_run)
        first_row += whole.rows


SHARED_BYTES = 256_000_000
"""Most bytes of the files of parts that are joined; one file is a node's share of it."""


def compact(store: Store) -> Manifest:
    """Join files, give all the same columns; the last part, which is written again with what follows, stays apart."""
    token = uuid.uuid4().hex[:12]
    manifest = read_manifest(store) or Manifest()
    with run_lock(store, token):
        for number, parts in enumerate(_groups(store, manifest)):
            name = f"{parts[0].source}-{parts[0].start:014d}-{number}-{token}"
            change = Change(parts=joined_parts(store, manifest, parts, name), known=manifest)
            change.removed.update(part.id for part in parts)
            manifest = commit(store, change)
    return manifest


def _groups(store: Store, manifest: Manifest) -> Iterator[list[Part]]:
    """Yield the parts of a day that will share files."""
    lasts = {source.options: (source.id, source.last_part_start) for source in manifest.sources}.values()
    shared: dict[str, list[Part]] = {}  # parts by the name of their files
    for part in manifest.parts:
        for file in list(files_of([part]))[:1]:
            shared.setdefault(file.path.rpartition("/")[2], []).append(part)
    parted = [parts for parts in shared.values() if not any((part.source, part.start) in lasts for part in parts)]
    parted.sort(key=first_ns)
    for _, of_day in groupby(parted, key=lambda parts: first_ns(parts) // _DAY_NS):
        groups: list[list[list[Part]]] = []
        size = 0
        for parts in of_day:
            bytes_of_parts = sum({file.path: file.bytes for file in files_of(parts)}.values())
            if not groups or size + bytes_of_parts > SHARED_BYTES:
                groups.append([])
                size = 0
            groups[-1].append(parts)
            size += bytes_of_parts
        yield from ([part for parts in group for part in parts] for group in groups if _gains(store, manifest, group))


def _gains(store: Store, manifest: Manifest, group: list[list[Part]]) -> bool:
    """Return whether a group has several files for one, or one without columns that others have."""
    import pyarrow.parquet as pq

    file = next((file for part in group[0] for file in part.files), None)
    if len(group) > 1 or file is None:
        return len(group) > 1
    with damage_named(store, file.path), store.open(file.path) as stream:
        return not {column.name for column in manifest.columns} <= set(pq.ParquetFile(stream).schema_arrow.names)
