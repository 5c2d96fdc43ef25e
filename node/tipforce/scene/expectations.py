"""Compare a scene's expectations with the received frames."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tipforce.scene import schema
from tipforce.scene.results import QUANTITIES, Contact

Emcy = Sequence[tuple[float, str]]  # (t_s, error code)


@dataclass(frozen=True, slots=True)
class Check:
    """One expectation for one node."""

    node_id: int
    expected: str
    found: str
    ok: bool | None
    """None: not evaluated, because the run ended before the expectation's time."""


def judge(
    scene: schema.Scene,
    duration_s: float,
    syncs: Sequence[float],
    contacts: Mapping[int, Contact | None],
    emcys: Mapping[int, Emcy],
) -> list[Check]:
    """Return every expectation, for every node to which it applies. ``syncs``: their times, seconds."""
    found = []
    for expect in scene.expect:
        # On a bus the last response arrives shortly after the end: without to_s it still counts.
        until = math.inf if expect.to_s is None else expect.to_s
        needs_s = scene.duration_s if expect.to_s is None else expect.to_s
        when = f"{expect.from_s:g} s to {needs_s:g} s: "
        for node_id in expect.nodes or scene.node_ids:
            total = sum(expect.from_s <= t <= until for t in syncs)
            contact = contacts.get(node_id)
            inside = None if contact is None else _cut(contact, expect.from_s, until)
            emcy = [code for t, code in emcys.get(node_id, ()) if expect.from_s <= t <= until]
            for name, told, ok in _checks(expect, inside, total, emcy):
                found.append(Check(node_id, when + name, told, ok if needs_s <= duration_s else None))
    return found


def _cut(contact: Contact, from_s: float, until_s: float) -> Contact:
    rows = (contact.t_s >= from_s) & (contact.t_s <= until_s)
    flags = {name: column[rows] for name, column in contact.flags.items()}
    closed = None if contact.slit_closed is None else contact.slit_closed[rows]
    return Contact(contact.t_s[rows], contact.estimated[rows], contact.applied[rows], flags, closed)


def _checks(
    expect: schema.Expect, contact: Contact | None, syncs: int, emcy: Sequence[str]
) -> Iterator[tuple[str, str, bool]]:
    """Return (what is expected, what was found, whether it holds)."""
    yield from _errors(expect, contact)
    known = 0 if contact is None else int(np.isfinite(contact.estimated[:, 0]).sum())
    share = known / syncs if syncs else 0.0
    if expect.P_known_at_least is not None:
        yield (
            f"P known in at least {expect.P_known_at_least:g} of the SYNCs",
            f"{share:.4g}",
            (share >= expect.P_known_at_least),
        )
    if expect.P_known_at_most is not None:
        yield (
            f"P known in at most {expect.P_known_at_most:g} of the SYNCs",
            f"{share:.4g}",
            (bool(syncs) and share <= expect.P_known_at_most),
        )
    flags = {} if contact is None else contact.flags
    for name in expect.status_seen:
        count = int(flags[name].sum()) if name in flags else 0
        yield f"status {name}", f"in {count} samples", count > 0
    for name in expect.status_never:
        # A bit that was never sent was not seen clear either.
        count = int(flags[name].sum()) if name in flags else -1
        yield f"never status {name}", f"in {count} samples" if count >= 0 else "status not sent", count == 0
    if expect.slit_closes is not None:
        closed = 0 if contact is None or contact.slit_closed is None else int(contact.slit_closed.sum())
        word = "closes" if expect.slit_closes else "stays open"
        yield f"slit {word}", f"closed in {closed} samples", (closed > 0) == expect.slit_closes
    for code in expect.emcy_seen:
        yield f"EMCY {code}", ", ".join(sorted(set(emcy))) or "none", code in emcy
    if expect.emcy_none:
        yield "no EMCY", ", ".join(sorted(set(emcy))) or "none", not emcy


def _errors(expect: schema.Expect, contact: Contact | None) -> Iterator[tuple[str, str, bool]]:
    """Yield the bounds of errors. A bound without a known sample fails."""
    error = None if contact is None else contact.error
    limits = (
        ("largest", (expect.P_error_N, expect.phi_error_deg, expect.theta_error_deg)),
        ("RMS", (expect.P_rms_N, expect.phi_rms_deg, expect.theta_rms_deg)),
    )
    for word, triple in limits:
        for k, limit in enumerate(triple):
            if limit is None:
                continue
            unit = "N" if k == 0 else "deg"
            column = np.zeros(0) if error is None else error[np.isfinite(error[:, k]), k]
            text = f"{word} error of {QUANTITIES[k]} at most {limit:g} {unit}"
            if not len(column):
                yield text, "no sample with a known value", False
                continue
            size = float(np.max(np.abs(column)) if word == "largest" else np.sqrt(np.mean(column * column)))
            yield text, f"{size:.4g} {unit}", size <= limit
