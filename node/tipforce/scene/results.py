"""What a run keeps and says: every frame; by finger the contact against the applied load; a table, a plot, checks."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from io import TextIOBase
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from canopen_device.core.codes import EMCY_BASE
from tipforce.arrays import BoolArray, FloatArray
from tipforce.errors import EnvironmentLackError, WriteError, needing
from tipforce.host.frames.frame_array import FRAME, FrameArray, RawFrame, frame_array
from tipforce.output_file import CANDUMP_LOG, CSV, FIGURES, NewFile, new_file, save_figure
from tipforce.samples.reasons import CAUSES
from tipforce.scene import schema
from tipforce.scene.build import Finger

if TYPE_CHECKING:
    from tipforce.host.decoding.decoder import Samples

BLOCK_FRAMES = 16_384
Emcy = Sequence[tuple[float, str]]  # (t_s, error code)
QUANTITIES = ("P", "phi", "theta")
# Why P is unknown, and why an angle is while P is not: the first that holds counts.
_P_CAUSES = {"fault": "fault", "stale": "stale", "saturated": "saturated", "uncalibrated": "not calibrated"}
_ANGLE_CAUSES = {"no_contact": "no contact", "misses_tip": "misses_tip", "theta_unresolved": "theta_unresolved"}


class Recording(AbstractContextManager["Recording"]):
    """Record frames in the order of their times. With ``log`` each is also written to that file. A context manager.
    Raises InputError for an unusable path of the log, WriteError when it cannot be written; then an old log stays."""

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
            from tipforce.host.logs.candump_format import CandumpFormat

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


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """The contact PDOs of one finger; k samples."""

    t_s: FloatArray
    """(k,): since the start of the scene."""
    estimated: FloatArray
    """(k, 3): P newtons, phi and theta degrees, as decoded; NaN where the node says unknown."""
    applied: FloatArray
    """(k, 3): the load at these times."""
    flags: dict[str, BoolArray]
    """Bits of the status byte by name, (k,); empty where the mapping has none."""
    slit_closed: BoolArray | None = None
    """(k,): the load closes the slit; None if the scene has no [slit]."""

    def errors(self, rows: BoolArray | slice = slice(None)) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return RMS and largest absolute value of estimate minus applied, of P, phi and theta over the rows where each
        is known, angles (wrapped) only under a force: without a force there is no direction. NaN if there is none."""
        applied = self.applied[rows]
        error = self.estimated[rows] - applied
        error[:, 1:] = (error[:, 1:] + 180.0) % 360.0 - 180.0
        error[applied[:, 0] == 0.0, 1:] = np.nan
        columns = [column[np.isfinite(column)] for column in error.T]
        rms = tuple(float(np.sqrt(np.mean(c * c))) if len(c) else math.nan for c in columns)
        return rms, tuple(float(np.max(np.abs(c))) if len(c) else math.nan for c in columns)


@dataclass(frozen=True, slots=True)
class FingerResult:
    """Results of one finger. Triples are P newtons, phi and theta degrees; NaN if there is none."""

    node_id: int
    syncs: int
    samples: int
    """Contact PDOs that were decoded."""
    known: tuple[int, ...]
    """Number of these with known P, phi, theta."""
    applied_end: tuple[float, ...]
    """At the last contact PDO; the angles are NaN without a force."""
    estimated_end: tuple[float, ...]
    rms_error: tuple[float, ...]
    """As of ``Contact.errors``."""
    max_error: tuple[float, ...]
    slit_closed: int | None = None
    """Samples under a load that closes the slit; None if the scene has no [slit]."""
    missing: dict[str, int] = field(default_factory=dict)
    """SYNCs without a known P, and samples with P but without an angle, by reason."""
    emcy: dict[str, int] = field(default_factory=dict)
    """Error codes as "5010", in the order of their first appearance."""


def decode(fingers: Sequence[Finger], frames: FrameArray) -> dict[tuple[int, str], Samples]:
    """Return the decoded values by (node-id, message name): a decoder for each number of gauges."""
    from tipforce.host.decoding.decoder import Decoder

    messages: dict[tuple[int, str], Samples] = {}
    for gauges in sorted({finger.gauges for finger in fingers}):
        of_kind = [finger for finger in fingers if finger.gauges == gauges]
        decoder = Decoder(gauges, [finger.node_id for finger in of_kind])
        for finger in of_kind:
            for pdo in finger.pdos:
                if pdo.remapped:
                    decoder.remap(finger.node_id, pdo.name, pdo.can_id, pdo.mapping)
        messages |= decoder.decode(frames)
    return messages


def contact_of(finger: Finger, messages: dict[tuple[int, str], Samples], slit: schema.Slit | None = None) -> Contact:
    """Return the contact PDOs of a finger with the load."""
    samples = messages.get((finger.node_id, "Contact"))
    if samples is None:
        return Contact(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), {})
    t_s: FloatArray = samples.t_ns / 1e9
    estimated = np.stack([samples.columns[name] for name in QUANTITIES], axis=-1)
    flags = {name: column for name, column in samples.columns.items() if column.dtype == np.bool_}
    applied = applied_at(finger.load, t_s)
    return Contact(t_s, estimated, applied, flags, None if slit is None else _slit_closed(slit, applied))


