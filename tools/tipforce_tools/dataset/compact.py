"""Join small files of a dataset: parts of one log that follow each other become one part."""

from __future__ import annotations

import hashlib
import os
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from tipforce.host.dataset.manifest import Change, DataFile, Manifest, Part, commit, read_manifest
from tipforce.host.dataset.reader import damage_named
from tipforce.host.dataset.run_lock import RunLock
from tipforce.host.dataset.store import Store
from tipforce_tools.decode.parquet import OPTIONS, ROW_GROUP_ROWS

PART_BYTES = 256_000_000
"""Most bytes of a part of several; one file is a node's share of it."""


def compact(store: Store) -> Manifest:
    """Join parts, and return the new manifest. The last part of a log stays: it may be written again."""
    token = uuid.uuid4().hex[:12]
    manifest = read_manifest(store) or Manifest()
    with RunLock(store, token):
        for number, group in enumerate(_groups(manifest)):
            change = Change(parts=[_joined(store, group, f"{group[0].source}-{group[0].start:014d}-{number}-{token}")])
            change.removed.update(part.id for part in group)
            manifest = commit(store, change)
    return manifest


def _groups(manifest: Manifest) -> Iterator[list[Part]]:
    """Yield parts that become one."""
    for source in manifest.sources:
        parts = sorted((one for one in manifest.parts if one.source == source.id), key=lambda one: one.start)[:-1]
        group: list[Part] = []
        size = 0
        for part in parts:
            bytes_of_part = sum(file.bytes for file in part.files)
            if group and size + bytes_of_part > PART_BYTES:
                yield from [group] if len(group) > 1 else []
                group, size = [], 0
            group.append(part)
            size += bytes_of_part
        yield from [group] if len(group) > 1 else []


def _joined(store: Store, parts: list[Part], name: str) -> Part:
    places: dict[str, list[DataFile]] = {}
    for part in parts:
        for file in part.files:
            places.setdefault(file.path.rsplit("/", 1)[0], []).append(file)
    files = [_joined_file(store, parts, files, f"{place}/{name}.parquet") for place, files in places.items()]
    bad: dict[str, int] = {}
    for part in parts:
        for reason, count in part.bad.items():
            bad[reason] = bad.get(reason, 0) + count
    events = [part.events for part in parts if part.events is not None]
    return Part(name, parts[0].source, parts[0].start, parts[-1].end, sum(p.frames for p in parts), bad, files,
                _joined_events(store, events, f"events/{name}.csv"),
                [one for part in parts for one in part.calibrations])  # fmt: skip


def _joined_file(store: Store, parts: list[Part], files: list[DataFile], path: str) -> DataFile:
    tables = []
    for file in files:
        with damage_named(store, *parts), store.open(file.path) as stream:
            tables.append(pq.ParquetFile(stream).read())
    rows = pa.concat_tables(tables, promote_options="default")
    with tempfile.TemporaryDirectory(prefix="tipforce-") as folder:
        scratch = Path(folder) / "joined.parquet"
        pq.write_table(rows, scratch, row_group_size=ROW_GROUP_ROWS, **OPTIONS)
        digest = hashlib.sha256(scratch.read_bytes()).hexdigest()
        size = os.path.getsize(scratch)
        store.put(scratch, path)
    first, last = min(file.first_ns for file in files), max(file.last_ns for file in files)
    return DataFile(path, files[0].node, len(rows), size, digest, first, last)


def _joined_events(store: Store, files: list[DataFile], path: str) -> DataFile | None:
    if len(files) < 2:
        return files[0] if files else None
    texts = [store.read(file.path).split(b"\n", 1) for file in files]
    content = texts[0][0] + b"\n" + b"".join(rows for _, rows in texts)
    store.create(path, content)
    first, last = min(file.first_ns for file in files), max(file.last_ns for file in files)
    return DataFile(path, 0, sum(f.rows for f in files), len(content), hashlib.sha256(content).hexdigest(), first, last)
