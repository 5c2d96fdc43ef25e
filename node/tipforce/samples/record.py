"""Samples as columns, and the rows of a hand: raw words, of which a column is made when it is first read."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import BoolArray, FloatArray, IntArray, occurring
from tipforce.dictionary import table
from tipforce.dictionary.signals import Message, Signal
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.health import NAMES, told_by
from tipforce.host.decoding.sample_rule import COUNTER
from tipforce.host.decoding.sample_table import Layout, divisor_of
from tipforce.samples import reasons
from tipforce.samples.columns import Block, contact_values, sent_values, uncertainties
from tipforce.samples.contact import Contact, Fields
from tipforce.samples.reasons import OVERLOAD, PRESENT, Status, status_of

Column = npt.NDArray[Any]
_UNKNOWN = (math.nan,) * 6


class Pdo:
    """The layout of a PDO: where its counter is, and its other signals of few words and of many."""

    def __init__(self, message: Message) -> None:
        self.message = message
        start = {signal.name: signal.start_bit for signal in message.signals}
        self.counter_shift = start.get(COUNTER, -1)
        self.stale_mask = 1 << start["stale"] if "stale" in start else 0
        self.fault_mask = told_by(start)
        """Of 2124h, if the PDO has it."""
        self.fault_shift = min((start[name] - bit for name, bit in NAMES.items() if name in start), default=0)
        self.start = start
        """By name of a signal its first bit."""
        self.raw = {signal.name: _raw(signal) for signal in message.signals}
        """The same: the place of a number, its mask, sign bit and unknown value, and what it is divided by."""
        self._layout = Layout(signal for signal in message.signals if signal.name != COUNTER)
        self.names = self._layout.names

    def columns(self, words: Sequence[int]) -> Mapping[str, Column]:
        """Return by name each signal (n,) of words (n,), a PDO's data as a little-endian number."""
        return self._layout.columns(np.array(words, dtype="<u8"))


def _raw(signal: Signal) -> tuple[int, int, int, int | None, int]:
    mask = (1 << signal.bits) - 1
    return signal.start_bit, mask, signal.signed * (mask + 1 >> 1), signal.unknown, divisor_of(signal) or 1


