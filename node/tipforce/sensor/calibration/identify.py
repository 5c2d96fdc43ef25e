"""What a calibration cannot see: directions of load or offset that its rows leave open, in words and numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tipforce.arrays import BoolArray, FloatArray
from tipforce.errors import InputError

SMALLEST_RATIO = 1e-7
"""Singular value of the design, relative to the largest, below which a direction is not seen at all."""
LARGEST_SHARE = 0.25
"""Standard uncertainty, as a fraction of the gauges' signal, above which a direction is lost in the noise."""
FORCES = ("F1", "F2", "F3")


def require_seen(g: FloatArray, observed: BoolArray, names: Sequence[str], unit_newtons: float) -> FloatArray:
    """Check that the rows determine every unknown of every gauge; return the singular values of the design.

    g: (m, p), forces in units of ``unit_newtons``, then the offset's columns, each near one. observed: (m, n).
    names: p of them. Raises InputError naming each direction that no row sees, and which row would.
    """
    singular = np.zeros(0)
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
        singular = values if k == 0 else singular
    return singular


def require_clear(coefficients: FloatArray, covariance: FloatArray, names: Sequence[str], unit_newtons: float) -> None:
    """Check that noise hides no direction of load or offset.

    coefficients: (n, 3 or 4), scaled as the design, the offset last. covariance: (n, q, n, q). Raises
    InputError naming the direction whose uncertainty is above LARGEST_SHARE of the strongest gauge's signal,
    or the force that the gauges together do not tell from zero.
    """
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
    for k in range(n):
        size = float(np.linalg.norm(coefficients[k, :3]))
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
        direction = _sum(weakest / weakest[np.argmax(np.abs(weakest))], FORCES)
        raise InputError(
            f"the {n} gauges together do not respond to a load along {direction} (singular values of A "
            f"{_numbers(strength / strength[0])}, relative): one gauge doubles the others"
        )


def _directions(vectors: FloatArray, names: Sequence[str], unit_newtons: float, snap: float = 1e-5) -> list[str]:
    """Each null direction as a sentence: what all rows have in common, what hides in it, what to add."""
    rows = _reduced(vectors, snap)
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
    along = _sum(force / lead, FORCES)
    value = -constant / lead
    if value == 0.0:
        return f"{along} is {about}0 N in every row: add a load with another {along}, such as {_example(force)}"
    return (
        f"{along} is {about}{value:.4g} N in every row, so that an offset cannot be told from a sensitivity along "
        f"{along}: add tare rows (unloaded readings), or loads with another {along} (another weight, or "
        f"{_example(force)})"
    )


def _example(force: FloatArray) -> str:
    """A groove that loads a direction."""
    return {
        0: "a pull at phi = 90 degrees",
        1: "a pull off the centre line (phi not theta)",
        2: "a pull at phi = 180 degrees, in an x-groove beyond theta = 90 degrees",
    }[int(np.argmax(np.abs(force) * [1.0, 1.01, 1.02]))]


def _reduced(vectors: FloatArray, snap: float) -> FloatArray:
    """Row echelon form of a null space: the same directions, each with as few entries as can be."""
    rows = np.array(vectors, dtype=np.float64)
    for lead in range(len(rows)):
        column = int(np.argmax(np.abs(rows[lead])))
        rows[lead] /= rows[lead, column]
        for other in range(len(rows)):
            if other != lead:
                rows[other] -= rows[other, column] * rows[lead]
    rows[np.abs(rows) < snap * np.abs(rows).max(axis=1, keepdims=True)] = 0.0
    return rows


def _sum(coefficients: FloatArray, names: Sequence[str]) -> str:
    """The text F1 - 0.5 F2 from (1, -0.5, 0)."""
    text = ""
    for value, name in zip(coefficients, names, strict=True):
        if abs(value) > 1e-9:
            size = "" if abs(abs(value) - 1.0) < 5e-4 else f"{abs(value):.3g} "
            sign = (" - " if value < 0 else " + ") if text else ("-" if value < 0 else "")
            text += f"{sign}{size}{name}"
    return text


def _numbers(values: FloatArray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
