"""What the frames of a run say, finger by finger, against the load that was applied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from tipforce.arrays import BoolArray, FloatArray
from tipforce.device.codes import EMCY_BASE
from tipforce.scene import schema
from tipforce.scene.build import PDO_NAMES, Finger
from tipforce.scene.loads import UNLOADED, LoadHistory

if TYPE_CHECKING:
    from tipforce.host.decoding.decoder import Decoder, Samples
    from tipforce.host.frames.frame_array import FrameArray


QUANTITIES = ("P", "phi", "theta")
_NO_PDO = "contact PDO not sent"
# Why P is unknown, and why an angle is while P is not: the first that holds counts. False: the bit is clear.
_P_REASONS = (("fault", True), ("stale", True), ("saturated", True), ("calibrated", False))
_ANGLE_REASONS = (("contact", False), ("misses_tip", True), ("theta_unresolved", True))
_NAMES = {("calibrated", False): "not calibrated", ("contact", False): "no contact"}


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """The contact PDOs of one finger; k samples."""

    t_s: FloatArray
    """(k,): since the scene began."""
    estimated: FloatArray
    """(k, 3): P newtons, phi and theta degrees, as decoded; NaN where the node says unknown."""
    applied: FloatArray
    """(k, 3): the load at these times."""
    flags: dict[str, BoolArray]
    """Bits of the status byte by name, (k,); empty where the mapping has none."""
    slit_closed: BoolArray | None = None
    """(k,): the load closes the slit; None where the scene does not ask."""

    @property
    def error(self) -> FloatArray:
        """Estimated less applied, (k, 3), angles wrapped; NaN where unknown, and of angles where no force is applied:

        what has no direction has no error of it.
        """
        found = self.estimated - self.applied
        found[:, 1:] = (found[:, 1:] + 180.0) % 360.0 - 180.0
        found[self.applied[:, 0] == 0.0, 1:] = np.nan
        return found


@dataclass(frozen=True, slots=True)
class FingerResult:
    """One finger's account. Triples are P newtons, phi and theta degrees; NaN where there is none."""

    node_id: int
    syncs: int
    samples: int
    """Contact PDOs that were decoded."""
    known: tuple[int, int, int]
    """How many of them carry P, phi, theta."""
    applied_end: tuple[float, float, float]
    """At the last contact PDO; the angles of no force are NaN."""
    estimated_end: tuple[float, float, float]
    rms_error: tuple[float, float, float]
    """Over the samples where each is known, of angles those under a force: without one there is no direction."""
    max_error: tuple[float, float, float]
    """Largest absolute value."""
    slit_closed: int | None = None
    """Samples under a load that closes the slit; None where the scene does not ask."""
    missing: dict[str, int] = field(default_factory=dict)
    """SYNCs without a known P, and samples with P but without an angle, by reason."""
    emcy: dict[str, int] = field(default_factory=dict)
    """Error codes as "5010", in the order of their first appearance."""


def decoder_of(fingers: Sequence[Finger]) -> dict[int, Decoder]:
    """The one decoder of tipforce for each number of gauges, told of the mappings that are not the default ones."""
    from tipforce.host.decoding.decoder import Decoder

    found: dict[int, Decoder] = {}
    for gauges in sorted({finger.gauges for finger in fingers}):
        of_kind = [finger for finger in fingers if finger.gauges == gauges]
        decoder = found[gauges] = Decoder(gauges, [finger.node_id for finger in of_kind])
        for finger in of_kind:
            for pdo in finger.pdos:
                if pdo.remapped:
                    decoder.remap(finger.node_id, pdo.name, pdo.can_id, pdo.mapping)
    return found


def decode(fingers: Sequence[Finger], frames: FrameArray) -> dict[tuple[int, str], Samples]:
    """What was said, by (node-id, message name)."""
    found: dict[tuple[int, str], Samples] = {}
    for decoder in decoder_of(fingers).values():
        found |= decoder.decode(frames)
    return found