@dataclass(eq=False, repr=False)
class JoinedSamples:
    """n samples in the order in which they were joined; whatever is computed of them is when it is first read."""

    t_ns: npt.NDArray[np.int64]
    """(n,) time of reception."""
    node: npt.NDArray[np.uint8]
    """(n,) node-ids."""
    counter: npt.NDArray[np.int64]
    """(n,) sample counter (2121h), -1 where there is none."""
    columns: Mapping[str, Column]
    """Every signal of the PDOs, (n,) each: measurements in their unit, NaN for unknown; flags as bool."""
    calibrations: Mapping[int, Calibration | None] = field(default_factory=dict)
    """By node-id."""
    gauge_count: int = 0
    """Of each node; 0: as many as the PDOs carry."""
    reason: npt.NDArray[np.uint8] | int = PRESENT
    """(n,) why there is no sample, as an index of ``reasons.OF_ROW``; PRESENT where there is one."""
    calibrated: bool = False
    """Each node is, whatever it says."""

    def __len__(self) -> int:
        return len(self.t_ns)

    @cached_property
    def status(self) -> npt.NDArray[np.uint16]:
        """(n,) bits of ``Status``: of the node, and what an estimate from its gauges adds."""
        return self._sent_status if self._has_contact else self._sent_status | self._found[1]

    @cached_property
    def _sent_status(self) -> npt.NDArray[np.uint16]:
        no_answer = np.where(np.not_equal(self.reason, PRESENT), np.uint16(Status.NO_ANSWER), np.uint16(0))
        return status_of(self.columns, (len(self),)) | no_answer

    @cached_property
    def gauges(self) -> FloatArray:
        """(n, g) strain in microstrain; NaN where unknown. g is 0 where no PDO carries a gauge."""
        carried = sorted(int(name[2:]) for name in self.columns if name[:2] == "SG" and name[2:].isdigit())
        wanted = range(1, self.gauge_count + 1) if carried and self.gauge_count else carried
        unknown = np.full(len(self), np.nan)
        strains = [self.columns.get(f"SG{number}", unknown).astype(np.float64) for number in wanted]
        return np.stack(strains, axis=-1) if strains else np.zeros((len(self), 0))

    @cached_property
    def contact(self) -> FloatArray:
        """(n, 3) P in newtons, phi and theta in degrees; NaN where unknown."""
        return self._found[0]

    @property
    def _has_contact(self) -> bool:
        return self.columns.keys() >= {"P", "phi", "theta"}

    @cached_property
    def _found(self) -> tuple[FloatArray, npt.NDArray[np.uint16]]:
        """``contact``, and the doubts of it, (n,)."""
        values, doubts = np.full((len(self), 3), np.nan), np.zeros(len(self), dtype=np.uint16)
        if self._has_contact:
            return sent_values(self.columns, self._sent_status), doubts
        status = self._sent_status | np.uint16(Status.CALIBRATED if self.calibrated else 0)
        for node_id in occurring(self.node):
            at = np.flatnonzero(self.node == node_id)
            step = int(at[1] - at[0]) if len(at) > 1 else 1  # even in the rows of a hand: parts of columns are views
            rows: Any = slice(int(at[0]), int(at[-1]) + 1, step) if (np.diff(at) == step).all() else at
            columns = {name: column[rows] for name, column in self.columns.items()}
            strain, calibration = self.gauges[rows] * 1e-6, self.calibrations.get(node_id)
            values[rows], doubts[rows] = contact_values(columns, strain, status[rows], calibration)
        return values, doubts

    @cached_property
    def uncertainties(self) -> FloatArray:
        """(n, 3) standard uncertainty of each contact, in the same units, from gauge noise; NaN where unknown."""
        return uncertainties(self.contact, self.node, self.calibrations)

    def contacts(self, names: Mapping[int, str] | None = None) -> Iterator[Contact]:
        """Yield the samples one by one; ``names``: of the fingers, by node-id."""
        reasons_of = np.broadcast_to(self.reason, len(self))
        columns = (self.t_ns, self.node, self.counter, reasons_of, self.status)
        heads = zip(*(column.tolist() for column in columns), strict=True)
        rest = zip(self.contact.tolist(), self.uncertainties.tolist(), self.gauges.tolist(), strict=True)
        for (t_ns, node_id, counter, reason, status), (contact, u, gauges) in zip(heads, rest, strict=True):
            name = (names or {}).get(node_id, "")
            if reason != PRESENT:
                yield missing_contact(node_id, t_ns, reason, name)
            else:
                (P, phi, theta), (u_P, u_phi, u_theta), t_s = contact, u, t_ns * 1e-9
                flags, strain = Status(status), tuple(gauges)
                yield Contact(node_id, t_s, counter, P, phi, theta, u_P, u_phi, u_theta, flags, strain, name)


def missing_contact(node_id: int, t_ns: int, reason: int, name: str) -> Contact:
    """Return the contact of a finger that is missing for a reason, an index of ``reasons.OF_ROW``."""
    missing = "" if reason == reasons.NO_RESPONSE else reasons.OF_ROW[reason]
    return Contact(node_id, t_ns * 1e-9, -1, *_UNKNOWN, Status.NO_ANSWER, name=name, missing=missing)


Row = tuple[int, int, Sequence[int], Sequence[int], Sequence[int]]
"""A closed row: time and number of the SYNC (0: none), words by slot (message, finger), reasons by finger, states."""

_NO_ROW: Row = 0, 0, (), (), ()