def applied_at(load: schema.LoadHistory | None, t_s: FloatArray) -> FloatArray:
    """Return LoadHistory.at for many times: (k, 3)."""
    knots = np.zeros((1, 4)) if load is None else np.array(load.knots)
    return np.stack([np.interp(t_s, knots[:, 0], column) for column in knots[:, 1:].T], axis=-1)


def emcy_of(node_id: int, frames: FrameArray) -> list[tuple[float, str]]:
    """Return (t_s, error code) of each EMCY of a node, without those that report "0000", the end of an error."""
    own = frames[frames["can_id"] == EMCY_BASE + node_id]
    codes = own["data"][:, 0].astype(np.uint16) | own["data"][:, 1].astype(np.uint16) << np.uint16(8)
    return [(t / 1e9, f"{code:04X}") for t, code in zip(own["t_ns"].tolist(), codes.tolist(), strict=True) if code]


def finger_result(finger: Finger, syncs: int, contact: Contact, emcy: Emcy) -> FingerResult:
    """Return the results of one finger."""
    counts, unknown = dict(Counter(code for _, code in emcy)), (math.nan,) * 3
    if not len(contact.t_s):
        sent = any(pdo.name == "Contact" for pdo in finger.pdos)
        why = {"no frame" if sent else "contact PDO not sent": syncs}
        return FingerResult(finger.node_id, syncs, 0, (0, 0, 0), unknown, unknown, unknown, unknown, None, why, counts)
    P_newtons, *angles = contact.applied[-1].tolist()
    return FingerResult(
        finger.node_id, syncs, len(contact.t_s), tuple(np.isfinite(contact.estimated).sum(axis=0).tolist()),
        (P_newtons, *(angles if P_newtons else unknown[1:])), tuple(contact.estimated[-1].tolist()), *contact.errors(),
        None if contact.slit_closed is None else int(contact.slit_closed.sum()), _missing(contact, syncs), counts,
    )  # fmt: skip


def _missing(contact: Contact, syncs: int) -> dict[str, int]:
    counts: Counter[str] = Counter()
    P_unknown = np.isnan(contact.estimated[:, 0])
    angle_unknown = ~P_unknown & np.isnan(contact.estimated[:, 1:]).any(axis=1)
    for left, causes in ((P_unknown, _P_CAUSES), (angle_unknown, _ANGLE_CAUSES)):
        rest = left.copy()
        for cause, name in causes.items():
            flag, is_set, _ = CAUSES[cause]
            if flag in contact.flags:
                hit = rest & (contact.flags[flag] == is_set)
                counts[name] += int(hit.sum())
                rest &= ~hit
        counts["not said"] += int(rest.sum())
    counts["no frame"] = syncs - len(contact.t_s)
    return {name: count for name, count in counts.items() if count > 0}


def _slit_closed(slit: schema.Slit, applied: FloatArray) -> BoolArray:
    """Return whether static loads (k, 3) would close the slit, (k,): simulated gauges stay linear, real ones do not."""
    from tipforce.sensor.structure.plane_frame import closing_load
    from tipforce.sensor.structure.strain import FABRICATED

    directions, which = np.unique(applied[:, 1:], axis=0, return_inverse=True)
    radians = np.radians(directions).tolist()
    limits = [closing_load(FABRICATED, theta, phi, 1e-3 * slit.gap_mm) for phi, theta in radians]
    closed: BoolArray = applied[:, 0] >= np.array(limits)[which.reshape(-1)]
    return closed


def write_table(path: str, messages: Mapping[tuple[int, str], Samples]) -> None:
    """Write columns t_s, node, message, then the signals; a cell is empty if a PDO has no such signal or no value. Rows
    are in the order of the frames. Raises InputError for an unusable path, WriteError if writing fails."""
    names = list(dict.fromkeys(name for samples in messages.values() for name in samples.columns))
    rows: list[tuple[int, int, list[object]]] = []
    for (node_id, message), samples in messages.items():
        columns = [[""] * len(samples.t_ns) for _ in names]
        scales = {signal.name: signal.scale for signal in samples.message.signals}
        for name, column in samples.columns.items():
            if column.dtype.kind == "f":
                digits = len(f"{scales[name]:.9f}".rstrip("0").partition(".")[2]) if name in scales else 0
                shown = ["" if np.isnan(value) else f"{value:.{digits}f}" for value in column]
            else:
                shown = [str(int(value)) for value in column]
            columns[names.index(name)] = shown
        for t_ns, row, *cells in zip(samples.t_ns.tolist(), samples.row.tolist(), *columns, strict=True):
            rows.append((row, node_id, [f"{1e-9 * t_ns:.6f}", node_id, message, *cells]))
    rows.sort(key=lambda entry: entry[:2])
    with new_file(path, CSV) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["t_s", "node", "message", *names])
        writer.writerows(cells for _, _, cells in rows)


