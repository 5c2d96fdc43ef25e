"""Join small files of a dataset: the parts of a day, of whatever logs, share one file for each hand and node."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from itertools import groupby

import pyarrow.parquet as pq

from tipforce.host.dataset.manifest import Change, Manifest, Part, commit, files_of, read_manifest
from tipforce.host.dataset.reader import damage_named
from tipforce.host.dataset.run_lock import RunLock
from tipforce.host.dataset.store import Store
from tipforce_tools.decode.dataset_join import first_ns, joined_parts

SHARED_BYTES = 256_000_000
"""Most bytes of the files of parts that are joined; one file is a node's share of it."""
_DAY_NS = 86_400 * 10**9


def compact(store: Store) -> Manifest:
    """Join files, give all the same columns, and return the new manifest.

    The last part of the log that was added last stays: it is written again with what follows it.
    """
    token = uuid.uuid4().hex[:12]
    manifest = read_manifest(store) or Manifest()
    with RunLock(store, token):
        for number, parts in enumerate(_groups(store, manifest)):
            name = f"{parts[0].source}-{parts[0].start:014d}-{number}-{token}"
            change = Change(parts=joined_parts(store, manifest, parts, name))
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
        group: list[list[Part]] = []
        size = 0
        for parts in of_day:
            bytes_of_parts = sum({file.path: file.bytes for file in files_of(parts)}.values())
            if group and size + bytes_of_parts > SHARED_BYTES:
                yield from _worth_it(store, manifest, group)
                group, size = [], 0
            group.append(parts)
            size += bytes_of_parts
        yield from _worth_it(store, manifest, group)


def _worth_it(store: Store, manifest: Manifest, group: list[list[Part]]) -> Iterator[list[Part]]:
    """Yield the parts of a group that has several files for one, or one without columns that others have."""
    parts = [part for some in group for part in some]
    alone = len(group) == 1
    if alone and (file := next((file for part in parts for file in part.files), None)):
        with damage_named(store, file.path), store.open(file.path) as stream:
            alone = {column.name for column in manifest.columns} <= set(pq.ParquetFile(stream).schema_arrow.names)
    if not alone:
        yield parts
