"""Samples as columns, the rows of a hand, and one sample as named values.

What frames carry is kept as raw words; a column is made when it is first read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.dictionary import table
from tipforce.dictionary.signals import Message
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.columns import Layout
from tipforce.host.decoding.decoder import Columns
from tipforce.host.decoding.health import NAMES
from tipforce.samples import reasons
from tipforce.samples.columns import Block, contact_values, status_of, uncertainties
from tipforce.samples.contact import Contact
from tipforce.samples.reasons import Status

FloatArray = npt.NDArray[np.float64]
Column = npt.NDArray[Any]
COUNTER = "counter"
_UNKNOWN = (math.nan,) * 6


class Pdo:
    """The layout of a PDO: where its counter is, and its other signals of few words and of many."""

    def __init__(self, message: Message) -> None:
        self.message = message
        start = {signal.name: signal.start_bit for signal in message.signals}
        self.counter_shift = start.get(COUNTER, -1)
        self.stale_mask = 1 << start["stale"] if "stale" in start else 0
        bits = {name: bit for name, bit in NAMES.items() if name in start}
        whole = all(f"fault_{name}" in bits for _, name, _ in table.FAULT_BITS)
        self.fault_mask = sum(1 << bit for bit in bits.values()) if whole else 0
        """Of 2124h, if the PDO has it."""
        self.fault_shift = min((start[name] - bit for name, bit in bits.items()), default=0)
        self._layout = Layout(signal for signal in message.signals if signal.name != COUNTER)
        self.names = self._layout.names

    def columns(self, words: Sequence[int]) -> Mapping[str, Column]:
        """Return by name each signal (n,) of words (n,), a PDO's data as a little-endian number."""
        return self._layout.columns(np.array(words, dtype="<u8"))


class Samples:
    """n samples in the order in which they were joined; whatever is computed of them is when it is first read."""

    def __init__(
        self, t_ns: npt.NDArray[np.int64], node: npt.NDArray[np.uint8], counter: npt.NDArray[np.int64],
        columns: Mapping[str, Column], reason: npt.NDArray[np.uint8] | None = None, gauges: int = 0,
        calibrations: Mapping[int, Calibration | None] | None = None,
        fingers: Sequence[int] = (), calibrated: bool = False,
    ) -> None:  # fmt: skip
        """``gauges``: of each node; 0: as many as the PDOs carry.

        ``calibrations``: by node-id, for the uncertainties, and for contacts that no PDO carries; ``calibrated``: of
        nodes that have none, too. ``fingers``: the node-ids, where the samples are rows of these.
        """
        self.t_ns = t_ns
        """(n,) time of reception."""
        self.node = node
        """(n,) node-ids."""
        self.counter = counter
        """(n,) sample counter (2121h), -1 where there is none."""
        self.columns = columns
        """Every signal of the PDOs, (n,) each: measurements in their unit, NaN for unknown; flags as bool."""
        self.reason = np.zeros(len(t_ns), dtype=np.uint8) if reason is None else reason
        """(n,) why there is no sample, as an index of ``reasons.OF_ROW``; PRESENT where there is one."""
        self._gauges, self._calibrations = gauges, calibrations or {}
        self._fingers, self._calibrated = fingers, np.uint16(Status.CALIBRATED if calibrated else 0)

    def __len__(self) -> int:
        return len(self.t_ns)

    @cached_property
    def status(self) -> npt.NDArray[np.uint16]:
        """(n,) bits of ``Status``."""
        missing = self.reason != reasons.PRESENT
        return status_of(self.columns, (len(self),)) | np.where(missing, np.uint16(Status.NO_ANSWER), np.uint16(0))

    @cached_property
    def gauges(self) -> FloatArray:
        """(n, g) strain in microstrain; NaN where unknown. g is 0 where no PDO carries a gauge."""
        carried = sorted(int(name[2:]) for name in self.columns if name[:2] == "SG" and name[2:].isdigit())
        wanted = range(1, self._gauges + 1) if carried and self._gauges else carried
        unknown = np.full(len(self), np.nan)
        strains = [self.columns.get(f"SG{number}", unknown).astype(np.float64) for number in wanted]
        return np.stack(strains, axis=-1) if strains else np.zeros((len(self), 0))

    @cached_property
    def contact(self) -> FloatArray:
        """(n, 3) P in newtons, phi and theta in degrees; NaN where unknown."""
        if self.columns.keys() >= {"P", "phi", "theta"}:
            return contact_values(self.columns, self.gauges, self.status, None)
        status = self.status | self._calibrated
        values = np.full((len(self), 3), np.nan)
        for node_id, rows in self._by_node.items():
            columns = Columns(tuple(self.columns), self.columns, rows)
            strain, calibration = self.gauges[rows] * 1e-6, self._calibrations.get(node_id)
            values[rows] = contact_values(columns, strain, status[rows], calibration)
        return values

    @cached_property
    def uncertainties(self) -> FloatArray:
        """(n, 3) standard uncertainty of each contact, in the same units, from gauge noise; NaN where unknown."""
        if self._fingers:
            of_fingers = [self._calibrations.get(node_id) for node_id in self._fingers]
            return uncertainties(self.contact.reshape(-1, len(of_fingers), 3), of_fingers).reshape(-1, 3)
        u = np.full((len(self), 3), np.nan)
        for node_id, rows in self._by_node.items():
            u[rows] = uncertainties(self.contact[rows, np.newaxis], [self._calibrations.get(node_id)])[:, 0]
        return u

    @cached_property
    def _by_node(self) -> Mapping[int, Any]:
        if self._fingers:
            return {node_id: slice(k, None, len(self._fingers)) for k, node_id in enumerate(self._fingers)}
        nodes = np.unique(self.node).tolist()
        return {n: np.flatnonzero(self.node == n) if len(nodes) > 1 else slice(None) for n in nodes}

    def contacts(self, names: Mapping[int, str] | None = None) -> Iterator[Contact]:
        """Yield the samples one by one; ``names``: of the fingers, by node-id."""
        columns = (self.t_ns, self.node, self.counter, self.reason, self.status)
        heads = zip(*(column.tolist() for column in columns), strict=True)
        rest = zip(self.contact.tolist(), self.uncertainties.tolist(), self.gauges.tolist(), strict=True)
        for (t_ns, node_id, counter, reason, status), (contact, u, gauges) in zip(heads, rest, strict=True):
            name = (names or {}).get(node_id, "")
            if reason != reasons.PRESENT:
                missing = "" if reason == reasons.NO_RESPONSE else reasons.OF_ROW[reason]
                yield Contact(node_id, t_ns * 1e-9, -1, *_UNKNOWN, Status.NO_ANSWER, name=name, missing=missing)
                continue
            P, phi, theta = contact
            u_P, u_phi, u_theta = u
            flags, microstrain = Status(status), tuple(gauges)
            yield Contact(
                node_id, t_ns * 1e-9, counter, P, phi, theta, u_P, u_phi, u_theta, flags, microstrain, name
            )  # fmt: skip


