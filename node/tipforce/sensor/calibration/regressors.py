"""What a fit regresses on: offset, drift, scatter of load directions; and what its rows leave open, in words."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tipforce.arrays import BoolArray, FloatArray, IntArray
from tipforce.errors import InputError

DRIFTS = ("none", "tare", "linear")
MOST_KNOTS = 100
"""Times at which a drift through tares may bend, the most; of more tares evenly chosen ones are such times."""


class OffsetBasis(NamedTuple):
    """The offset of gauge k at row i is columns[i] @ coefficients[k]."""

    columns: FloatArray
    """(m, q): none, constant, linear drift; for tares a straight line, then one kink for each tare between."""
    reference: FloatArray
    """(q,): the same columns at the last row, where the result gives the offset."""
    kinks: BoolArray
    """(q,): which columns are kinks, as large as the data ask for (penalised)."""
    temperature_span_K: float = 0.0
    """Kelvins per unit of the last column, which then is the temperature; 0: there is none."""

    @classmethod
    def of(cls, columns: FloatArray, kinks: int = 0) -> OffsetBasis:
        """The last ``kinks`` columns are those."""
        q = columns.shape[1]
        return cls(columns, columns[-1], np.arange(q) >= q - kinks)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the columns that are no kinks."""
        count = int((~self.kinks).sum())
        if not self.temperature_span_K:
            return ("offset", "drift")[:count]
        return (*("offset", "drift")[: count - 1], "temperature")

    @property
    def to_reference(self) -> FloatArray:
        """L, (3 or 4, 3 + q): from a gauge's unknowns to its row of A and its offset at the last row."""
        q = len(self.reference)
        L = np.zeros((4 if q else 3, 3 + q))
        L[:3, :3] = np.eye(3)
        L[3:, 3:] = self.reference
        return L

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
    return np.stack((by_phi, by_theta), axis=-1) * P_newtons[:, np.newaxis, np.newaxis]


def grooves(phi_rad: FloatArray, theta_rad: FloatArray) -> IntArray:
    """Return which rows have the same phi and theta, (m,), numbered from 0: their angles are off by the same error."""
    places = np.round(np.stack((phi_rad, theta_rad), axis=-1), 6)
    return np.unique(places, axis=0, return_inverse=True)[1].ravel().astype(np.int64)


def tare_groups(unloaded: BoolArray, usable: BoolArray) -> list[list[int]]:
    """Return the usable unloaded rows, those with no usable load between them together."""
    rows = np.flatnonzero(usable).tolist()
    return [list(group) for tare, group in itertools.groupby(rows, lambda row: bool(unloaded[row])) if tare]


def offset_basis(
    drift: str, offset: bool, t_s: FloatArray | None, unloaded: BoolArray, usable: BoolArray
) -> OffsetBasis:
    """Return the basis of the offset for m rows; ``usable`` rows only give tares. Raises InputError for a drift where
    the rows have no times, all one time, or tares at fewer than two times."""
    m = unloaded.size
    if not offset:
        return OffsetBasis.of(np.zeros((m, 0)))
    if drift == "none":
        return OffsetBasis.of(np.ones((m, 1)))
    if t_s is None:
        raise InputError(f"drift {drift!r} needs the time of every row (column t_s); without times drift is 'none'")
    if drift == "linear":
        span = t_s[-1] - t_s[0]
        if span <= 0.0:
            raise InputError(f"drift 'linear' needs rows at different times; every row has t_s = {t_s[0]:g}")
        return OffsetBasis.of(np.stack((np.ones(m), (t_s - t_s[-1]) / span), axis=-1))
    knots = np.unique([np.mean(t_s[group]) for group in tare_groups(unloaded, usable)])
    if knots.size < 2:
        raise InputError(
            f"drift 'tare' needs unloaded readings at two times at least, before and after loads; there are "
            f"{knots.size}"
        )
    if knots.size > MOST_KNOTS:  # the time of a fit grows with their cube
        knots = knots[np.linspace(0, knots.size - 1, MOST_KNOTS).astype(np.int64)]
    # A constant, a line from the first knot to the last, and a kink at each knot between; constant outside. The kinks
    # are scaled so that equal coefficients mean an equally restless drift, however the knots are spaced.
    span = knots[-1] - knots[0]
    x, at = (np.clip(t_s, knots[0], knots[-1]) - knots[-1]) / span, (knots - knots[-1]) / span
    kinks = np.maximum(x[:, np.newaxis] - at[1:-1], 0.0) * np.sqrt(0.5 * (at[2:] - at[:-2]))
    return OffsetBasis.of(np.concatenate((np.ones((m, 1)), x[:, np.newaxis], kinks), axis=1), knots.size - 2)


def bad_tares(strain: FloatArray, t_s: FloatArray, unloaded: BoolArray, usable: BoolArray) -> BoolArray:
    """Return which tares jump out of the line through their neighbours, (m,), the worst first: no drift is that quick.
    A tare alone at its time defines the offset there, so that no residual can accuse it."""
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