def contact_of(
    finger: Finger, messages: dict[tuple[int, str], Samples], slit: schema.Slit | None = None
) -> Contact | None:
    """The contact PDOs of a finger beside the load; None where none came."""
    samples = messages.get((finger.node_id, PDO_NAMES["contact"]))
    if samples is None:
        return None
    t_s: FloatArray = samples.t_ns / 1e9
    estimated = np.stack([samples.columns[name] for name in QUANTITIES], axis=-1)
    flags = {name: column for name, column in samples.columns.items() if column.dtype == np.bool_}
    applied = applied_at(finger.load, t_s)
    closed = None
    if slit is not None:
        from tipforce.scene.slit import slit_closed

        closed = slit_closed(slit, applied)
    return Contact(t_s, estimated, applied, flags, closed)


def applied_at(load: LoadHistory | None, t_s: FloatArray) -> FloatArray:
    """LoadHistory.at for many times: (k, 3)."""
    knots = np.array([(0.0, *UNLOADED)] if load is None else load.knots)
    after = np.searchsorted(knots[:, 0], t_s, side="right")
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(knots) - 1)
    gap = knots[after, 0] - knots[before, 0]
    part = np.where(gap > 0.0, (t_s - knots[before, 0]) / np.where(gap > 0.0, gap, 1.0), 0.0)
    start = knots[before, 1:]
    result: FloatArray = start + np.clip(part, 0.0, 1.0)[:, np.newaxis] * (knots[after, 1:] - start)
    return result


def emcy_of(node_id: int, frames: FrameArray) -> list[tuple[float, str]]:
    """(t_s, error code) of each EMCY of a node; a cure ("0000") is left out."""
    own = frames[frames["can_id"] == EMCY_BASE + node_id]
    codes = own["data"][:, 0].astype(np.uint16) | own["data"][:, 1].astype(np.uint16) << np.uint16(8)
    return [(t / 1e9, f"{code:04X}") for t, code in zip(own["t_ns"].tolist(), codes.tolist(), strict=True) if code]


def finger_result(finger: Finger, syncs: int, contact: Contact | None, emcy: list[tuple[float, str]]) -> FingerResult:
    """The account of one finger."""
    counts: dict[str, int] = {}
    for _, code in emcy:
        counts[code] = counts.get(code, 0) + 1
    nothing = (float("nan"),) * 3
    if contact is None or not len(contact.t_s):
        sent = any(pdo.name == PDO_NAMES["contact"] for pdo in finger.pdos)
        why = {"no frame": syncs} if sent else {_NO_PDO: syncs}
        return FingerResult(finger.node_id, syncs, 0, (0, 0, 0), nothing, nothing, nothing, nothing, None, why, counts)
    error = contact.error
    columns = [error[np.isfinite(error[:, k]), k] for k in range(3)]
    P_newtons, *angles = contact.applied[-1].tolist()
    return FingerResult(
        finger.node_id,
        syncs,
        len(contact.t_s),
        _counts(np.isfinite(contact.estimated)),
        _triple([P_newtons, *(angles if P_newtons else (float("nan"),) * 2)]),
        _triple(contact.estimated[-1].tolist()),
        _triple([float(np.sqrt(np.mean(c * c))) if len(c) else float("nan") for c in columns]),
        _triple([float(np.max(np.abs(c))) if len(c) else float("nan") for c in columns]),
        None if contact.slit_closed is None else int(contact.slit_closed.sum()),
        _missing(contact, syncs),
        counts,
    )


def _missing(contact: Contact, syncs: int) -> dict[str, int]:
    found: dict[str, int] = {}
    P_unknown = np.isnan(contact.estimated[:, 0])
    angle_unknown = ~P_unknown & np.isnan(contact.estimated[:, 1:]).any(axis=1)
    for left, reasons in ((P_unknown, _P_REASONS), (angle_unknown, _ANGLE_REASONS)):
        rest = left.copy()
        for name, value in reasons:
            if name in contact.flags:
                hit = rest & (contact.flags[name] == value)
                _count(found, _NAMES.get((name, value), name), int(hit.sum()))
                rest &= ~hit
        _count(found, "not said", int(rest.sum()))
    _count(found, "no frame", syncs - len(contact.t_s))
    return found


def _count(found: dict[str, int], name: str, count: int) -> None:
    if count > 0:
        found[name] = found.get(name, 0) + count


def _counts(known: BoolArray) -> tuple[int, int, int]:
    a, b, c = (int(column.sum()) for column in known.T)
    return a, b, c


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    a, b, c = values
    return a, b, c
