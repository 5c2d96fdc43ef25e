"""A recording as observations: the samples of all nodes on one time axis, and windows of them for training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError
from tipforce.host.decoding.log import Log
from tipforce.learning.spaces import masked

FloatArray = npt.NDArray[np.float64]
_GAP_PERIODS = 1.5  # between two samples of a window: more is a gap


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """k observations of n fingers, or m windows of them: (k, ...) or (m, length, ...). See ``observation_space``."""

    t_s: FloatArray
    """(k,) time of the first finger's sample, seconds of the epoch."""
    values: npt.NDArray[np.float32]
    """(k, n, 3) P in newtons, phi and theta in radians."""
    uncertainties: npt.NDArray[np.float32]
    """(k, n, 3)"""
    valid: npt.NDArray[np.int8]
    """(k, n, 3)"""

    def __len__(self) -> int:
        return len(self.t_s)

    def windows(self, length: int, stride: int = 1) -> Observations:
        """Return windows of ``length`` observations in sequence, one each ``stride``; none crosses a gap.

        Arrays get the shape (m, length, ...): views where the recording has no gap, otherwise copies. A gap is more
        than 1.5 median periods. Raises InputError for a length or stride below 1.
        """
        if length < 1 or stride < 1:
            raise InputError(f"windows of length {length}, stride {stride}: allowed is 1 or more")
        starts = max(0, len(self) - length + 1)
        whole = np.ones(starts, dtype=np.bool_)
        if length > 1 and starts:
            steps = np.diff(self.t_s)
            gaps = np.cumsum(np.concatenate([[0], steps > _GAP_PERIODS * np.median(steps)]))
            whole = gaps[length - 1 :] == gaps[:starts]
        chosen = whole[::stride]
        found: dict[str, npt.NDArray[Any]] = {}
        for field in fields(self):
            array = getattr(self, field.name)
            if not starts:
                found[field.name] = np.zeros((0, length, *array.shape[1:]), array.dtype)
                continue
            view = np.lib.stride_tricks.sliding_window_view(array, length, axis=0)
            view = np.moveaxis(view, -1, 1)[::stride]
            found[field.name] = view if chosen.all() else view[chosen]
        return Observations(**found)


def recorded_observations(log: Log, node_ids: Sequence[int] | None = None) -> Observations:
    """Return the samples of ``log`` (``tipforce.read_log``) as observations, one for each sample of the first node.

    ``node_ids``: fingers in order, default all of the log. A finger without a sample within half a period of the first
    finger's is not valid in that observation. Raises InputError for nodes that the log does not have.
    """
    chosen = list(log) if node_ids is None else list(node_ids)
    if not chosen or not set(chosen) <= set(log):
        raise InputError(f"nodes {chosen}: the log has {', '.join(map(str, log)) or 'none'}")
    t_s = log[chosen[0]].t_s
    half_period_s = 0.5 * float(np.median(np.diff(t_s))) if len(t_s) > 1 else np.inf
    values, uncertainties = np.full((2, len(t_s), len(chosen), 3), np.nan)
    for k, node_id in enumerate(chosen):
        node = log[node_id]
        if not len(node):
            continue
        nearest = _nearest(node.t_s, t_s)
        near = np.abs(node.t_s[nearest] - t_s) <= half_period_s
        at = nearest[near]
        for array, names in ((values, _VALUES), (uncertainties, _UNCERTAINTIES)):
            array[near, k] = np.stack([getattr(node, name)[at] for name in names], axis=-1)
    found = masked(values, uncertainties)
    return Observations(t_s, **found)  # type: ignore[arg-type]


_VALUES = ("P_newtons", "phi_deg", "theta_deg")
_UNCERTAINTIES = ("u_P_newtons", "u_phi_deg", "u_theta_deg")


def _nearest(times_s: FloatArray, wanted_s: FloatArray) -> npt.NDArray[np.intp]:
    after = np.clip(np.searchsorted(times_s, wanted_s), 1, max(1, len(times_s) - 1))
    if len(times_s) == 1:
        return np.zeros(len(wanted_s), dtype=np.intp)
    earlier = wanted_s - times_s[after - 1] <= times_s[after] - wanted_s
    return after - earlier
