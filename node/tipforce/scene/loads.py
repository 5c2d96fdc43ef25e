"""Loads on a fingertip over time: knots of (t, P, phi, theta), linear in between."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from itertools import pairwise

from tipforce.errors import InputError
from tipforce.scene import schema
from tipforce.sources.simulated import force_of

Triple = tuple[float, float, float]  # P newtons, phi and theta degrees
Knot = tuple[float, float, float, float]  # t seconds, P, phi, theta

UNLOADED: Triple = (0.0, 0.0, 0.0)


class LoadHistory:
    """P, phi and theta of one finger, linear between its knots, constant before the first and after the last.

    Two knots at one time make a step: the later one applies from that time on.
    """

    __slots__ = ("_times", "knots")

    def __init__(self, knots: Sequence[Knot]) -> None:
        self.knots = tuple(knots)
        self._times = [knot[0] for knot in self.knots]

    @property
    def constant(self) -> bool:
        """True if the load is constant over time."""
        return all(knot[1:] == self.knots[0][1:] for knot in self.knots)

    def at(self, t_s: float) -> Triple:
        """Return (P newtons, phi degree, theta degree) at a time."""
        after = bisect.bisect_right(self._times, t_s)
        if after == 0 or after == len(self.knots):
            _, P, phi, theta = self.knots[max(after - 1, 0)]
            return P, phi, theta
        before, behind = self.knots[after - 1], self.knots[after]
        part = (t_s - before[0]) / (behind[0] - before[0])
        P, phi, theta = (a + part * (b - a) for a, b in zip(before[1:], behind[1:], strict=True))
        return P, phi, theta

    def force(self, t_s: float) -> Triple:
        """Return (F1, F2, F3) in newtons, equation (16)."""
        return force_of(self.at(t_s))


def load_of(scene: schema.Scene, node_id: int) -> LoadHistory | None:
    """Return the load of a node, None if the scene names none."""
    histories = (load_history(load, node_id) for load in scene.loads if not load.nodes or node_id in load.nodes)
    return next((history for history in histories if history is not None), None)


def load_history(load: schema.Load, node_id: int) -> LoadHistory | None:
    """Return the knots of one [[loads]] table for one node; None for a finger that a grasp does not use."""
    if isinstance(load, schema.Static):
        return LoadHistory([(0.0, load.P_N, load.phi_deg, load.theta_deg)])
    if isinstance(load, schema.History):
        return _given_history(load)
    if isinstance(load, schema.Grooves):
        return LoadHistory(_groove_knots(load))
    direction: schema.Ramp | schema.Tap | schema.Finger
    if isinstance(load, schema.Grasp):
        finger = next((finger for finger in load.fingers if finger.node == node_id), None)
        if finger is None:
            return None
        begin, direction = load.start_s + finger.delay_s, finger
        closed = begin + load.close_s
        opening = closed + load.hold_s
        magnitudes = [(begin, 0.0), (closed, finger.P_N), (opening, finger.P_N), (opening + load.open_s, 0.0)]
    elif isinstance(load, schema.Ramp):
        magnitudes, direction = [(load.start_s, load.from_N), (load.end_s, load.to_N)], load
    else:
        magnitudes, direction = [], load
        for t in sorted(load.at_s):
            peak = t + 1e-3 * load.rise_ms
            magnitudes += [(t, 0.0), (peak, load.P_N), (peak + 1e-3 * load.fall_ms, 0.0)]
    return LoadHistory([(t, P, direction.phi_deg, direction.theta_deg) for t, P in magnitudes])


def _given_history(load: schema.History) -> LoadHistory:
    count = len(load.t_s)
    columns = {
        name: value if isinstance(value, tuple) else (value,) * count
        for name, value in (("P_N", load.P_N), ("phi_deg", load.phi_deg), ("theta_deg", load.theta_deg))
    }
    for name, column in columns.items():
        if len(column) != count or not count:
            raise InputError(f"{name} has {len(column)} values: allowed are {count} (as t_s) or one number")
    if any(later < earlier for earlier, later in pairwise(load.t_s)):
        raise InputError(f"t_s = {list(load.t_s)}: allowed are non-decreasing times")
    return LoadHistory(list(zip(load.t_s, *columns.values(), strict=True)))


def _groove_knots(load: schema.Grooves) -> list[Knot]:
    from tipforce.sensor.structure.published import GROOVES_DEG

    knots: list[Knot] = []
    t, third = 0.0, load.change_s / 3.0
    for phi, theta in GROOVES_DEG:
        # Unloaded for the middle third of a change: a tare reading between two grooves.
        knots += [(t, 0.0, phi, theta), (t + third, load.P_N, phi, theta)]
        t += third + load.dwell_s
        knots += [(t, load.P_N, phi, theta), (t + third, 0.0, phi, theta)]
        t += 2.0 * third
    return knots
