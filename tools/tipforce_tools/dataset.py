"""`tipforce dataset show|verify|compact DIR`: what it holds, and which files are not as its manifest says; and
`dataset sql`, a query with DuckDB."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tipforce.errors import InputError, needing
from tipforce.host.dataset.store import FOLDER, Store
from tipforce_tools.cli import common
from tipforce_tools.cli.common import shown_id
from tipforce_tools.cli.listening import counted

if TYPE_CHECKING:
    from tipforce.host.dataset.manifest import Manifest


def add_show_arguments(parser: argparse.ArgumentParser) -> None:
    """DIR: a directory, or a URL that fsspec opens. Exit code 1: a file is missing or damaged."""
    parser.add_argument("directory", metavar="DIR", help="of `tipforce decode -o DIR/`")
    common.add_output_arguments(parser)


add_verify_arguments = add_compact_arguments = add_show_arguments


def run_show(args: argparse.Namespace, *, hashes: bool = False) -> int:
    """Print the content: 0, or 1 if a file is missing or has another size, with ``hashes`` also another content."""
    from tipforce.host.dataset.reader import opened, wrong_files

    store, manifest = opened(args.directory)
    wrong = wrong_files(store, manifest, hashes=hashes)
    if args.json:
        common.print_json(record(store, manifest, wrong))
    else:
        print("\n".join(lines(store, manifest, wrong)))
        if hashes and not wrong:
            print(f"{len(manifest.files())} files are as they were written")
    return 1 if wrong else 0


run_verify = partial(run_show, hashes=True)


def run_compact(args: argparse.Namespace) -> int:
    """Join the files of a day: 0. Raises InputError, EnvironmentLackError without pyarrow."""
    from tipforce.host.dataset.reader import opened
    from tipforce_tools.writing.dataset_files import compact

    store, manifest = opened(args.directory)
    files = len(manifest.files())
    common.note(f"{store.name}: {files} files are {len(compact(store).files())} now")
    return 0


def record(store: Store, manifest: Manifest, wrong: dict[str, str]) -> dict[str, Any]:
    """Return the content as a JSON record."""
    from tipforce.host.dataset.reader import tally

    lost = tally(manifest).lost()
    return {
        "dataset": store.name,
        "generation": manifest.generation,
        "rows": sum(part.rows for part in manifest.parts),
        "files": len(manifest.files()),
        "bytes": sum(file.bytes for file in manifest.files()),
        "lost": sum(lost.values()),
        "nodes": [
            {"hand": hand, "node": node, "rows": rows, "days": days, "first_s": _s(first), "last_s": _s(last)}
            for (hand, node), (rows, days, first, last) in sorted(_nodes(manifest).items())
        ],
        "calibrations": [
            {"channel": channel, "node": node, "crc": crc, "from_s": _s(t_ns)}
            for (channel, node), told in _calibrations(manifest)
            for t_ns, crc in told
        ],
        "logs": [
            {
                "name": one.name,
                "bytes": one.size,
                "decoded": one.options,
                "version": one.version,
                "complete": one.flushed or any(other.after == one.id for other in manifest.sources),
                "parts": sum(part.source == one.id for part in manifest.parts),
                "bad": sum(sum(part.bad.values()) for part in manifest.parts if part.source == one.id),
            }
            for one in manifest.sources
        ],
        "unfinished_runs": sum(name.endswith(".run") for name in store.names(FOLDER)),
        "wrong": wrong,
    }


def _nodes(manifest: Manifest) -> dict[tuple[str, int], tuple[int, int, int, int]]:
    from tipforce.host.dataset.manifest import NO_DATE
    from tipforce.host.decoding.services import NO_TIME

    found: dict[tuple[str, int], tuple[int, set[str], int, int]] = {}
    for file in manifest.files():
        hand, date = (text.split("=", 1)[1] for text in file.path.split("/")[1:3])
        span = (NO_TIME, NO_TIME) if date == NO_DATE else (file.first_ns, file.last_ns)
        rows, days, first, last = found.get((hand, file.node), (0, set(), *span))
        found[hand, file.node] = rows + file.rows, days | {date}, min(first, span[0]), max(last, span[1])
    return {place: (rows, len(days), first, last) for place, (rows, days, first, last) in found.items()}


def _calibrations(manifest: Manifest) -> list[tuple[tuple[str, int], list[tuple[int, int]]]]:
    found: dict[tuple[str, int], list[tuple[int, int]]] = {}
    told = (one for part in manifest.parts for one in part.calibrations)
    for channel, node, crc, t_ns in sorted(told, key=lambda one: one[3]):
        of_node = found.setdefault((channel, node), [])
        if not of_node or of_node[-1][1] != crc:  # logs that were added apart tell it again
            of_node.append((t_ns, crc))
    return sorted(found.items())


def _s(t_ns: int) -> float | None:
    from tipforce.host.decoding.services import NO_TIME

    return None if t_ns == NO_TIME else t_ns / 1e9


def _utc(seconds: float | None) -> str:
    if seconds is None:
        return "an unknown time"
    return (datetime(1970, 1, 1) + timedelta(milliseconds=round(seconds * 1000))).isoformat(timespec="milliseconds")


def lines(store: Store, manifest: Manifest, wrong: dict[str, str]) -> Iterator[str]:
    """Yield the content as text."""
    found = record(store, manifest, wrong)
    yield (
        f"{store.name}: {found['rows']} samples, {found['lost']} lost, {found['files']} files, "
        f"{found['bytes'] / 1e6:.1f} MB, generation {manifest.generation}"
    )
    for node in found["nodes"]:
        first, last = (_utc(node[name]) for name in ("first_s", "last_s"))
        yield (
            f"{node['hand']} node {shown_id(node['node'])}: {node['rows']} samples on "
            f"{counted(node['days'], 'day')}, {first} to {last}"
        )
    for (channel, number), told in _calibrations(manifest):
        if len(told) > 1:
            texts = ", ".join(f"0x{crc:08X} from {_utc(_s(t_ns))}" for t_ns, crc in told)
            yield f"{channel} node {number}: rows of {counted(len(told), 'calibration')}: {texts}"
    for log in found["logs"]:
        bad = f", {log['bad']} bad lines" if log["bad"] else ""
        state = "" if log["complete"] else ", the rest is missing: run `tipforce decode` again"
        yield f"{log['name']}: {log['bytes']} bytes in {counted(log['parts'], 'part')}{bad}{state}"
    if found["unfinished_runs"]:
        yield f"runs that write now, or were ended: {found['unfinished_runs']}"
    for path, what in wrong.items():
        yield f"{path}: {what}"
    if wrong:
        yield "remove files that differ; then `tipforce decode` with their logs writes them again"


MEMORY_MIB = 2048
"""Of tables, sorts and groups; the process may have as much again, for texts and lists that DuckDB does not count."""
_THREADS = 8
_THREAD_BYTES = 136 << 20  # of addresses: its stack and its heap
_ROWS = 10_000
_SETTINGS = (
    "temp_directory = ''", f"threads = {_THREADS}",
    "python_enable_replacements = false", "autoinstall_known_extensions = false",
    "autoload_known_extensions = false", "enable_external_access = false", "lock_configuration = true",
)  # fmt: skip
_PLAIN = {
    "BOOLEAN", "TINYINT", "SMALLINT", "INTEGER", "BIGINT", "HUGEINT", "UTINYINT", "USMALLINT", "UINTEGER", "UBIGINT",
    "UHUGEINT", "FLOAT", "DOUBLE", "VARCHAR",
}  # fmt: skip
"""Types whose values JSON has; the others become texts in DuckDB, within its memory."""


def add_sql_arguments(parser: argparse.ArgumentParser) -> None:
    """DIR: a directory, or a URL that fsspec opens. Views: samples (hand, date, node and all columns of the rows),
    events (t_s, channel, node, event, code, text), parts and logs of the manifest. Only files that a
    query needs are read. A query is one SELECT: without --unrestricted it opens no other file, and has 2 GiB.

      tipforce dataset sql data/ "select node, max(P_N) from samples where date = '2026-05-17' group by node"
    """
    parser.add_argument("directory", metavar="DIR", help="of `tipforce decode -o DIR/`")
    parser.add_argument("sql", metavar="QUERY")
    parser.add_argument(
        "--unrestricted", action="store_true", help="also other statements, files, the network, and all memory"
    )
    common.add_output_arguments(parser)


def run_sql(args: argparse.Namespace) -> int:
    """Print the rows of a query; return 0. Raises InputError for a wrong one, EnvironmentLackError without DuckDB. A
    query reads the manifest's files and nothing else: it is one SELECT (COPY could write what a query may open), DuckDB
    opens no other file, loads no extension, sees no variable of Python, no setting can change, memory is limited."""
    from tipforce.host.dataset.reader import damaged, opened, wrong_files

    store, manifest = opened(args.directory)
    with needing("dataset sql needs DuckDB: `pip install 'tipforce[sql]'`"):
        import duckdb
    connection = duckdb.connect()
    try:
        views(connection, store, manifest)
        text = args.sql
        if not args.unrestricted:
            allowed = [_path(store, path) for path in manifest.paths()]
            connection.execute(f"set allowed_paths = {_list(allowed)}")
            for setting in (f"memory_limit = '{MEMORY_MIB}MiB'", *_SETTINGS):
                connection.execute(f"set {setting}")
            text = _select(duckdb, connection, text)
        with _limited_memory(not args.unrestricted):
            _print(connection, text, args)
    except (duckdb.Error, MemoryError) as error:
        if wrong := wrong_files(store, manifest, hashes=False):
            raise damaged(store, next(iter(wrong))) from error
        raise InputError(f"dataset sql: {_reason(duckdb, error)}") from error
    return 0


def _reason(duckdb: Any, error: BaseException) -> str:
    message, _, _ = str(error).partition("\n\n")  # then the query, with a mark below its error
    if isinstance(error, MemoryError | duckdb.OutOfMemoryException):
        return f"out of memory: a query has {MEMORY_MIB} MiB; --unrestricted lifts this limit"
    if isinstance(error, duckdb.PermissionException):
        message += "; a query reads the dataset alone: --unrestricted lifts this limit"
    return " ".join(message.split())


def _select(duckdb: Any, connection: Any, text: str) -> str:
    statements = connection.extract_statements(text)
    try:
        refused = [one.type for one in statements] != [duckdb.StatementType.SELECT]
    except ValueError:  # a statement that DuckDB has and its Python package does not name
        refused = True
    if refused:
        raise InputError("dataset sql: allowed is one SELECT; --unrestricted allows every statement")
    return str(statements[0].query).strip().rstrip(";")


@contextmanager
def _limited_memory(limited: bool) -> Iterator[None]:
    """Limit the memory of this process where the system can (Linux): an allocation beyond it fails."""
    status = Path("/proc/self/statm")
    if not limited or not status.exists():
        yield
        return
    import resource

    before, most = resource.getrlimit(resource.RLIMIT_AS)
    present = int(status.read_text().split()[0]) * resource.getpagesize()
    limit = present + (2 * MEMORY_MIB << 20) + _THREADS * _THREAD_BYTES
    allowed = [one for one in (limit, before, most) if one != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min(allowed), most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (before, most))


def _print(connection: Any, text: str, args: argparse.Namespace) -> None:
    if not args.json:
        found = connection.sql(text)
        if found is not None:
            found.show(max_width=240, max_rows=_ROWS)
        return
    names = None
    if not args.unrestricted:
        found = connection.sql(text)
        names = found.columns
        kinds = enumerate(map(str, found.types), 1)
        columns = (f"#{k}" if kind in _PLAIN else f"cast(#{k} as varchar)" for k, kind in kinds)
        text = f"select {', '.join(columns)} from ({text}\n)"
    connection.execute(text)
    names = names or [column[0] for column in connection.description or ()]
    if name := next((name for name in names if names.count(name) > 1), ""):  # an object has each name once
        raise InputError(f"dataset sql: {names.count(name)} columns are called {name}: rename one ({name} AS x)")
    while rows := connection.fetchmany(_ROWS) if names else []:
        for row in rows:
            values = (value if isinstance(value, str | int | float | bool | None) else str(value) for value in row)
            common.print_json(dict(zip(names, values, strict=True)))


def views(connection: Any, store: Store, manifest: Manifest) -> Any:
    """Add the views to a connection of DuckDB, and return it."""
    if store.filesystem is not None:
        connection.register_filesystem(store.filesystem)
    connection.sql("set timezone = 'UTC'")
    files = [_path(store, file.path) for file in manifest.files()]
    if files:
        options = "hive_partitioning = true, union_by_name = true"
        connection.sql(f"create view samples as select * from read_parquet({_list(files)}, {options})")
    events = {_path(store, part.events.path): None for part in manifest.parts if part.events is not None}
    rows = f"select * from read_parquet({_list([*events])})" if events else (
        "select now() as t_s, '' as channel, 0 as node, '' as event, '' as code, '' as text where false"
    )  # fmt: skip
    connection.sql(f"create view events as {rows}")
    names = {one.id: one.name for one in manifest.sources}
    _table(connection, "parts", "log varchar, first_byte bigint, frames bigint, samples bigint, bad_lines bigint",
           [(names[p.source], p.start, p.frames, p.rows, sum(p.bad.values())) for p in manifest.parts])  # fmt: skip
    _table(connection, "logs", "name varchar, bytes bigint, decoded varchar, version varchar",
           [(one.name, one.size, one.options, one.version) for one in manifest.sources])  # fmt: skip
    return connection


def _path(store: Store, relative: str) -> str:
    protocol = store.name.split("://")[0] + "://" if store.filesystem is not None else ""
    return protocol + store.path(relative)


def _list(paths: list[str]) -> str:
    return "[" + ", ".join("'" + path.replace("'", "''") + "'" for path in paths) + "]"


def _table(connection: Any, name: str, columns: str, rows: list[tuple[Any, ...]]) -> None:
    connection.sql(f"create table {name} ({columns})")
    if rows:
        marks = ", ".join("?" for _ in rows[0])
        connection.executemany(f"insert into {name} values ({marks})", rows)
