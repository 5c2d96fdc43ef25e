"""Read a log as arrays: the samples of each node, decoded and joined as in `tipforce decode`."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from os import PathLike, fspath
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.dictionary import table
from tipforce.errors import InputError
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding import judged
from tipforce.host.decoding.estimator import Contacts, of_samples
from tipforce.host.decoding.log_part import Reading
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.decoding.recording import Recording
from tipforce.host.decoding.sample_table import NODE_BITS, Column, Table, missing_of
from tipforce.samples import reasons
from tipforce.samples.reasons import Status
from tipforce.samples.record import Samples

_log = logging.getLogger(__name__)
FloatArray = npt.NDArray[np.float64]
_NOT_USABLE = np.uint16(Status.STALE | Status.FAULT)
"""Status bits of a node for an invalid gauge reading."""


@dataclass(frozen=True, slots=True, eq=False)
class NodeLog(Contacts):
    """The samples of one node in a log, in order."""

    node_id: int
    t_s: FloatArray
    """(k,) time of reception, seconds of the epoch."""
    counter: npt.NDArray[np.int64]
    """(k,) sample counter without wrap, -1 if the PDO has none."""
    microstrain: FloatArray
    """(k, n) gauge strain; NaN where unknown or not sent."""
    F_newtons: FloatArray
    """(k, 3) F1, F2, F3; NaN where unknown or not sent."""
    columns: dict[str, npt.NDArray[Any]]
    """All other decoded values, by signal name, (k,) each."""


class Log(Mapping[int, NodeLog]):
    """Samples of a log by node-id: ``log[5].P_newtons``.

    ``lost``: by node-id the number of missing samples, by their counters. ``bad_lines``: lines that are not frames.
    ``unseen``: node-ids without a calibration here of which neither TPDO4 nor EMCY told bits 12 to 15 of 2124h, so that
    contradicting gauges, extrapolation, temperature and overload could not be seen.
    """

    def __init__(
        self, nodes: Mapping[int, NodeLog], lost: Mapping[int, int], bad_lines: int, unseen: Iterable[int] = ()
    ) -> None:
        self._nodes, self.lost, self.bad_lines = dict(nodes), dict(lost), bad_lines
        self.unseen = tuple(unseen)

    def __getitem__(self, node_id: int) -> NodeLog:
        """Return the samples of a node. Raises KeyError, whose text names the available nodes."""
        if node_id not in self._nodes:
            raise KeyError(f"node {node_id}: the log has {', '.join(map(str, self._nodes)) or 'no node'}")
        return self._nodes[node_id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._nodes)

    def __len__(self) -> int:
        return len(self._nodes)

    def __repr__(self) -> str:
        found = ", ".join(f"{node}: {len(samples)} samples" for node, samples in self._nodes.items())
        return f"<Log {found or 'without samples'}>"


def read_log(
    path: str | PathLike[str] | Iterable[str | PathLike[str]],
    *,
    calibration: Calibration | Mapping[int, Calibration] | None = None,
    gauges: int | None = None,
    channel: str | None = None,
    strict: bool = False,
) -> Log:
    """Decode a log (or several in sequence) of any format that `tipforce decode` reads.

    ``calibration``: one, or by node-id: P, phi and theta are estimated from the gauges if the log has all of them;
    otherwise it gives the uncertainties of the node's values. ``gauges``: number per node (default: the calibration's,
    else 3). ``channel``: one of several buses in the log. ``strict``: raise at the first bad line.
    Raises InputError for a log that can't be read or has no frame, an unknown channel, one node on two buses, and a
    calibration with other gauges.
    """
    from tipforce.host.dataset.reader import tables_of_logs  # its import costs time

    names = [fspath(path)] if isinstance(path, str | PathLike) else [fspath(one) for one in path]
    given: dict[int | None, Calibration] = {}
    if isinstance(calibration, Mapping):
        given.update(calibration.items())
    elif calibration is not None:
        given[None] = calibration
    n = _gauges({one.gauges for one in given.values()} | ({gauges} if gauges else set()))
    recording = Recording(Reading(Layouts(n), buses=None if channel is None else (channel,), strict=strict))
    tables = list(tables_of_logs(recording, names))
    told = recording.told
    if not any(notes.frames for notes in told.notes):
        first = next((notes.first_bad for notes in told.notes if notes.first_bad), "")
        raise InputError(f"{', '.join(names)}: not one frame in it; is it a log?{' ' + first if first else ''}")
    if channel is not None and channel not in recording.channels:
        raise InputError(f"{', '.join(names)}: no frame of channel {channel!r} in it")
    nodes: dict[int, NodeLog] = {}
    for key in sorted({int(key) for one in tables for key in np.unique(one.key)}):
        node_id = key & ((1 << NODE_BITS) - 1)
        if node_id in nodes:
            found = ", ".join(recording.channels)
            raise InputError(f"{names[0]}: node {node_id} is on several buses; choose a channel: {found}")
        of_node = [one.take(np.flatnonzero(one.key == key)) for one in tables]
        nodes[node_id] = _node_log(node_id, [one for one in of_node if len(one)], n, given)
    lost = dict.fromkeys(nodes, 0) | {node: count for (_, node), count in told.tally.lost().items()}
    unseen = [node for _, node in told.unseen if node not in given and None not in given]
    if unseen:
        _log.warning("%s: %s", ", ".join(names), reasons.not_seen(unseen))
    return Log(nodes, lost, sum(sum(notes.bad.values()) for notes in told.notes), unseen)


def _gauges(counts: set[int]) -> int:
    if len(counts) > 1:
        raise InputError(f"nodes or calibrations of {sorted(counts)} gauges: all nodes of one log need the same number")
    return counts.pop() if counts else table.MIN_GAUGES


def _node_log(node_id: int, tables: list[Table], n: int, given: Mapping[int | None, Calibration]) -> NodeLog:
    """Return the samples of one node, which occurs in each of ``tables``."""
    of_signal = {column.signal: column for one in tables for column in one.columns}
    columns = {name: _column(tables, column) for name, column in of_signal.items()}
    t_ns = np.concatenate([one.t_ns for one in tables])
    counter = np.concatenate([one.counter for one in tables])
    unknown = np.full(len(t_ns), np.nan)
    columns = {f"SG{gauge + 1}": unknown for gauge in range(n)} | columns
    calibration = given.get(node_id, given.get(None))
    samples = Samples(
        t_ns, np.full(len(t_ns), node_id, dtype=np.uint8), counter, columns, gauges=n,
        calibrations={node_id: calibration}, fingers=(node_id,),
    )  # fmt: skip
    strain, status = samples.gauges, samples.status
    values = np.concatenate((samples.contact, samples.uncertainties), axis=1)
    if calibration is not None:
        rows = np.flatnonzero(np.isfinite(strain).all(axis=1) & (status & _NOT_USABLE == 0))
        temperature = judged.last_known(columns["temperature"]) if "temperature" in columns else None
        contacts, holds = of_samples(calibration, columns, strain, status, rows, temperature)
        values[rows[holds]], status[rows[holds]] = contacts.values[holds], contacts.status[holds]
    spared = (status & np.uint16(Status.SATURATED) != 0) & np.isfinite(values[:, 0])
    status |= np.where(spared, np.uint16(Status.LEFT_OUT), np.uint16(0))  # the gauges left give the force
    forces = ("F1", "F2", "F3")
    F_newtons = np.stack([columns.get(name, unknown) for name in forces], axis=-1).astype(np.float64)
    names = {"P", "phi", "theta", *forces, *(f"SG{gauge + 1}" for gauge in range(n))}
    others = {name: column for name, column in columns.items() if name not in names}
    P, phi, theta, u_P, u_phi, u_theta = values.T
    return NodeLog(P, phi, theta, u_P, u_phi, u_theta, status, node_id, t_ns * 1e-9, counter, strain, F_newtons, others)


def _column(tables: list[Table], column: Column) -> npt.NDArray[Any]:
    parts = [one.values[column.name] if column.name in one.values else missing_of(column, len(one)) for one in tables]
    return np.concatenate(parts)
