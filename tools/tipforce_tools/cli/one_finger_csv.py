"""Check that a CSV file of gauge readings, such as `tipforce decode` writes, is of one fingertip."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.errors import InputError

if TYPE_CHECKING:
    from tipforce.host.configuration.measurements import Measurements

_COLUMNS = ("channel", "node")
_SHOWN = 5


def check_one_node(path: str | Path, data: Measurements) -> None:
    """Raises InputError if the columns of a decoded log name more than one node (or node and channel)."""
    if not any(name in data.ignored_columns for name in _COLUMNS):
        return
    with Path(path).open(encoding="utf-8-sig", newline="") as stream:
        rows = csv.reader(stream)
        header = [name.strip() for name in next(rows)]
        places = [header.index(name) for name in _COLUMNS if name in header]
        senders = {tuple(row[k].strip() for k in places) for row in rows if len(row) == len(header)}
    nodes = sorted({" ".join(key) for key in senders}, key=lambda text: (len(text), text))
    if len(nodes) > 1:
        shown = ", ".join(nodes[:_SHOWN]) + (", ..." if len(nodes) > _SHOWN else "")
        raise InputError(
            f"{path}: readings of {len(nodes)} nodes ({shown}), but a calibration is of one; write one file per node: "
            f"`tipforce decode LOG --nodes {nodes[0].split(' ')[-1]} --signals SG1,SG2,SG3 -o FILE.csv`, or "
            "estimate with `tipforce decode LOG --calibration NODE=CAL.toml` (repeat the option for each node)"
        )
