"""The rows and files of datasets, for the tests of `tipforce decode -o DIR/`."""

from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from tipforce.host.dataset.reader import opened
from tools.decode.logs import decode


def rows_of_dataset(directory: Path) -> list[tuple[Any, ...]]:
    """All rows by the manifest, without missing values, in the order of node and time."""
    store, manifest = opened(str(directory))
    tables = [(file.node, pq.ParquetFile(store.path(file.path)).read()) for file in manifest.files()]
    return sorted(_cells(row | {"node": node}) for node, table in tables for row in table.to_pylist())


def _cells(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(sorted((k, str(v)) for k, v in row.items() if v is not None))


def rows_of_logs(*names: Path) -> list[tuple[Any, ...]]:
    """The rows of one decode to a file."""
    path = names[0].with_suffix(".one.parquet")
    assert decode(*names, "-j", 1, "-o", path) == 0
    return sorted(_cells({"channel": "vcan0"} | row) for row in pq.read_table(path).to_pylist())


def globbed(directory: Path) -> set[str]:
    """The Parquet files that a query engine finds."""
    return {str(path.relative_to(directory)) for path in directory.glob("rows/**/*") if path.is_file()}