class Rows:
    """m rows of k fingers, by SYNC and by node-id. ``columns`` by signal, (m, k): float64 in the signal's unit, NaN if
    unknown or the finger is missing; flags bool, then False."""

    def __init__(self, first: int, raw: list[Row], node_ids: Sequence[int], pdos: Sequence[Pdo]) -> None:
        """Closed rows of the answers ``pdos`` of ``node_ids``; a column is made when it is first read."""
        self.first = first
        """Number of the first row since the start of the hand; 0 in a block without rows."""
        self.raw, self.pdos, self._node_ids = raw, pdos, node_ids

    def __len__(self) -> int:
        return len(self.raw)

    @cached_property
    def sync_ns(self) -> IntArray:
        """(m,) receive time of each SYNC; interpolated for one that was not received."""
        return np.array([t_ns for t_ns, *_ in self.raw], dtype=np.int64)

    @cached_property
    def numbered(self) -> BoolArray:
        """(m,) the SYNC carried a number, and each answer repeats it; False: the pairing is assumed from the order."""
        return np.array([number > 0 for _, number, *_ in self.raw], dtype=np.bool_)

    @cached_property
    def counter(self) -> npt.NDArray[np.int64]:
        """(m, k) 2121h: the SYNC's number, or a sample counter 0..255; -1 where missing."""
        shift = self.pdos[0].counter_shift
        pairs = (zip(words, reasons, strict=False) for _, _, words, reasons, _ in self.raw)
        return self._of_fingers([[-1 if why else word >> shift & 0xFF for word, why in row] for row in pairs], np.int64)

    @cached_property
    def reason(self) -> npt.NDArray[np.uint8]:
        """(m, k) why the finger is missing, as an index of ``reasons.OF_ROW``; PRESENT where it is not."""
        return self._of_fingers([row_reasons for _, _, _, row_reasons, _ in self.raw], np.uint8)

    @cached_property
    def missing(self) -> BoolArray:
        """(m, k) no certain, complete answer of this finger."""
        return np.not_equal(self.reason, PRESENT)

    @cached_property
    def columns(self) -> Mapping[str, Column]:
        """Every signal of the PDOs by name, (m, k) each."""
        return RowColumns(self.raw, self._node_ids, self.pdos)

    def _of_fingers(self, values: list[Any], kind: type[np.generic]) -> npt.NDArray[Any]:
        return np.array(values, dtype=kind).reshape(len(values), len(self._node_ids))

    def samples(
        self, calibrations: Sequence[Calibration | None], gauges: int = 0, calibrated: bool = False
    ) -> JoinedSamples:  # fmt: skip
        """Return the m x k samples, row by row; ``calibrations`` (k,); see ``JoinedSamples``."""
        node_ids = self._node_ids
        return JoinedSamples(
            np.repeat(self.sync_ns, len(node_ids)), np.tile(np.array(node_ids, dtype=np.uint8), len(self)),
            self.counter.ravel(), {name: column.ravel() for name, column in self.columns.items()},
            dict(zip(node_ids, calibrations, strict=True)), gauges, self.reason.ravel(), calibrated,
        )  # fmt: skip

    def block(
        self, calibrations: Sequence[Calibration | None], gauges: int,
        health_u_P: FloatArray | None = None, faults: npt.NDArray[np.int64] | None = None,
    ) -> Block:  # fmt: skip
        """Return the rows with contact and uncertainty, computed from forces or gauges where no PDO carries them.
        ``health_u_P`` (m, k) is used as u(P) if no calibration is known; ``faults`` (m, k) is 2124h."""
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

    def __init__(self, raw: list[Row], node_ids: Sequence[int], pdos: Sequence[Pdo]) -> None:
        self._raw, self._fingers, self._pdos = raw, len(node_ids), pdos
        missing = [row_reasons for _, _, _, row_reasons, _ in raw]
        self._missing = missing if any(map(any, missing)) else None
        self._of_pdo: dict[int, Any] = {}
        self._made: dict[str, Column] = {}
        self._pdo_of = {name: number for number, pdo in enumerate(pdos) for name in pdo.names}

    def __getitem__(self, name: str) -> Column:
        if name not in self._made:
            number = self._pdo_of[name]
            if number not in self._of_pdo:
                part = slice(number * self._fingers, (number + 1) * self._fingers)
                words = [word for _, _, of_row, _, _ in self._raw for word in of_row[part]]
                self._of_pdo[number] = self._pdos[number].columns(words)
            column: Column = self._of_pdo[number][name].reshape(len(self._raw), self._fingers)
            if self._missing is not None:
                column = np.where(self._missing, np.nan if column.dtype.kind == "f" else False, column)
            self._made[name] = column
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._pdo_of)

    def __len__(self) -> int:
        return len(self._pdo_of)


def joined(rows: list[Rows]) -> Rows:
    """Return consecutive blocks of rows as one."""
    raw = [row for block in rows for row in block.raw]
    return Rows(rows[0].first, raw, rows[0]._node_ids, rows[0].pdos)


