"""Read a log as arrays: the samples of each node, decoded and joined as in `tipforce decode`."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from os import PathLike, fspath
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, occurring
from tipforce.dictionary import table
from tipforce.errors import InputError, needing
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.contact_columns import VALUES, History, of_samples
from tipforce.host.decoding.estimator import Contacts, prepared
from tipforce.host.decoding.log_part import Reading
from tipforce.host.decoding.pdo_layout import Layouts
from tipforce.host.decoding.recording import Recording
from tipforce.host.decoding.sample_table import NO_FLAG, NO_INTEGER, Table, missing_of, node_of
from tipforce.host.logs.notes import no_frame
from tipforce.samples import reasons
from tipforce.samples.columns import sent_values, uncertainties
from tipforce.samples.reasons import Status

if TYPE_CHECKING:
    import pandas
    import pyarrow

_log = logging.getLogger(__name__)
_SHOWN_NODES = 4
_ARROW_NAMES = {"temperature": "temperature_degC", "u_P": "u_P_N"}


@dataclass(frozen=True, slots=True, eq=False)
class NodeLog(Contacts):
    """The samples of one node in a log, in order."""

    node_id: int
    t_s: FloatArray
    """(k,) time of reception, seconds of the epoch; NaN in a log without timestamps."""
    counter: npt.NDArray[np.int64]
    """(k,) sample counter without wrap, -1 if the PDO has none."""
    microstrain: FloatArray
    """(k, n) gauge strain; NaN where unknown or not sent."""
    F_newtons: FloatArray
    """(k, 3) F1, F2, F3; NaN where unknown or not sent."""
    columns: dict[str, npt.NDArray[Any]]
    """All other decoded values, by signal name, (k,) each."""

    def __repr__(self) -> str:
        return "\n".join(f"<{line}>" if number == 0 else f"  {line}" for number, line in enumerate(self._lines()))

    def _lines(self) -> Iterator[str]:
        span_s = self.t_s[-1] - self.t_s[0] if len(self) else 0.0
        times = "without times" if np.isnan(span_s) else f"in {span_s:.3f} s"
        yield f"NodeLog of node {self.node_id}: {len(self)} samples {times}"
        for name in ("P_newtons", "phi_deg", "theta_deg"):
            known = getattr(self, name)[np.isfinite(getattr(self, name))]
            limits = f"{known.min():.3f} to {known.max():.3f}, " if len(known) else ""
            yield f"{name}: {limits}{len(self) - len(known)} unknown"
        yield f"also t_s, counter, microstrain, F_newtons, status, columns: {', '.join(self.columns) or 'none'}"

    def to_arrow(self) -> pyarrow.Table:
        """Return the samples as an Arrow table, with the names, types and units of `tipforce decode -o x.parquet`. An
        unknown value is null. ``status`` holds the bits of ``Status``. Raises EnvironmentLackError without pyarrow."""
        pa = _pyarrow()
        untimed = np.isnan(self.t_s)
        us = np.where(untimed, 0.0, self.t_s * 1e6).round().astype(np.int64)
        times = pa.array(us, pa.timestamp("us", tz="UTC"), mask=untimed)
        arrays = {"t_s": times, "node": pa.array(np.full(len(self), self.node_id, dtype=np.uint8)),
                  "counter": pa.array(self.counter, mask=self.counter < 0)}  # fmt: skip
        forces = {f"F{k + 1}_N": self.F_newtons[:, k] for k in range(3)}
        strains = {f"SG{k + 1}_ue": column for k, column in enumerate(self.microstrain.T)}
        others = {_ARROW_NAMES.get(name, name): values for name, values in self.columns.items()}
        contact = dict(zip((column.name for column in VALUES), self.values.T, strict=True))
        own_u_P = others.pop("u_P_N", None)  # of TPDO4, where no calibration gives it
        if own_u_P is not None and np.isnan(contact["u_P_N"]).all():
            contact["u_P_N"] = own_u_P
        for name, values in {**contact, **forces, **strains, **others}.items():
            is_flag = values.dtype == np.int8
            unknown = np.isnan(values) if values.dtype.kind == "f" else values == (NO_FLAG if is_flag else NO_INTEGER)
            arrays[name] = pa.array(values.astype(np.bool_) if is_flag else values, mask=unknown)
        arrays["status"] = pa.array(self.status)
        return pa.table(arrays)

    def to_pandas(self) -> pandas.DataFrame:
        """Return ``to_arrow`` as a data frame. Raises EnvironmentLackError without pandas or pyarrow."""
        return _data_frame(self)


class Log(Mapping[int, NodeLog]):
    """Samples of a log by node-id: ``log[5].P_newtons``. ``lost``: missing samples by node-id; ``bad_lines``: no
    frames; ``unseen``: uncalibrated node-ids of which neither TPDO4 nor EMCY told bits 12 to 15 of 2124h."""

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
        heads = [f"  {str(samples).splitlines()[0][1:-1]}, {self.lost[node]} lost" for node, samples in self.items()]
        others = len(heads) - _SHOWN_NODES
        more = [f"  and {others} more node{'s' * (others > 1)}"] if others > 0 else []
        return "\n".join([f"<Log of {len(heads)} nodes, {self.bad_lines} bad lines>", *heads[:_SHOWN_NODES], *more])

    def to_arrow(self) -> pyarrow.Table:
        """Return the samples of all nodes as one Arrow table in the order of time. See ``NodeLog.to_arrow``."""
        pa = _pyarrow()
        if not self:
            return pa.table({})
        whole = pa.concat_tables([samples.to_arrow() for samples in self.values()], promote_options="default")
        return whole.sort_by([("t_s", "ascending"), ("node", "ascending")])

    def to_pandas(self) -> pandas.DataFrame:
        """Return ``to_arrow`` as a data frame. Raises EnvironmentLackError without pandas or pyarrow."""
        return _data_frame(self)


def _pyarrow() -> Any:
    with needing("to_arrow needs pyarrow: `pip install 'tipforce[parquet]'`"):
        import pyarrow
    return pyarrow


def _data_frame(samples: NodeLog | Log) -> pandas.DataFrame:
    with needing("to_pandas needs pandas: `pip install pandas`"):
        return samples.to_arrow().to_pandas()


def read_log(
    path: str | PathLike[str] | Iterable[str | PathLike[str]], *,
    calibration: Calibration | Mapping[int, Calibration] | None = None, gauges: int | None = None,
    channel: str | None = None, strict: bool = False,
) -> Log:  # fmt: skip
    """Decode one or more logs of any format that `tipforce decode` reads, in sequence, also by a pattern: "run*.log".

    ``calibration``: one, or by node-id: it estimates P, phi and theta from all gauges, else gives their uncertainties.
    ``gauges``: default the calibration's, or 3. ``channel``: of several buses. ``strict``: raise at the first bad line.
    Raises InputError for an unusable log, no frame, an unknown channel, a node on two buses, other gauges."""
    from tipforce.host.dataset.reader import logs_named, tables_of_logs  # its import costs time

    paths = [path] if isinstance(path, str | PathLike) else path
    names = [name for pattern in paths for name in logs_named(fspath(pattern))]
    given: dict[int | None, Calibration] = {}
    if isinstance(calibration, Mapping):
        given.update(calibration.items())
    elif calibration is not None:
        given[None] = calibration
    n = _gauges({tip.gauges for tip in given.values()} | ({gauges} if gauges else set()))
    recording = Recording(Reading(Layouts(n), buses=None if channel is None else (channel,), strict=strict))
    tables = list(tables_of_logs(recording, names))
    if not any(notes.frames for notes in recording.notes):
        raise no_frame(", ".join(names), next((notes.first_bad for notes in recording.notes if notes.first_bad), None))
    if channel is not None and channel not in recording.channels:
        raise InputError(f"{', '.join(names)}: no frame of channel {channel!r} in it")
    nodes: dict[int, NodeLog] = {}
    for key in sorted({key for part in tables for key in occurring(part.key)}):
        node_id = node_of(key)
        if node_id in nodes:
            channels = ", ".join(recording.channels)
            raise InputError(f"{names[0]}: node {node_id} is on several buses; choose a channel: {channels}")
        of_node = (part.take(np.flatnonzero(part.key == key)) for part in tables)
        nodes[node_id] = _node_log(node_id, list(filter(len, of_node)), n, given.get(node_id, given.get(None)))
    lost = dict.fromkeys(nodes, 0) | {node: count for (_, node), count in recording.tally.lost().items()}
    unseen = [node for _, node in recording.unseen if node not in given and None not in given]
    if unseen:
        _log.info("%s: %s", ", ".join(names), reasons.not_seen(unseen))
    return Log(nodes, lost, sum(sum(notes.bad.values()) for notes in recording.notes), unseen)


def _gauges(counts: set[int]) -> int:
    if len(counts) > 1:
        raise InputError(f"nodes or calibrations of {sorted(counts)} gauges: all nodes of one log need the same number")
    return counts.pop() if counts else table.MIN_GAUGES


def _node_log(node_id: int, tables: list[Table], n: int, calibration: Calibration | None) -> NodeLog:
    """Return the samples of one node, which occurs in each of ``tables``."""
    t_ns, counter = (np.concatenate([getattr(part, name) for part in tables]) for name in ("t_ns", "counter"))
    t_s = np.concatenate([part.t_ns * (1e-9 if part.timed else np.nan) for part in tables])
    gauges, unknown = [f"SG{gauge + 1}" for gauge in range(n)], np.full(len(t_ns), np.nan)
    of_signal = {column.signal: column for part in tables for column in part.columns}
    columns = dict.fromkeys(gauges, unknown) | {
        signal: np.concatenate([of.values[c.name] if c.name in of.values else missing_of(c, len(of)) for of in tables])
        for signal, c in of_signal.items()
    }
    strain, status = np.stack([columns[name] for name in gauges], axis=-1), reasons.status_of(columns, t_ns.shape)
    contact = sent_values(columns, status, calibration is not None and calibration.pull)
    node = np.full(len(t_ns), node_id, dtype=np.uint8)
    values = np.hstack((contact, uncertainties(contact, node, {node_id: calibration})))
    if calibration is not None:
        rows, contacts = of_samples(prepared(calibration), columns, strain, status, History(), t_ns)
        values[rows], status[rows] = contacts.values, contacts.status
    spared = (status & np.uint16(Status.SATURATED) != 0) & np.isfinite(values[:, 0])
    status |= np.where(spared, np.uint16(Status.LEFT_OUT), np.uint16(0))  # the gauges left give the force
    forces = ("F1", "F2", "F3")
    F_newtons = np.stack([columns.get(name, unknown) for name in forces], axis=-1).astype(np.float64)
    others = {name: of for name, of in columns.items() if name not in {"P", "phi", "theta", *forces, *gauges}}
    P, phi, theta, u_P, u_phi, u_theta = values.T
    return NodeLog(P, phi, theta, u_P, u_phi, u_theta, status, node_id, t_s, counter, strain, F_newtons, others)
