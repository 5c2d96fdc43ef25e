"""Write the decoded samples of a run as CSV: one row per PDO, a column per signal, in the DBC's units."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from tipforce.host.decoding.decoder import Samples
from tipforce.output_file import CSV, new_file


def write_table(path: str | Path, messages: dict[tuple[int, str], Samples]) -> None:
    """Write columns t_s, node, message, then the signals; a cell is empty if a PDO has no such signal or no value.

    Rows are in the order of the frames. Raises InputError for an unusable path, WriteError if writing fails.
    """
    names = list(dict.fromkeys(name for samples in messages.values() for name in samples.columns))
    rows: list[tuple[int, int, list[object]]] = []
    for (node_id, message), samples in messages.items():
        columns = [_cells(samples.columns.get(name), len(samples.t_ns), _digits(samples, name)) for name in names]
        for k, (t_ns, row) in enumerate(zip(samples.t_ns.tolist(), samples.row.tolist(), strict=True)):
            rows.append((row, node_id, [f"{1e-9 * t_ns:.6f}", node_id, message, *(cells[k] for cells in columns)]))
    rows.sort(key=lambda entry: entry[:2])
    with new_file(path, CSV) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["t_s", "node", "message", *names])
        writer.writerows(cells for _, _, cells in rows)


def _digits(samples: Samples, name: str) -> int:
    """Return the number of decimals for the signal's resolution."""
    scale = next((signal.scale for signal in samples.message.signals if signal.name == name), 1.0)
    return len(f"{scale:.9f}".rstrip("0").partition(".")[2])


def _cells(column: Any, count: int, digits: int) -> list[str]:
    if column is None:
        return [""] * count
    if column.dtype.kind == "f":
        return ["" if np.isnan(value) else f"{value:.{digits}f}" for value in column]
    return [str(int(value)) for value in column]
