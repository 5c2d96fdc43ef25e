"""What a run keeps: every frame, for the decoder and for a log; a table and a plot of the results."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import TextIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tipforce.errors import EnvironmentLackError, WriteError
from tipforce.host.frames.frame_array import FRAME, FrameArray, RawFrame, frame_array
from tipforce.output_file import CANDUMP_LOG, CSV, FIGURES, NewFile, new_file, save_figure

if TYPE_CHECKING:
    from tipforce.host.decoding.decoder import Samples
    from tipforce.scene.results import Contact

BLOCK_FRAMES = 16_384
_LABELS = ("P (N)", "phi (degree)", "theta (degree)")


class Recording:
    """Record frames in the order of their times. With ``log`` each is also written to that file. A context manager.

    Raises InputError for an unusable path of the log, WriteError when it cannot be written; then an old log stays.
    """

    def __init__(self, log: str | Path | None = None, interface: str = "sim0", start_ns: int = 0) -> None:
        """``start_ns``: time 0 in the log, nanoseconds of the epoch."""
        self.start_ns = start_ns
        self.counts: dict[int, int] = {}
        """Frames by COB-ID."""
        self._rows: list[RawFrame] = []
        self._blocks: list[FrameArray] = []
        self._interface = interface
        self._log: NewFile | None = None
        if log is not None:
            from tipforce.host.logs.candump_format import CandumpFormat  # loaded only here

            self._format, self._log = CandumpFormat(log=True), NewFile(log, CANDUMP_LOG)
            self._file: TextIOBase = self._log.partial.open("w", encoding="ascii", newline="\n")

    def add(self, t_us: int, can_id: int, data: bytes) -> None:
        """Record one frame."""
        self._rows.append((1000 * t_us, can_id, data))
        self.counts[can_id] = self.counts.get(can_id, 0) + 1
        if len(self._rows) >= BLOCK_FRAMES:
            self._flush()

    def frames(self) -> FrameArray:
        """Return all frames so far, FRAME array (n,)."""
        self._flush()
        self._blocks = [np.concatenate(self._blocks)] if self._blocks else [np.zeros(0, dtype=FRAME)]
        return self._blocks[0]

    def _flush(self) -> None:
        if not self._rows:
            return
        frames = frame_array(self._rows)
        self._rows.clear()
        self._blocks.append(frames)
        if self._log is not None:
            from tipforce.host.frames.frame_block import CandumpBlock

            dated = frames.copy()
            dated["t_ns"] += self.start_ns
            try:
                block = CandumpBlock(dated, (self._interface,))
                self._file.write("\n".join([*self._format.lines(block), ""]))
            except OSError as error:
                raise self._log.failed(error) from error

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # Nothing received is lost.
        complete = kind is None or issubclass(kind, (KeyboardInterrupt, EnvironmentLackError))
        try:
            if complete:
                self._flush()
        except WriteError:
            complete = False
            raise
        finally:
            if self._log is not None:
                try:
                    self._file.close()
                except OSError as error:
                    self._log.drop()
                    raise self._log.failed(error) from error
                self._log.keep() if complete else self._log.drop()


def write_table(path: str | Path, messages: dict[tuple[int, str], Samples]) -> None:
    """Write columns t_s, node, message, then the signals; a cell is empty if a PDO has no such signal or no value.

    Rows are in the order of the frames. Raises InputError for an unusable path, WriteError if writing fails.
    """
    names = list(dict.fromkeys(name for samples in messages.values() for name in samples.columns))
    rows: list[tuple[int, int, list[object]]] = []
    for (node_id, message), samples in messages.items():
        scales = {signal.name: signal.scale for signal in samples.message.signals}
        digits = {name: len(f"{scale:.9f}".rstrip("0").partition(".")[2]) for name, scale in scales.items()}
        columns = [_cells(samples.columns.get(name), len(samples.t_ns), digits.get(name, 0)) for name in names]
        for k, (t_ns, row) in enumerate(zip(samples.t_ns.tolist(), samples.row.tolist(), strict=True)):
            rows.append((row, node_id, [f"{1e-9 * t_ns:.6f}", node_id, message, *(cells[k] for cells in columns)]))
    rows.sort(key=lambda entry: entry[:2])
    with new_file(path, CSV) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["t_s", "node", "message", *names])
        writer.writerows(cells for _, _, cells in rows)


def _cells(column: Any, count: int, digits: int) -> list[str]:
    if column is None:
        return [""] * count
    if column.dtype.kind == "f":
        return ["" if np.isnan(value) else f"{value:.{digits}f}" for value in column]
    return [str(int(value)) for value in column]


def write_plot(path: str | Path, title: str, node_ids: Sequence[int], contacts: Mapping[int, Contact | None]) -> None:
    """Plot one row of P, phi, theta per finger. Raises EnvironmentLackError without matplotlib, InputError for a file
    that cannot be written."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise EnvironmentLackError("plot: matplotlib is not installed: pip install 'tipforce[plot]'") from None
    figure = Figure(figsize=(13.0, 2.2 * len(node_ids) + 1.0), layout="constrained")
    axes = figure.subplots(len(node_ids), 3, sharex=True, squeeze=False)
    for row, node_id in zip(axes, node_ids, strict=True):
        contact = contacts[node_id]
        for k, axis in enumerate(row):
            if contact is not None:
                applied = contact.applied[:, k].copy()
                if k:
                    applied[contact.applied[:, 0] <= 0.0] = float("nan")  # a direction without a force has no meaning
                axis.plot(contact.t_s, applied, color="0.6", linewidth=3.0, label="applied")
                axis.plot(contact.t_s, contact.estimated[:, k], color="C0", linewidth=0.8, label="estimated")
            axis.set_ylabel(_LABELS[k])
            axis.grid(alpha=0.3)
        row[0].set_title(f"node {node_id}", loc="left", fontsize=10)
    axes[0][0].legend(loc="best", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("t (s)")
    figure.suptitle(title)
    save_figure(figure, path, FIGURES)
