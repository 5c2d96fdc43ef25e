"""Write the rows of several parts of a dataset in common files, one for each hand, day and node."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from itertools import groupby

import msgspec
import pyarrow.parquet as pq

from tipforce.host.dataset.manifest import EVENTS, DataFile, Manifest, Part, files_of, joined
from tipforce.host.dataset.reader import damage_named
from tipforce.host.dataset.store import FOLDER, Store
from tipforce_tools.decode import parquet
from tipforce_tools.decode.dataset_sink import BASE, put_file, rows_schema
from tipforce_tools.decode.writers import Shape


def first_ns(parts: Iterable[Part]) -> int:
    """Return the time of the first row or event."""
    return min(file.first_ns for file in files_of(parts))


def joined_parts(
    store: Store, manifest: Manifest, parts: list[Part], name: str, left: Collection[str] = ()
) -> list[Part]:
    """Write the rows of these parts in files ``name``, and return the parts. All files get the columns of the manifest.

    Files at the paths ``left`` stay as they are. Raises LogError for a damaged file, OSError.
    """
    begins = {part.source: first_ns(one for one in parts if one.source == part.source) for part in parts}
    order = sorted(parts, key=lambda part: (begins[part.source], part.source, part.start))
    runs = _runs(manifest, order)
    places: dict[str, list[tuple[int, DataFile]]] = {}
    found: list[list[DataFile]] = [[] for _ in runs]
    for number, run in enumerate(runs):
        for file in files_of(run):
            if file.path in left:
                found[number].append(file)
            else:
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
    bad: dict[str, int] = {}
    for part in run:
        for reason, count in part.bad.items():
            bad[reason] = bad.get(reason, 0) + count
    return msgspec.structs.replace(
        run[0],
        id=name,
        end=run[-1].end,
        frames=sum(part.frames for part in run),
        bad=bad,
        files=[file for file in files if not _of_events(file)],
        events=next(filter(_of_events, files), None),
        calibrations=[one for part in run for one in part.calibrations],
    )


def _of_events(file: DataFile) -> bool:
    return file.path.startswith(f"{EVENTS}/")


def _joined_files(
    store: Store, manifest: Manifest, files: list[tuple[int, DataFile]], path: str
) -> Iterator[tuple[int, DataFile]]:
    """Write the rows of files one after the other; yield by number the rows of each in the new one."""
    shape = Shape(BASE)
    shape.take(manifest.columns, ())
    schema = parquet.EVENTS if path.startswith(f"{EVENTS}/") else rows_schema(shape)
    with store.scratch(f"{FOLDER}/{path.rpartition('-')[2].removesuffix('.parquet')}") as folder:
        scratch = folder / "joined"
        parts = parquet.Parts(scratch)
        try:
            for place, some in groupby((file for _, file in files), key=lambda file: file.path):
                with damage_named(store, place), store.open(place) as stream:
                    rows = parquet.widened(pq.ParquetFile(stream).read(), schema, "")
                for file in some:
                    parts.add(rows.slice(file.first_row, file.rows))
            parts.finish(schema, "")
        except BaseException:
            parts.abort()
            raise
        size, digest = put_file(store, scratch, path)
    first_row = 0
    for number, same in groupby(files, key=lambda one: one[0]):
        file = joined([file for _, file in same])
        yield number, msgspec.structs.replace(file, path=path, bytes=size, sha256=digest, first_row=first_row)
        first_row += file.rows