def write_plot(path: str, title: str, contacts: Mapping[int, Contact]) -> None:
    """Plot P, phi, theta per finger. Raises EnvironmentLackError without matplotlib, InputError for the path."""
    with needing("plot: matplotlib is not installed: pip install 'tipforce[plot]'"):
        from matplotlib.figure import Figure
    figure = Figure(figsize=(13.0, 2.2 * len(contacts) + 1.0), layout="constrained")
    axes = figure.subplots(len(contacts), 3, sharex=True, squeeze=False)
    for row, (node_id, contact) in zip(axes, contacts.items(), strict=True):
        for k, (axis, label) in enumerate(zip(row, ("P (N)", "phi (degree)", "theta (degree)"), strict=True)):
            if len(contact.t_s):
                applied = contact.applied[:, k].copy()
                if k:
                    applied[contact.applied[:, 0] <= 0.0] = math.nan  # a direction without a force has no meaning
                axis.plot(contact.t_s, applied, color="0.6", linewidth=3.0, label="applied")
                axis.plot(contact.t_s, contact.estimated[:, k], color="C0", linewidth=0.8, label="estimated")
            axis.set_ylabel(label)
            axis.grid(alpha=0.3)
        row[0].set_title(f"node {node_id}", loc="left", fontsize=10)
    axes[0][0].legend(loc="best", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("t (s)")
    figure.suptitle(title)
    save_figure(figure, path, FIGURES)


@dataclass(frozen=True, slots=True)
class Check:
    """One expectation for one node."""

    node_id: int
    expected: str
    found: str
    ok: bool | None
    """None: not evaluated, because the run ended before the expectation's time."""


def judge(
    scene: schema.Scene, duration_s: float, syncs: Sequence[float], contacts: Mapping[int, Contact],
    emcys: Mapping[int, Emcy],
) -> list[Check]:  # fmt: skip
    """Return every expectation, for every node to which it applies. ``syncs``: their times, seconds."""
    checks = []
    for expect in scene.expect:
        # On a bus the last response arrives shortly after the end: without to_s it still counts.
        until = math.inf if expect.to_s is None else expect.to_s
        needs_s = scene.duration_s if expect.to_s is None else expect.to_s
        when = f"{expect.from_s:g} s to {needs_s:g} s: "
        for node_id in expect.nodes or scene.node_ids:
            total = sum(expect.from_s <= t <= until for t in syncs)
            t_s = contacts[node_id].t_s
            rows = (t_s >= expect.from_s) & (t_s <= until)
            emcy = [code for t, code in emcys[node_id] if expect.from_s <= t <= until]
            for name, measured, ok in _checks(expect, contacts[node_id], rows, total, emcy):
                checks.append(Check(node_id, when + name, measured, ok if needs_s <= duration_s else None))
    return checks


def _checks(
    expect: schema.Expect, contact: Contact, rows: BoolArray, syncs: int, emcy: Sequence[str]
) -> Iterator[tuple[str, str, bool]]:
    yield from _bounds(expect, *contact.errors(rows))
    share = int(np.isfinite(contact.estimated[rows, 0]).sum()) / syncs if syncs else 0.0
    least, most = expect.P_known_at_least, expect.P_known_at_most
    if least is not None:
        yield f"P known in at least {least:g} of the SYNCs", f"{share:.4g}", share >= least
    if most is not None:
        yield f"P known in at most {most:g} of the SYNCs", f"{share:.4g}", bool(syncs) and share <= most
    set_counts = {name: int(column[rows].sum()) for name, column in contact.flags.items()} if rows.any() else {}
    for name in expect.status_seen:
        count = set_counts.get(name, 0)
        yield f"status {name}", f"in {count} samples", count > 0
    for name in expect.status_never:
        # A bit that was not sent was not seen clear either.
        count = set_counts.get(name, -1)
        yield f"never status {name}", f"in {count} samples" if count >= 0 else "status not sent", count == 0
    if expect.slit_closes is not None:
        closed = 0 if contact.slit_closed is None else int(contact.slit_closed[rows].sum())
        word = "closes" if expect.slit_closes else "stays open"
        yield f"slit {word}", f"closed in {closed} samples", bool(rows.any()) and (closed > 0) == expect.slit_closes
    for code in expect.emcy_seen:
        yield f"EMCY {code}", ", ".join(sorted(set(emcy))) or "none", code in emcy
    if expect.emcy_none:
        yield "no EMCY", ", ".join(sorted(set(emcy))) or "none", not emcy


def _bounds(
    expect: schema.Expect, rms: tuple[float, ...], largest: tuple[float, ...]
) -> Iterator[tuple[str, str, bool]]:
    """Yield the bounds of errors. A bound without a known sample fails."""
    for word, key, errors in (("largest", "error", largest), ("RMS", "rms", rms)):
        for quantity, unit, error in zip(QUANTITIES, ("N", "deg", "deg"), errors, strict=True):
            limit = getattr(expect, f"{quantity}_{key}_{unit}")
            if limit is not None:
                measured = "no sample with a known value" if math.isnan(error) else f"{error:.4g} {unit}"
                yield f"{word} error of {quantity} at most {limit:g} {unit}", measured, error <= limit
