"""Read logs, and a dataset as a log is read: tables of samples, only of the files and columns that are needed."""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from tipforce.arrays import IntArray
from tipforce.errors import EnvironmentLackError, InputError, LogError
from tipforce.host.dataset.store import Store, is_dataset, is_url, local_copy
from tipforce.host.decoding.counters import Tally
from tipforce.host.decoding.log_part import Piece, Progress, Reading
from tipforce.host.decoding.recording import Recording, Tap
from tipforce.host.decoding.sample_table import NO_COUNTER, NODE_BITS, Column, Table, in_order, is_missing, missing_of
from tipforce.host.logs.notes import LogNotes
from tipforce.host.logs.reader import open_log

if TYPE_CHECKING:
    from tipforce.host.dataset.manifest import DataFile, Manifest

_FOREVER = np.iinfo(np.int64).max


def need_pyarrow(name: str) -> None:
    """Raise EnvironmentLackError without pyarrow, which is not imported yet; InputError for a path it cannot open."""
    if find_spec("pyarrow") is None:
        raise EnvironmentLackError(f"{name}: a dataset needs pyarrow: `pip install 'tipforce[parquet]'`")
    if re.search("[\ud800-\udfff]", os.path.realpath(name)):
        raise InputError(f"{name}: its path is not UTF-8, which Parquet files need: rename it")


def opened(name: str) -> tuple[Store, Manifest]:
    """Return a dataset's files and its manifest. Raises InputError, EnvironmentLackError without pyarrow."""
    from tipforce.host.dataset.manifest import read_manifest  # not where only logs are read

    need_pyarrow(name)
    store = Store(name)
    if (manifest := read_manifest(store)) is None:
        raise InputError(f"{name}: is not a dataset of `tipforce decode -o DIR/`")
    return store, manifest


def logs_named(word: str) -> list[str]:
    """Return the logs of a name or a pattern, run-2.log before run-10.log. Raises InputError where there is none."""
    if is_url(word) or os.path.exists(word):
        return [word]
    names = glob.glob(word, recursive=True) if glob.has_magic(word) else []
    if not names:
        raise InputError(f"{word}: no {'file matches' if glob.has_magic(word) else 'such file'}")
    return sorted(names, key=lambda name: [(int(p), "") if p.isdigit() else (-1, p) for p in re.split(r"(\d+)", name)])


def start_of(name: str) -> int | None:
    """Return the time of the first frame of a log, or row of a dataset; None if it has none. Raises InputError."""
    if is_dataset(name):
        return opened(name)[1].first_ns
    with open_log(name) as log:
        return next((int(block["t_ns"][0]) for block in log), None)


def tables_of_logs(
    recording: Recording, names: Iterable[str], progress: Progress | None = None, tap: Tap | None = None
) -> Iterator[Table]:
    """Read logs in this process as if they were one recording; a dataset gives the rows that it has. ``tap`` gets the
    selected frames before their samples. Raises InputError, StrictError."""
    for name in names:
        if not is_dataset(name):
            yield from recording.tables_of_piece(Piece(local_copy(name)), progress, tap)
            continue
        _, manifest = opened(name)
        bad: Counter[str] = sum((Counter(part.bad) for part in manifest.parts), Counter())
        recording.notes.append(LogNotes(source=name, frames=sum(part.frames for part in manifest.parts), bad=dict(bad)))
        recording.tally.append(tally(manifest))
        for table in tables(name, recording.reading):
            recording.numbers_of(table.channels)
            yield table
    yield from recording.finish()


def tally(manifest: Manifest) -> Tally:
    """Return the counts of all logs."""
    total, followed = Tally(), {source.after for source in manifest.sources}
    for source in manifest.sources:
        if source.id not in followed:
            total.append(Tally.of_rows(source.end.tally, source.end.short))
    return total


def tables(name: str, reading: Reading) -> Iterator[Table]:
    """Yield the samples that ``reading`` selects, of compacted parts together, in the order of their times."""
    store, manifest = opened(name)
    start, end = reading.limits(reading.origin_ns or manifest.first_ns or 0)
    limits = -_FOREVER if start is None else start, _FOREVER if end is None else end
    wanted = [column for column in manifest.columns if reading.signals is None or column.signal in reading.signals]
    channels: list[str] = []
    written: dict[str, list[DataFile]] = {}  # files of one name are of the same parts
    for file in manifest.files():
        written.setdefault(file.path.rpartition("/")[2], []).append(file)
    for files in sorted(written.values(), key=lambda some: min(file.first_ns for file in some)):
        with damage_named(store, *(file.path for file in files)):
            table = _read_table(store, files, reading, wanted, channels, limits)
        if table is not None and len(table):
            yield table


