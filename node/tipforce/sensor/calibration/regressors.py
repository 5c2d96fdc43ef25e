"""What a calibration fit regresses on: the offset and its drift, the scatter of load directions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tipforce.arrays import BoolArray, FloatArray, IntArray
from tipforce.errors import InputError

DRIFTS = ("none", "tare", "linear")


class OffsetBasis(NamedTuple):
    """The offset of gauge k at row i is columns[i] @ coefficients[k]."""

    columns: FloatArray
    """(m, q): q = 0 without an offset, 1 for a constant one, 2 for a linear drift; for tares a straight line from
    first to last, then one kink for each tare between."""
    reference: FloatArray
    """(q,): the same columns at the last row, where the result gives the offset."""
    kinks: BoolArray
    """(q,): which columns are kinks, as large as the data ask for (penalised)."""
    temperature_span_K: float = 0.0
    """Kelvins per unit of the last column, which then is the temperature; 0: there is none."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the columns that are no kinks."""
        count = int((~self.kinks).sum())
        if not self.temperature_span_K:
            return ("offset", "drift")[:count]
        return (*("offset", "drift")[: count - 1], "temperature")

    def with_temperature(self, change_K: FloatArray) -> OffsetBasis:
        """The same with a column of temperature, (m,), against the reference. Raises InputError for a constant one."""
        span = float(np.abs(change_K).max())
        if not span > 0.0:
            raise InputError("a temperature coefficient needs rows at different temperatures")
        columns = np.concatenate((self.columns, (change_K / span)[:, np.newaxis]), axis=1)
        return OffsetBasis(columns, np.append(self.reference, 0.0), np.append(self.kinks, False), span)


def direction_scatter(
    P_newtons: FloatArray, phi_rad: FloatArray, theta_rad: FloatArray, phi_scatter_rad: float, theta_scatter_rad: float
) -> FloatArray:
    """Return D, (m, 3, 2), newtons: D D^T is the covariance of F for independent scatter of phi and theta."""
    zero, delta = np.zeros_like(P_newtons), phi_rad - theta_rad
    by_phi = np.stack((np.cos(phi_rad), np.cos(delta), -np.sin(phi_rad)), axis=-1) * phi_scatter_rad
    by_theta = np.stack((zero, -np.cos(delta), zero), axis=-1) * theta_scatter_rad
    D: FloatArray = np.stack((by_phi, by_theta), axis=-1) * P_newtons[:, np.newaxis, np.newaxis]
    return D


def grooves(phi_rad: FloatArray, theta_rad: FloatArray) -> IntArray:
    """Return which rows have the same phi and theta, (m,), numbered from 0: their angles are off by the same error."""
    places = np.round(np.stack((phi_rad, theta_rad), axis=-1), 6)
    return np.unique(places, axis=0, return_inverse=True)[1].ravel().astype(np.int64)


def tare_groups(unloaded: BoolArray, usable: BoolArray) -> list[list[int]]:
    """Return the usable unloaded rows, those with no usable load between them together."""
    groups: list[list[int]] = []
    after_load = True
    for row in np.flatnonzero(usable):
        if not unloaded[row]:
            after_load = True
        elif after_load:
            groups.append([int(row)])
            after_load = False
        else:
            groups[-1].append(int(row))
    return groups


