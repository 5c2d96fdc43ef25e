"""The state of each finger at a moment, from the rows up to then: never live without a young sample."""

from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from tipforce.samples import reasons
from tipforce.samples.columns import Block
from tipforce.sensor.contact import scalar

STALE_PERIODS = 2.5
STALE_S = 0.5
"""Used if no SYNC period is known."""
STREAM_STALE_S = 0.1
"""Minimum age of a stale stream: three pictures of the page."""
NO_ANSWER_S = 2.0
_PERIOD_ROWS = 33
_LOOK_BACK_ROWS = 4096
_DIGITS = (4, 3, 3)  # P in N, phi and theta in degrees: one more than the node's resolution

Word = Literal["live", "stale", "unknown", "silent"]


class FingerState(
    msgspec.Struct,
    frozen=True,
    omit_defaults=True,
    rename={
        "word": "w", "since_ms": "since", "status": "s", "reason": "why", "angle_reason": "angle", "flags": "f",
        "contact": "c", "gauges": "g",
    },
):  # fmt: skip
    """State of one finger, as a page gets it. A "silent" one has no numbers; those of a "stale" one are old."""

    word: Word
    since_ms: float
    """Time of the sample; 0 for none."""
    status: int = 0
    reason: str = ""
    """Why P, phi and theta are unknown; empty otherwise."""
    angle_reason: str = ""
    """Why only phi or theta is unknown."""
    flags: tuple[str, ...] = ()
    """What the status says besides contact and calibration, in words."""
    contact: tuple[float, ...] = ()
    u: tuple[float, ...] = ()
    gauges: tuple[float, ...] = ()


def period_ns(t_ns: npt.NDArray[np.int64]) -> int:
    """Return the SYNC period of the last rows (m,) in nanoseconds; 0 for too few rows."""
    times = t_ns[-_PERIOD_ROWS:]
    return int(np.median(np.diff(times))) if len(times) > 2 else 0


def finger_states(rows: Block, now_ns: int) -> list[FingerState]:
    """Return the state of each finger at ``now_ns``, from the rows up to then.

    A sample is live for 2.5 SYNC periods, counted in SYNCs while these arrive (0.5 s if the period is unknown; without
    SYNC at least 0.1 s, the page's resolution).
    """
    recent = rows.part(slice(-_PERIOD_ROWS, None))
    if not len(recent):
        return [_silent(0)] * rows.status.shape[1]
    period = period_ns(recent.t_ns)
    limit_ns = int(STALE_PERIODS * period) if period else int(STALE_S * 1e9)
    newest_ns = int(recent.t_ns[-1])
    stopped = now_ns - newest_ns > max(limit_ns, int(STREAM_STALE_S * 1e9))
    # The row to show of each finger: its last new and recent one, else any response, else -1. A SYNC without a new
    # sample (status bit 3) is ignored while the previous sample is not stale.
    young = (recent.t_ns >= newest_ns - limit_ns)[:, np.newaxis]
    answered = (recent.status & reasons.NO_ANSWER == 0) & young
    number = np.arange(len(recent))[:, np.newaxis]
    fresh_row = np.where(answered & (recent.status & scalar.STALE == 0), number, -1).max(axis=0)
    shown = np.where(fresh_row >= 0, fresh_row, np.where(answered, number, -1).max(axis=0)).tolist()
    return [
        _state(recent, row, k, "live") if row >= 0 and not stopped else _old(rows, k, now_ns)
        for k, row in enumerate(shown)
    ]


def _old(rows: Block, k: int, now_ns: int) -> FingerState:
    back = rows.part(slice(-_LOOK_BACK_ROWS, None))
    answered = np.flatnonzero(back.status[:, k] & reasons.NO_ANSWER == 0)
    if not len(answered):
        return _silent(0)
    row = int(answered[-1])
    if now_ns - back.t_ns[row] > NO_ANSWER_S * 1e9:
        return _silent(int(back.t_ns[row]))
    return _state(back, row, k, "stale")


def _state(block: Block, row: int, k: int, word: Word) -> FingerState:
    contact, status = block.contact[row, k], int(block.status[row, k])
    reason = angle_reason = ""
    if np.isnan(contact[0]):
        reason = next(iter(reasons.why_no_force(status)), "the node sends no force")
    elif np.isnan(contact[1:]).any():
        angle_reason = reasons.why_no_angle(status) or reasons.UNKNOWN_TO_THE_NODE
    if reason and word == "live":
        word = "unknown"
    flags = tuple(reasons.flags(status) if reason else reasons.doubts(status))
    values, u = (
        tuple(round(value, digits) for value, digits in zip(of[row, k].tolist(), _DIGITS, strict=True))
        for of in (block.contact, block.u)
    )
    strains = tuple(round(strain, 1) for strain in block.gauges[row, k].tolist())
    return FingerState(word, int(block.t_ns[row]) / 1e6, status, reason, angle_reason, flags, values, u, strains)


def _silent(since_ns: int) -> FingerState:
    return FingerState("silent", since_ns / 1e6, reason="no response")
