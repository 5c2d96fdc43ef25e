"""Query a dataset with DuckDB: views of its samples, events, parts and logs, over the files that its manifest lists."""

from __future__ import annotations

from argparse import Namespace
from typing import Any

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.host.dataset.manifest import Manifest
from tipforce.host.dataset.reader import damaged
from tipforce.host.dataset.store import Store
from tipforce_tools.cli import common
from tipforce_tools.dataset.content import wrong_files


def query(args: Namespace, store: Store, manifest: Manifest) -> int:
    """Print the rows of a query; return 0. Raises InputError for a wrong one, EnvironmentLackError without DuckDB."""
    try:
        import duckdb
    except ImportError:
        raise EnvironmentLackError("--sql needs DuckDB: `pip install 'tipforce[sql]'`") from None
    try:
        connection = views(duckdb.connect(), store, manifest)
        found = connection.sql(args.sql)
        if found is None:
            return 0
        if args.json:
            for row in found.fetchall():
                common.print_json(dict(zip(found.columns, map(_plain, row), strict=True)))
        else:
            found.show(max_width=240, max_rows=10_000)
    except duckdb.Error as error:
        if wrong := wrong_files(store, manifest, hashes=False):
            raise damaged(store, next(iter(wrong))) from error
        message, _, _ = str(error).partition("\n\n")  # then the query, with a mark below its error
        raise InputError(f"--sql: {' '.join(message.split())}") from error
    return 0


def _plain(value: Any) -> Any:
    return value if isinstance(value, str | int | float | bool | None) else str(value)


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