class RawRow:
    """One SYNC, and the answers to it by slot: message and finger. ``number`` 0: the SYNC has none."""

    __slots__ = ("number", "opened_s", "reasons", "received", "stale", "states", "t_ns", "words")

    def __init__(self, t_ns: int, opened_s: float, number: int, received: bool, slots: int) -> None:
        self.t_ns = t_ns
        self.opened_s = opened_s
        self.number = number
        self.received = received
        self.stale = False  # an answer is
        self.words = [0] * slots
        self.states = [0] * slots
        self.reasons: list[int] = []  # by finger, when the row closes


class Rows:
    """m rows of k fingers, in the order of the SYNCs and of the hand's node-ids.

    ``columns`` has every signal of the PDOs that the hand reads, each (m, k): measurements as float64 in the signal's
    unit, NaN if the node marks them unknown or the finger is missing; flags as bool, False if missing.
    """

    def __init__(self, first: int, raw: list[RawRow], node_ids: Sequence[int], pdos: Sequence[Pdo]) -> None:
        """Closed rows of the answers ``pdos`` of ``node_ids``; a column is made when it is first read."""
        self.first = first
        """Number of the first row since the start of the hand; 0 in a block without rows."""
        self._raw, self._node_ids, self._pdos = raw, node_ids, pdos

    def __len__(self) -> int:
        return len(self._raw)

    @cached_property
    def sync_ns(self) -> npt.NDArray[np.int64]:
        """(m,) receive time of each SYNC; interpolated for one that was not received."""
        return np.array([row.t_ns for row in self._raw], dtype=np.int64)

    @cached_property
    def numbered(self) -> npt.NDArray[np.bool_]:
        """(m,) the SYNC carried a number, and each answer repeats it; False: the pairing is assumed from the order."""
        return np.array([row.number > 0 for row in self._raw], dtype=np.bool_)

    @cached_property
    def counter(self) -> npt.NDArray[np.int64]:
        """(m, k) 2121h: the SYNC's number, or a sample counter 0..255; -1 where missing."""
        shift = self._pdos[0].counter_shift
        pairs = (zip(row.words, row.reasons, strict=False) for row in self._raw)
        return self._of_fingers([[-1 if why else word >> shift & 0xFF for word, why in row] for row in pairs], np.int64)

    @cached_property
    def reason(self) -> npt.NDArray[np.uint8]:
        """(m, k) why the finger is missing, as an index of ``reasons.OF_ROW``; PRESENT where it is not."""
        return self._of_fingers([row.reasons for row in self._raw], np.uint8)

    @cached_property
    def missing(self) -> npt.NDArray[np.bool_]:
        """(m, k) no certain, complete answer of this finger."""
        missing: npt.NDArray[np.bool_] = self.reason != reasons.PRESENT
        return missing

    @cached_property
    def columns(self) -> Mapping[str, Column]:
        """Every signal of the PDOs by name, (m, k) each."""
        return RowColumns(self._raw, self._node_ids, self._pdos)

    def _of_fingers(self, values: list[list[int]], kind: type[np.generic]) -> npt.NDArray[Any]:
        return np.array(values, dtype=kind).reshape(len(values), len(self._node_ids))

    def samples(
        self, calibrations: Sequence[Calibration | None], gauges: int = 0, calibrated: bool = False
    ) -> Samples:  # fmt: skip
        """Return the m x k samples, row by row; ``calibrations`` (k,); see ``Samples``."""
        node_ids = self._node_ids
        return Samples(
            np.repeat(self.sync_ns, len(node_ids)), np.tile(np.array(node_ids, dtype=np.uint8), len(self)),
            self.counter.ravel(), {name: column.ravel() for name, column in self.columns.items()},
            self.reason.ravel(), gauges, dict(zip(node_ids, calibrations, strict=True)), node_ids, calibrated,
        )  # fmt: skip

    def block(
        self, calibrations: Sequence[Calibration | None], gauges: int,
        health_u_P: FloatArray | None = None, faults: npt.NDArray[np.int64] | None = None,
    ) -> Block:  # fmt: skip
        """Return the rows with contact and uncertainty, computed from forces or gauges where no PDO carries them.

        ``health_u_P`` (m, k) is used as u(P) if no calibration is known; ``faults`` (m, k) is 2124h.
        """
        samples, shape = self.samples(calibrations, gauges, calibrated=True), self.counter.shape
        contact, u = samples.contact.reshape(*shape, 3), samples.uncertainties.reshape(*shape, 3)
        carried, status = samples.gauges.shape[-1], samples.status.reshape(shape)
        strains = samples.gauges.reshape(*shape, gauges) if carried else np.full((*shape, gauges), np.nan)
        if faults is not None:
            status = status | (faults & reasons.JUDGED).astype(np.uint16)
        if health_u_P is not None:
            u[..., 0] = np.where(np.isnan(u[..., 0]) & ~np.isnan(contact[..., 0]), health_u_P, u[..., 0])
        return Block(self.sync_ns, contact, u, strains, status)


