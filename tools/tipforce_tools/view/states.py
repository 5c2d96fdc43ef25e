"""State of each finger at a moment: live, stale since, unknown and why, or silent. A pure function of rows and time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding import status_words
from tipforce_tools.view import blocks
from tipforce_tools.view.blocks import Block
from tipforce_tools.view.history import History

STALE_PERIODS = 2.5
STALE_S = 0.5
"""Used if no SYNC period is known."""
STREAM_STALE_S = 0.1
"""Minimum age of a stale stream: three pictures of the page."""
NO_ANSWER_S = 2.0
_PERIOD_ROWS = 33
_LOOK_BACK_ROWS = 4096

Word = Literal["live", "stale", "unknown", "silent"]


@dataclass(frozen=True, slots=True)
class FingerState:
    """State of one finger. A "silent" one has no numbers; those of a "stale" one are from ``since_ns``."""

    word: Word
    reason: str
    """Why P, phi and theta are unknown; empty otherwise."""
    angle_reason: str
    """Why only phi or theta is unknown."""
    since_ns: int
    """Time of the sample; 0 for none."""
    status: int
    contact: tuple[float, float, float]
    u: tuple[float, float, float]
    gauges: tuple[float, ...]
    flags: tuple[str, ...] = ()
    """What the status says besides contact and calibration, in words."""


def period_ns(t_ns: npt.NDArray[np.int64]) -> int:
    """Return the SYNC period of the last rows (m,) in nanoseconds; 0 for too few rows."""
    times = t_ns[-_PERIOD_ROWS:]
    return int(np.median(np.diff(times))) if len(times) > 2 else 0


def finger_states(history: History, now_ns: int, fingers: int) -> list[FingerState]:
    """Return the state of each finger at ``now_ns``, from the rows up to then.

    A sample is live for 2.5 SYNC periods (0.5 s if the period is unknown), counted in SYNCs while these arrive.
    Without SYNC the minimum is 0.1 s, the resolution of the page.
    """
    last = int(np.searchsorted(history.t_ns, now_ns, side="right"))
    recent = history.part(max(0, last - _PERIOD_ROWS), last)
    if not len(recent):
        return [_silent(0)] * fingers
    period = period_ns(recent.t_ns)
    limit_ns = int(STALE_PERIODS * period) if period else int(STALE_S * 1e9)
    newest_ns = int(recent.t_ns[-1])
    stopped = now_ns - newest_ns > max(limit_ns, int(STREAM_STALE_S * 1e9))
    rows = _newest(recent, newest_ns - limit_ns)
    found = []
    for k, row in enumerate(rows.tolist()):
        if row >= 0 and not stopped:
            found.append(_state(recent, row, k, "live"))
        else:
            found.append(_old(history, last, k, now_ns))
    return found


def _newest(recent: Block, oldest_ns: int) -> npt.NDArray[np.intp]:
    """Return (k,) the row to show of each finger: its last new and recent row, else any response, else -1.

    A SYNC without a new sample (status bit 3) is ignored while the previous sample is not stale.
    """
    young = (recent.t_ns >= oldest_ns)[:, np.newaxis]
    answered = (recent.status & blocks.MISSING == 0) & young
    fresh = answered & (recent.status & blocks.REPEATED == 0)
    number = np.arange(len(recent))[:, np.newaxis]
    fresh_row, any_row = (np.where(mask, number, -1).max(axis=0) for mask in (fresh, answered))
    rows: npt.NDArray[np.intp] = np.where(fresh_row >= 0, fresh_row, any_row)
    return rows


def _old(history: History, last: int, k: int, now_ns: int) -> FingerState:
    """Return the state of a finger without a recent response: its last one, unless that is too old."""
    back = history.part(max(0, last - _LOOK_BACK_ROWS), last)
    answered = np.flatnonzero(back.status[:, k] & blocks.MISSING == 0)
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
        reason = next(iter(status_words.why_no_force(status)), "the node sends no force")
    elif np.isnan(contact[1:]).any():
        angle_reason = status_words.why_no_angle(status) or status_words.UNKNOWN_TO_THE_NODE
    if reason and word == "live":
        word = "unknown"
    flags = tuple(status_words.flags(status) if reason else status_words.doubts(status))
    P, phi, theta = contact.tolist()
    u_P, u_phi, u_theta = block.u[row, k].tolist()
    strains = tuple(block.gauges[row, k].tolist())
    since_ns = int(block.t_ns[row])
    contact_values, u = (P, phi, theta), (u_P, u_phi, u_theta)
    return FingerState(word, reason, angle_reason, since_ns, status, contact_values, u, strains, flags)


def _silent(since_ns: int) -> FingerState:
    nan = float("nan")
    return FingerState("silent", "no response", "", since_ns, 0, (nan, nan, nan), (nan, nan, nan), ())