@contextmanager
def damage_named(store: Store, *paths: str) -> Iterator[None]:
    """Raise LogError for one of these files that cannot be read, with the next step."""
    import pyarrow as pa

    from tipforce.host.dataset.manifest import read_manifest

    try:
        yield
    except (OSError, pa.ArrowException) as error:
        now = read_manifest(store)
        if now is not None and not set(paths) <= now.paths():
            raise LogError(f"{store.name}: another run has replaced a part meanwhile; run this again") from error
        raise damaged(store, error) from error


def damaged(store: Store, reason: object) -> LogError:
    """Return the error of a file that is not as it was written, with the next step."""
    return LogError(
        f"{store.name}: a file is missing or damaged ({reason}); `tipforce dataset verify {store.name}` lists such "
        "files: remove them, then `tipforce decode` with their logs writes them again"
    )


def _read_table(
    store: Store, files: list[DataFile], reading: Reading, wanted: list[Column], channels: list[str],
    span: tuple[int, int],
) -> Table | None:  # fmt: skip
    import pyarrow as pa

    nodes = reading.layouts.nodes
    read = []
    for file in files:
        if file.last_ns < span[0] or file.first_ns >= span[1] or (nodes is not None and file.node not in nodes):
            continue
        rows = _rows(store, file.path, [column.name for column in wanted], span)
        read.append(rows.append_column("node", pa.array(np.full(len(rows), file.node, dtype=np.uint8))))
    if not read:
        return None
    rows = pa.concat_tables(read, promote_options="default")
    timed = rows["t_s"].null_count == 0
    t_ns = 1000 * rows["t_s"].cast(pa.int64()).fill_null(0).to_numpy()
    table = _table(rows, wanted, channels, t_ns, timed).take(np.argsort(t_ns, kind="stable"))
    if reading.signals is not None:  # a row of another PDO alone has neither them nor a sample's counter
        there = [~is_missing(column, table.values[column.name]) for column in table.columns]
        table = table.take(np.flatnonzero(np.logical_or.reduce([table.counter != NO_COUNTER, *there])))
    if reading.buses is None:
        return table
    keep = np.array([name in reading.buses for name in table.channels])[table.channel]
    return table.take(np.flatnonzero(keep))


def _rows(store: Store, path: str, names: list[str], span: tuple[int, int]) -> Any:
    """Return the rows of a file in a time span; row groups outside are not read."""
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    file = pq.ParquetFile(store.open(path) if store.filesystem is not None else store.path(path))
    there = file.schema_arrow.names
    columns = [name for name in ("t_s", "channel", "counter", *names) if name in there]
    if span == (-_FOREVER, _FOREVER):
        return file.read(columns)
    start_us, end_us = -(-span[0] // 1000), -(-span[1] // 1000)

    def is_within(number: int) -> bool:
        times = file.metadata.row_group(number).column(there.index("t_s")).statistics
        known = times is not None and times.has_min_max
        return not known or (times.max_raw >= start_us and times.min_raw < end_us)

    rows = file.read_row_groups(list(filter(is_within, range(file.num_row_groups))), columns)
    t_us = rows["t_s"].cast(pa.int64())
    return rows.filter(pc.and_(pc.greater_equal(t_us, start_us), pc.less(t_us, end_us)))


def _table(rows: Any, wanted: list[Column], channels: list[str], t_ns: IntArray, timed: bool) -> Table:
    names = rows["channel"].combine_chunks().dictionary_encode()
    here = names.dictionary.to_pylist()
    channels += [name for name in here if name not in channels]
    numbers = np.array([channels.index(name) for name in here], dtype=np.uint16)
    key = (numbers[names.indices.to_numpy()] << NODE_BITS | rows["node"].to_numpy()).astype(np.uint16)
    counter = rows["counter"].fill_null(NO_COUNTER).to_numpy()
    columns = in_order([column for column in wanted if column.name in rows.column_names])
    values = {column.name: _values(rows[column.name], column) for column in columns}
    return Table(t_ns, key, counter, counter != NO_COUNTER, columns, values, {}, tuple(channels), timed)


def _values(array: Any, column: Column) -> Any:
    """Return the values as a decoder has them, with its marks for missing ones."""
    mark = missing_of(column, 1)
    array = array.cast("int8") if column.kind == "flag" else array
    return (array.fill_null(mark[0].item()) if array.null_count else array).to_numpy().astype(mark.dtype, copy=False)


def wrong_files(store: Store, manifest: Manifest, *, hashes: bool) -> dict[str, str]:
    """Return by path what is wrong with a file: it is missing, or its size or (with ``hashes``) its content differs."""
    import hashlib

    from tipforce.host.dataset.manifest import files_of

    wrong = {}
    for file in {file.path: file for file in files_of(manifest.parts)}.values():
        try:
            with store.open(file.path) as stream:
                changed = hashes and hashlib.sha256(stream.read()).hexdigest() != file.sha256
                if changed or stream.seek(0, os.SEEK_END) != file.bytes:
                    wrong[file.path] = "differs from what was written"
        except OSError as error:
            wrong[file.path] = "is missing" if isinstance(error, FileNotFoundError) else str(error)
    return wrong
