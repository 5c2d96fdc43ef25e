"""Observations of n fingers, (n, 3) for P (newtons), phi, theta (radians): ``values``, ``uncertainties`` in float32,
``valid`` int8. What is unknown or beyond the space is 0, not valid, with the largest uncertainty of the space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from math import pi
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError, needing
from tipforce.host.decoding.log import Log
from tipforce.samples.contact import Contact

if TYPE_CHECKING:
    from gymnasium import spaces

    from tipforce_robots.mujoco.twin import TwinSample

Observation = dict[str, npt.NDArray[np.float32] | npt.NDArray[np.int8]]
"""``values``, ``uncertainties`` and ``valid``."""
LARGEST = np.array([32.767, pi, pi], dtype=np.float32)
"""Of P, as INTEGER16 in mN on the bus, and of the angles; of their uncertainties as well."""
_LEAST = np.array([0.0, -pi, -pi], dtype=np.float32)
_VALUES = ("P_newtons", "phi_deg", "theta_deg")
_UNCERTAINTIES = ("u_P_newtons", "u_phi_deg", "u_theta_deg")
_GAP_PERIODS = 1.5  # between two samples of a window: more is a gap


def observation_space(fingers: int) -> spaces.Dict:
    """Return the space of ``observation``. Raises InputError below 1 finger, EnvironmentLackError without gymnasium."""
    with needing('gymnasium is not installed: pip install "tipforce[gymnasium]"'):
        from gymnasium import spaces
    if fingers < 1:
        raise InputError(f"fingers = {fingers}: allowed is 1 or more")
    largest = np.tile(LARGEST, (fingers, 1))
    boxes = {
        "values": spaces.Box(np.tile(_LEAST, (fingers, 1)), largest),
        "uncertainties": spaces.Box(np.zeros_like(largest), largest),
    }
    return spaces.Dict({**boxes, "valid": spaces.MultiBinary((fingers, 3))})


def observation(row: Mapping[str, Contact] | Mapping[str, TwinSample]) -> Observation:
    """Return one row of fingers, in its order: a ``HandRow``, or what ``Fingertips.read`` returned."""
    contacts = [tip if isinstance(tip, Contact) else tip.contact for tip in row.values()]
    columns = ([[getattr(tip, name) for name in names] for tip in contacts] for names in (_VALUES, _UNCERTAINTIES))
    return masked(*(np.array(column, dtype=np.float64).reshape(-1, 3) for column in columns))


def masked(values: FloatArray, uncertainties: FloatArray) -> Observation:
    """Return the observation of values and uncertainties (..., 3), P in newtons and angles in degrees, NaN unknown."""
    known_values, u = values.astype(np.float32), uncertainties.astype(np.float32)
    for array in (known_values, u):
        array[..., 1:] *= np.float32(pi / 180.0)
    with np.errstate(invalid="ignore"):
        valid = (known_values >= _LEAST) & (known_values <= LARGEST)
        known = valid & (u >= 0.0) & (u <= LARGEST)
    known_values[~valid] = 0.0
    return {"values": known_values, "uncertainties": np.where(known, u, LARGEST), "valid": valid.astype(np.int8)}


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
        """Return windows (m, length, ...), one each ``stride``: views, or copies where a gap of more than 1.5 median
        periods, which none crosses, is left out. Raises InputError for a length or stride below 1."""
        if length < 1 or stride < 1:
            raise InputError(f"windows of length {length}, stride {stride}: allowed is 1 or more")
        arrays: list[npt.NDArray[Any]] = [getattr(self, field.name) for field in fields(self)]
        starts = len(self) - length + 1
        if starts < 1:
            return Observations(*(np.zeros((0, length, *array.shape[1:]), array.dtype) for array in arrays))
        whole = np.ones(starts, dtype=np.bool_)
        if length > 1:
            steps = np.diff(self.t_s)
            gaps = np.cumsum(np.concatenate([[0], steps > _GAP_PERIODS * np.median(steps)]))
            whole = gaps[length - 1 :] == gaps[:starts]
        chosen = whole[::stride]
        windows = (np.lib.stride_tricks.sliding_window_view(array, length, axis=0) for array in arrays)
        views = (np.moveaxis(view, -1, 1)[::stride] for view in windows)
        return Observations(*(view if chosen.all() else view[chosen] for view in views))


def recorded_observations(log: Log, node_ids: Sequence[int] | None = None) -> Observations:
    """Return the samples of ``log``, one for each sample of the first finger; another without a sample within half its
    period is not valid there. Raises InputError for nodes that the log does not have, and times that go back."""
    chosen = list(log if node_ids is None else node_ids)
    if not chosen or not set(chosen) <= set(log):
        raise InputError(f"nodes {chosen}: the log has {', '.join(map(str, log)) or 'none'}")
    t_s = log[chosen[0]].t_s
    for node_id in chosen:
        if not (np.diff(log[node_id].t_s, prepend=-np.inf) >= 0.0).all():
            raise InputError(f"node {node_id}: times that are missing or go back: allowed are those of one clock")
    half_period_s = 0.5 * float(np.median(np.diff(t_s))) if len(t_s) > 1 else np.inf
    values, uncertainties = np.full((2, len(t_s), len(chosen), 3), np.nan)
    for k, node_id in enumerate(chosen):
        node = log[node_id]
        if not len(node):
            continue
        nearest = np.searchsorted(0.5 * (node.t_s[1:] + node.t_s[:-1]), t_s)  # changes midway between two samples
        near = np.abs(node.t_s[nearest] - t_s) <= half_period_s
        at = nearest[near]
        for array, names in ((values, _VALUES), (uncertainties, _UNCERTAINTIES)):
            array[near, k] = np.stack([getattr(node, name)[at] for name in names], axis=-1)
    arrays = masked(values, uncertainties)
    return Observations(t_s, **arrays)  # type: ignore[arg-type]