class RowContacts:
    """Makes the contacts of rows, each field when it is read; those that no PDO carries all at once."""

    def __init__(
        self, node_ids: Sequence[int], names: Sequence[str], calibrations: Sequence[Calibration | None] = ()
    ) -> None:
        self._node_ids, self._calibrations = node_ids, calibrations or [None] * len(node_ids)
        self._names = [name or f"finger {node_id}" for name, node_id in zip(names, node_ids, strict=True)]
        self.places: dict[str | int, int] = {name: place for place, name in enumerate(self._names)}
        self.places |= {node_id: place for place, node_id in enumerate(node_ids)}
        """By name and by node-id: the place in a row."""
        self.make: Callable[[Row, int], Contact] | None = None
        """Returns the contact at a place of a row of ``pdos``; None where they do not carry P, phi and theta."""
        self.pdos: Sequence[Pdo] = ()
        self._computed: tuple[Row, Any] = _NO_ROW, None

    def computed(self, rows: Rows) -> list[dict[int, Contact]]:
        """Return by place the contacts of each row; an empty list if ``make`` is to make them."""
        if rows.pdos is not self.pdos:
            self.pdos, self.make = rows.pdos, self._maker(rows.pdos)
        if self.make is not None:
            return []
        named = dict(zip(self._node_ids, self._names, strict=True))
        contacts = rows.samples(self._calibrations).contacts(named)
        return [dict(enumerate(islice(contacts, len(named)))) for _ in rows.raw]

    def _uncertainties(self, row: Row, place: int) -> Any:
        """Return those of P, phi and theta; those of a row are computed together."""
        if self._computed[0] is not row:
            samples = Rows(0, [row], self._node_ids, self.pdos).samples(self._calibrations)
            self._computed = row, samples.uncertainties.tolist()
        return self._computed[1][place]

    def _maker(self, pdos: Sequence[Pdo]) -> Callable[[Row, int], Contact] | None:
        """Return ``make``: P, which everybody reads, is made at once, each other field when it is first read."""
        k, number_of = len(self._node_ids), {name: number for number, pdo in enumerate(pdos) for name in pdo.names}
        if not number_of.keys() >= {"P", "phi", "theta"}:
            return None

        def value(name: str) -> Callable[[Row, int], float]:
            first = number_of[name] * k
            shift, mask, sign, unknown, divisor = pdos[number_of[name]].raw[name]

            def made(row: Row, place: int) -> float:
                raw = (row[2][first + place] >> shift & mask ^ sign) - sign
                return math.nan if raw == unknown else raw / divisor

            return made

        flag = table.STATUS_BITS[0][0]
        status, shift, counter = number_of[flag] * k, pdos[number_of[flag]].start[flag], pdos[0].counter_shift
        gauges, P_newtons = [value(name) for name in sorted(number_of) if name[:2] == "SG"], value("P")
        fields: Fields = {
            "node_id": lambda _row, place: self._node_ids[place],
            "t_s": lambda row, _place: row[0] * 1e-9,
            "counter": lambda row, place: row[2][place] >> counter & 0xFF,
            "phi_deg": value("phi"),
            "theta_deg": value("theta"),
            "u_P_newtons": lambda row, place: self._uncertainties(row, place)[0],
            "u_phi_deg": lambda row, place: self._uncertainties(row, place)[1],
            "u_theta_deg": lambda row, place: self._uncertainties(row, place)[2],
            "status": lambda row, place: Status(
                row[2][status + place] >> shift & 0xFF | (P_newtons(row, place) == reasons.LARGEST_NEWTONS and OVERLOAD)
            ),
            "microstrain": lambda row, place: tuple(gauge(row, place) for gauge in gauges),
            "name": lambda _row, place: self._names[place],
            "missing": lambda _row, _place: "",
        }
        new, put = object.__new__, object.__setattr__  # of a frozen class

        def make(row: Row, place: int) -> Contact:
            reason = row[3][place]
            if reason != PRESENT:
                return missing_contact(self._node_ids[place], row[0], reason, self._names[place])
            contact = new(Contact)
            put(contact, "_source", (fields, row, place))
            put(contact, "P_newtons", P_newtons(row, place))
            return contact

        return make
