"""Gauges at points of Table 1 or anywhere along the beams: one strain matrix for both, and what a set must fulfil."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.structure.gauge_shift import GaugePosition, nominal_position, strain_row
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import MAX_GAUGES, MIN_GAUGES, POINTS
from tipforce.sensor.structure.strain import strain_matrix

Gauge = str | GaugePosition
"""A point of Table 1 by its name, or a place along a beam."""


def place(geometry: Geometry, gauge: Gauge) -> GaugePosition:
    """Return where a gauge sits. Raises InputError for an unknown point."""
    return nominal_position(geometry, gauge) if isinstance(gauge, str) else gauge


def check_gauges(geometry: Geometry, gauges: Sequence[Gauge]) -> tuple[Gauge, ...]:
    """Return the gauges, SG1 first, if they are usable.

    Raises InputError for fewer than 3 or more than 8, an unknown point, beam, side or face, a position off its
    beam, or two gauges at one place.
    """
    if not MIN_GAUGES <= len(gauges) <= MAX_GAUGES:
        raise InputError(f"a layout of {len(gauges)} gauge points: allowed are {MIN_GAUGES} to {MAX_GAUGES}")
    seen: dict[GaugePosition, Gauge] = {}
    for gauge in gauges:
        spot = place(geometry, gauge)
        strain_row(geometry, *spot)
        if spot.beam == "V":
            spot = spot._replace(face="lower")  # the face tells nothing there
        if spot in seen:
            raise InputError(f"gauge point {gauge_name(gauge)} is given more than once: each place is allowed once")
        seen[spot] = gauge
    return tuple(gauges)


def gauge_matrix(geometry: Geometry, gauges: Sequence[Gauge]) -> FloatArray:
    """Return the strain per newton of F, shape (n, 3), tension positive: Table 1, made continuous.

    The points' rows are strain_matrix()'s own to the last bit. Raises InputError as check_gauges() does, and for
    a beam too thin for floating point.
    """
    check_gauges(geometry, gauges)
    table = dict(zip(POINTS, strain_matrix(geometry, POINTS), strict=True))
    rows = [table[gauge] if isinstance(gauge, str) else strain_row(geometry, *gauge) for gauge in gauges]
    return np.array(rows, dtype=np.float64)


def gauge_name(gauge: Gauge) -> str:
    """Return the gauge as people read it: `K_H`, or `H right 1.33` (beam, side, millimetres from the joint)."""
    if isinstance(gauge, str):
        return gauge
    upper = " upper" if gauge.beam == "H" and gauge.face == "upper" else ""
    return f"{gauge.beam} {gauge.side}{upper} {1e3 * gauge.position_m:.2f}"