def at_reference(basis: OffsetBasis, coefficients: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rows of A with the offset at the last row, (n, 3 or 4), and their covariance, of a gauge's unknowns."""
    L = basis.to_reference
    return coefficients @ L.T, np.einsum("ip,kplq,jq->kilj", L, covariance, L)


SMALLEST_RATIO = 1e-7
"""Singular value of the design, relative to the largest, below which a direction is not seen at all."""
LARGEST_SHARE = 0.25
"""Standard uncertainty, as a fraction of the gauges' signal, above which a direction is lost in the noise."""
FORCES = ("F1", "F2", "F3")
_EXAMPLES = (
    "a pull at phi = 90 degrees", "a pull off the centre line (phi not theta)",
    "a pull at phi = 180 degrees, in an x-groove beyond theta = 90 degrees",
)  # fmt: skip


def require_seen(g: FloatArray, observed: BoolArray, names: Sequence[str], unit_newtons: float) -> None:
    """Raise InputError naming each direction that no row sees. g (m, p), in ``unit_newtons``; observed (m, n)."""
    for k in range(observed.shape[1]):
        design = g[observed[:, k]]
        padded = np.vstack((design, np.zeros((design.shape[1], design.shape[1]))))
        _, values, right = np.linalg.svd(padded, full_matrices=False)
        open_ones = values <= SMALLEST_RATIO * max(values[0], 1e-300)
        if open_ones.any():
            places = _directions(right[open_ones], names, unit_newtons)
            gauge = "" if np.array_equal(observed.all(axis=1), observed.any(axis=1)) else f" for SG{k + 1}"
            raise InputError(
                f"the data{gauge} cannot show {len(places)} of the {len(names)} unknowns of a gauge "
                f"({len(design)} rows; singular values {_numbers(values)}): " + "; ".join(places)
            )


def require_clear(coefficients: FloatArray, covariance: FloatArray, names: Sequence[str], unit_newtons: float) -> None:
    """Raise InputError naming a direction that noise hides. coefficients (n, 3 or 4), covariance (n, q, n, q)."""
    n, q = coefficients.shape
    signal = np.linalg.norm(coefficients[:, :3], axis=1).max()
    for k in range(n):
        values, vectors = np.linalg.eigh(covariance[k, :, k, :])
        spread = float(np.sqrt(max(values[-1], 0.0)))
        if spread > LARGEST_SHARE * signal:
            place = _directions(vectors[:, -1:].T, names[:q], unit_newtons, 0.03)[0]
            raise InputError(
                f"SG{k + 1}: one direction is lost in the noise (standard uncertainty {spread / signal:.0%} of the "
                f"strongest gauge's signal, allowed {LARGEST_SHARE:.0%}): {place}"
            )
    for k, size in enumerate(np.linalg.norm(coefficients[:, :3], axis=1).tolist()):
        noise = float(np.sqrt(max(np.trace(covariance[k, :3, k, :3]), 0.0)))
        if size <= max(3.0 * noise, 1e-9 * signal):
            raise InputError(
                f"SG{k + 1} responds to no load: its sensitivity is {size / signal:.2g} of the strongest gauge's, with "
                f"a standard uncertainty of {noise / signal:.2g}: it is dead or disconnected"
            )
    _, strength, forces = np.linalg.svd(coefficients[:, :3])
    weakest = forces[-1]
    noise = np.sqrt(max(float(np.einsum("j,kjkl,l->", weakest, covariance[:, :3, :, :3], weakest)), 0.0))
    if strength[-1] <= max(3.0 * noise, 1e-9 * strength[0]):
        direction = _sum(weakest / weakest[np.argmax(np.abs(weakest))])
        raise InputError(
            f"the {n} gauges together do not respond to a load along {direction} (singular values of A "
            f"{_numbers(strength / strength[0])}, relative): one gauge doubles the others"
        )


def _directions(vectors: FloatArray, names: Sequence[str], unit_newtons: float, snap: float = 1e-5) -> list[str]:
    """Each null direction as a sentence: what all rows have in common, what hides in it, what to add."""
    # Row echelon form of the null space: the same directions, each with as few entries as can be.
    rows = np.array(vectors, dtype=np.float64)
    for lead in range(len(rows)):
        column = int(np.argmax(np.abs(rows[lead])))
        rows[lead] /= rows[lead, column]
        for other in range(len(rows)):
            if other != lead:
                rows[other] -= rows[other, column] * rows[lead]
    rows[np.abs(rows) < snap * np.abs(rows).max(axis=1, keepdims=True)] = 0.0
    return [_sentence(dict(zip(names, row, strict=True)), unit_newtons, snap) for row in rows]


def _sentence(entries: dict[str, float], unit_newtons: float, snap: float) -> str:
    force = np.array([entries[name] for name in FORCES])
    constant = entries.get("offset", 0.0) * unit_newtons
    about = "about " if snap > 1e-3 else ""
    if entries.get("drift", 0.0) != 0.0:
        return (
            "a drift in time cannot be told from the loads: repeat tare rows (unloaded readings) before, between "
            "and after the loads"
        )
    if entries.get("temperature", 0.0) != 0.0:
        return "a change of temperature cannot be told from the loads: repeat tare rows warm and cold"
    if not force.any():
        return "no row counts for the offset: add tare rows (unloaded readings)"
    lead = force[np.flatnonzero(force)[0]]
    along = _sum(force / lead)
    value = -constant / lead
    example = _EXAMPLES[int(np.argmax(np.abs(force) * [1.0, 1.01, 1.02]))]
    if value == 0.0:
        return f"{along} is {about}0 N in every row: add a load with another {along}, such as {example}"
    return (
        f"{along} is {about}{value:.4g} N in every row, so that an offset cannot be told from a sensitivity along "
        f"{along}: add tare rows (unloaded readings), or loads with another {along} (another weight, or {example})"
    )


def _sum(coefficients: FloatArray) -> str:
    text = ""
    for value, name in zip(coefficients, FORCES, strict=True):
        if abs(value) > 1e-9:
            size = "" if abs(abs(value) - 1.0) < 5e-4 else f"{abs(value):.3g} "
            sign = (" - " if value < 0 else " + ") if text else ("-" if value < 0 else "")
            text += f"{sign}{size}{name}"
    return text


def _numbers(values: FloatArray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
