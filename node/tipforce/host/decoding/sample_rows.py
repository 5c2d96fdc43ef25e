"""Group frames into samples: consecutive PDOs of a node with the same counter."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.host.decoding.sample_table import NO_COUNTER

IntArray = npt.NDArray[np.intp]

GAP_NS = 200_000_000
"""PDOs of a node further apart belong to different samples: 15 nodes with 4 PDOs at 50 kbit/s fit in this time."""
GAP_FRAMES = 8192
"""The same in decoded frames, which also works for logs without times."""


class Frames(NamedTuple):
    """Decoded frames in order of arrival, (k,) each."""

    number: npt.NDArray[np.int64]  # of the decoded frame, over the whole recording
    t_ns: npt.NDArray[np.int64]
    key: npt.NDArray[np.uint16]  # channel and node
    message: npt.NDArray[np.uint8]  # ascending in the order in which a node sends its PDOs
    counter: npt.NDArray[np.int16]  # NO_COUNTER if the message has none
    cyclic: npt.NDArray[np.bool_]  # the PDO follows SYNC


class Runs(NamedTuple):
    """``start`` (k,): index of the first frame of each frame's row. ``order``: frames by key, stable."""

    start: IntArray
    order: IntArray
    cyclic: IntArray  # indices of frames that follow SYNC and have a counter, by key


def runs(frames: Frames) -> Runs:
    """Group frames into rows.

    A node sends the PDOs of one SYNC in their order and with the counter of one latched sample. So a cyclic frame
    continues the row of the node's previous frame if the counter is the same, the PDO a later one and the gap
    small. An event-driven PDO carries the counter of the last latch: it joins the node's last row if that has the
    same counter, and no PDO of its kind yet. Every other frame starts its own row. The rule uses only pairs of frames,
    so the result does not depend on how a log is split into blocks.
    """
    order: IntArray = np.argsort(frames.key, kind="stable")
    start = np.arange(len(order))
    steady = bool((frames.cyclic & (frames.counter != NO_COUNTER)).all())
    chosen = order if steady else order[(frames.cyclic & (frames.counter != NO_COUNTER))[order]]
    if len(chosen):
        goes_on = _goes_on(frames, chosen)
        first = np.arange(len(chosen))
        first[1:][goes_on] = 0
        start[chosen] = chosen[np.maximum.accumulate(first)]
    if not steady and len(chosen):
        _join_events(frames, order, chosen, start)
    return Runs(start, order, chosen)


def _goes_on(frames: Frames, chosen: IntArray) -> npt.NDArray[np.bool_]:
    """Return whether each chosen frame but the first belongs to the sample of the previous one."""
    word = frames.key.astype(np.uint32) << 16
    word |= frames.counter.view(np.uint16).astype(np.uint32) << 8 & 0xFF00
    word |= frames.message
    word, t_ns, number = word[chosen], frames.t_ns[chosen], frames.number[chosen]
    goes_on = word[1:] ^ word[:-1] < 256
    goes_on &= word[1:] > word[:-1]
    goes_on &= np.abs(np.diff(t_ns)) <= GAP_NS
    goes_on &= np.diff(number) <= GAP_FRAMES
    return np.asarray(goes_on)


def _same_sample(frames: Frames, before: IntArray, after: IntArray) -> npt.NDArray[np.bool_]:
    same = frames.key[before] == frames.key[after]
    same &= frames.counter[before] == frames.counter[after]
    same &= np.abs(frames.t_ns[after] - frames.t_ns[before]) <= GAP_NS
    same &= frames.number[after] - frames.number[before] <= GAP_FRAMES
    return np.asarray(same)


def _join_events(frames: Frames, order: IntArray, cyclic: IntArray, start: IntArray) -> None:
    place = np.empty(len(order), dtype=np.intp)
    place[order] = np.arange(len(order))
    event = order[(~frames.cyclic & (frames.counter != NO_COUNTER))[order]]
    before = np.searchsorted(place[cyclic], place[event]) - 1
    event, before = event[before >= 0], before[before >= 0]
    joins = _same_sample(frames, cyclic[before], event)
    event, row = event[joins], start[cyclic[before[joins]]]
    _, first = np.unique(row * 256 + frames.message[event], return_index=True)
    start[event[first]] = row[first]


def open_from(frames: Frames, found: Runs) -> int:
    """Return the index of the first row that a later frame may join; the number of frames if there is none."""
    count = len(frames.key)
    if not len(found.cyclic):
        return count
    of_key = frames.key[found.cyclic]
    last = found.cyclic[np.flatnonzero(np.append(of_key[1:] != of_key[:-1], True))]
    near = frames.t_ns[-1] - frames.t_ns[last] <= GAP_NS
    near &= frames.number[-1] - frames.number[last] < GAP_FRAMES
    return int(found.start[last[near]].min(initial=count))


def certain_from(frames: Frames, found: Runs) -> int:
    """Return the index from which no row depends on frames before the first; the number of frames if there is none."""
    early = frames.t_ns - frames.t_ns[0] <= GAP_NS
    early &= frames.number - frames.number[0] <= GAP_FRAMES
    uncertain = -1
    order, key = found.order, frames.key[found.order]
    for nodes in np.split(order, np.flatnonzero(key[1:] != key[:-1]) + 1):
        cyclic = nodes[frames.cyclic[nodes] & (frames.counter[nodes] != NO_COUNTER)]
        if not early[nodes[0]]:
            continue
        first = cyclic[0] if len(cyclic) else nodes[-1]
        waiting = nodes[(found.start[nodes] == first) | (nodes < first)]
        uncertain = max(uncertain, int(waiting[early[waiting]].max(initial=-1)))
    return uncertain + 1


def row_numbers(start: IntArray, end: int) -> tuple[IntArray, IntArray]:
    """Return (first, row): index of the first frame of each row that starts before ``end``; each frame's row number."""
    is_first = start == np.arange(len(start))
    row: IntArray = (np.cumsum(is_first) - 1)[start]
    return np.flatnonzero(is_first[:end]), row


def joined(*parts: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the concatenated arrays, without a copy if there is only one."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
