"""Condition numbers of other sensors on one scale: forces in newtons, moments as M / length.

A condition number depends on the unit of the moment. Of the comparators [5] and [11] the paper prints the number alone,
no matrix and no unit, so on another scale only a range is known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import Layout
from tipforce.sensor.structure.strain import condition_number, strain_matrix


class Comparator(NamedTuple):
    """A sensor that the paper compares with (section 1)."""

    reference: str
    axes: int
    condition: float
    """As printed."""


COMPARATORS = (Comparator("[5]", 6, 4.2), Comparator("[11]", 3, 20.05))
MOMENT_UNITS = {"N mm": 1e-3, "N m": 1.0}
"""Units in which moments are stated, as lengths in metres."""


def condition_at_length(geometry: Geometry, gauges: Layout, length_m: float) -> float:
    """Return the condition number with F2 as the force M / length. Raises InputError for a length that is not > 0."""
    if not 0.0 < length_m < math.inf:
        raise InputError(f"length_m = {length_m!r}: allowed is a positive finite number")
    return condition_number(strain_matrix(geometry, gauges) * np.array([1.0, length_m / geometry.r_m, 1.0]))


def condition_range(condition: float, from_length_m: float, to_length_m: float) -> tuple[float, float]:
    """Return the condition numbers possible on another scale for a matrix of which only the number is known.

    Its moment columns change by the factor f = to / from. A diagonal matrix of condition number max(f, 1 / f) changes
    the condition number by no more than that factor, up or down, and no condition number is below 1.
    """
    factor = max(to_length_m / from_length_m, from_length_m / to_length_m)
    return max(1.0, condition / factor), condition * factor


def lengths_of_condition(geometry: Geometry, gauges: Layout, condition: float) -> tuple[float, ...]:
    """Return the lengths (m) at which a layout has a given condition number: none, or one to either side of its best.

    The logarithm of the length is halved between the best length and 1e-6 and 1e6 of it.
    """
    best = best_length(geometry, gauges)
    if condition < condition_at_length(geometry, gauges, best):
        return ()
    found = []
    for end in (-6.0, 6.0):
        near, far = 0.0, end
        for _ in range(60):
            middle = 0.5 * (near + far)
            if condition_at_length(geometry, gauges, best * 10.0**middle) < condition:
                near = middle
            else:
                far = middle
        found.append(best * 10.0**near)
    return tuple(found)


def best_length(geometry: Geometry, gauges: Layout) -> float:
    """Return the length (m) with the smallest condition number, to 1e-4, between r / 100 and 100 r."""
    low, high = -2.0, 2.0
    for _ in range(6):
        steps: FloatArray = np.linspace(low, high, 41)
        values = [condition_at_length(geometry, gauges, geometry.r_m * 10.0**step) for step in steps.tolist()]
        at, width = int(np.argmin(values)), steps[1] - steps[0]
        low, high = float(steps[at] - width), float(steps[at] + width)
    return float(geometry.r_m * 10.0 ** (0.5 * (low + high)))