def offset_basis(
    drift: str, offset: bool, t_s: FloatArray | None, unloaded: BoolArray, usable: BoolArray
) -> OffsetBasis:
    """Return the basis of the offset for m rows; ``usable`` rows only give tares.

    Raises InputError where a drift is asked for and the rows have no times, all one time, or tares at fewer
    than two times.
    """
    m = unloaded.size
    if not offset:
        return _basis(np.zeros((m, 0)))
    if drift == "none":
        return _basis(np.ones((m, 1)))
    if t_s is None:
        raise InputError(f"drift {drift!r} needs the time of every row (column t_s); without times drift is 'none'")
    if drift == "linear":
        span = t_s[-1] - t_s[0]
        if span <= 0.0:
            raise InputError(f"drift 'linear' needs rows at different times; every row has t_s = {t_s[0]:g}")
        return _basis(np.stack((np.ones(m), (t_s - t_s[-1]) / span), axis=-1))
    knots = np.unique([np.mean(t_s[group]) for group in tare_groups(unloaded, usable)])
    if knots.size < 2:
        raise InputError(
            f"drift 'tare' needs unloaded readings at two times at least, before and after loads; there are "
            f"{knots.size}"
        )
    return _basis(_kinked(t_s, knots), kinks=knots.size - 2)


def _kinked(t_s: FloatArray, knots: FloatArray) -> FloatArray:
    """A constant, a line from the first knot to the last, and a kink at each knot between; constant outside.

    The kinks are scaled so that equal coefficients mean an equally restless drift, however the knots are spaced.
    """
    span = knots[-1] - knots[0]
    x, at = (np.clip(t_s, knots[0], knots[-1]) - knots[-1]) / span, (knots - knots[-1]) / span
    gaps = np.sqrt(0.5 * (at[2:] - at[:-2]))
    kinks = np.maximum(x[:, np.newaxis] - at[1:-1], 0.0) * gaps
    columns: FloatArray = np.concatenate((np.ones((x.size, 1)), x[:, np.newaxis], kinks), axis=1)
    return columns


def _basis(columns: FloatArray, kinks: int = 0) -> OffsetBasis:
    q = columns.shape[1]
    return OffsetBasis(columns, columns[-1], np.arange(q) >= q - kinks)


def bad_tares(strain: FloatArray, t_s: FloatArray, unloaded: BoolArray, usable: BoolArray) -> BoolArray:
    """Return which tares jump out of the line through their neighbours, (m,): no drift is that quick.

    A tare alone at its time defines the offset there, so that no residual can accuse it: it is judged by the
    tares around it, the worst first.
    """
    usable = usable.copy()
    bad = np.zeros(usable.size, dtype=np.bool_)
    while True:
        rows = np.flatnonzero(unloaded & usable)
        if rows.size < 6:
            return bad
        t, V = t_s[rows], strain[rows]
        inner = _off_line(t, V, np.arange(1, rows.size - 1), -1, 1)
        # An end is judged by a line run on: that has twice the noise, and must not tie with the neighbour's own jump.
        ends = np.stack((_off_line(t, V, np.array([0]), 1, 2)[0], _off_line(t, V, np.array([-1]), -2, -1)[0])) / 2.5
        scale = 1.4826 * np.median(inner, axis=0) + 1e-9 * np.abs(strain).max()
        # Twelve robust deviations: the drift's own curvature must not be taken for a fault.
        score = (np.concatenate((ends[:1], inner, ends[1:])) / scale).max(axis=1)
        worst = int(np.argmax(score))
        if score[worst] < 12.0:
            return bad
        bad[rows[worst]] = True
        usable[rows[worst]] = False


def _off_line(t: FloatArray, V: FloatArray, at: IntArray, one: int, other: int) -> FloatArray:
    """How far rows lie off the line through two of their neighbours, (len(at), n)."""
    first, second = at + one, at + other
    span = t[second] - t[first]
    share = ((t[at] - t[first]) / np.where(span != 0.0, span, 1.0))[:, np.newaxis]
    return np.abs(V[at] - (1.0 - share) * V[first] - share * V[second])


def reference_map(basis: OffsetBasis) -> FloatArray:
    """Return L, (3 or 4, 3 + q): from a gauge's unknowns to its row of A and its offset at the last row."""
    q = basis.columns.shape[1]
    L = np.zeros((4 if q else 3, 3 + q))
    L[:3, :3] = np.eye(3)
    if q:
        L[3, 3:] = basis.reference
    return L