class RowColumns(Mapping[str, Column]):
    """The signals of rows by name, (m, k) each."""

    def __init__(self, raw: list[RawRow], node_ids: Sequence[int], pdos: Sequence[Pdo]) -> None:
        self._raw, self._fingers, self._pdos = raw, len(node_ids), pdos
        self._missing = [row.reasons for row in raw] if any(any(row.reasons) for row in raw) else None
        self._of_pdo: dict[int, Any] = {}
        self._made: dict[str, Column] = {}
        self._pdo_of = {name: number for number, pdo in enumerate(pdos) for name in pdo.names}

    def __getitem__(self, name: str) -> Column:
        if name not in self._made:
            column: Column = self._signals(self._pdo_of[name])[name].reshape(len(self._raw), self._fingers)
            if self._missing is not None:
                column = np.where(self._missing, np.nan if column.dtype.kind == "f" else False, column)
            self._made[name] = column
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._pdo_of)

    def __len__(self) -> int:
        return len(self._pdo_of)

    def _signals(self, number: int) -> Any:
        if number not in self._of_pdo:
            part = slice(number * self._fingers, (number + 1) * self._fingers)
            self._of_pdo[number] = self._pdos[number].columns([word for row in self._raw for word in row.words[part]])
        return self._of_pdo[number]


def joined(rows: list[Rows]) -> Rows:
    """Return consecutive blocks of rows as one."""
    raw = [row for block in rows for row in block._raw]
    return Rows(rows[0].first, raw, rows[0]._node_ids, rows[0]._pdos)
