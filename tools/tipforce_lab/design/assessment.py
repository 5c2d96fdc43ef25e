"""Assess a structure by beam theory and by the frame model, and find the designs of a set that no other dominates."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

from tipforce.sensor.structure.gauge_positions import Gauge, gauge_matrix
from tipforce.sensor.structure.gauge_shift import nominal_position
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.limits import slit_closure, worst_stress
from tipforce.sensor.structure.plane_frame import ELASTIC_ROOTS, Frame, FrameModel
from tipforce_lab.design.figures_of_merit import LoadSet, Merit, merit, worst_strain

AGREEMENT = 0.03
"""Relative difference of beam theory and frame above which a design counts as not proven."""


@dataclass(frozen=True, slots=True)
class Assessment:
    """Assessment of a structure: by beam theory, and by the frame with shear and elastic roots."""

    name: str
    geometry: Geometry
    gauges: tuple[Gauge, ...]
    theory: Merit
    frame: Merit
    frame_finite_joint: Merit
    """The frame with the joint as a block of width h2: shows the effect of the joint's size."""
    worst_stress_pascals: float
    worst_strain: float
    """The largest reading of a gauge."""
    slit_load_newtons: float
    """The load that closes the slit."""

    @property
    def disagreement(self) -> float:
        """The largest relative difference of frame and beam theory, over every field of Merit."""
        return max(_relative(getattr(self.frame, f.name), getattr(self.theory, f.name)) for f in fields(Merit))

    @property
    def agrees(self) -> bool:
        """True if beam theory and the frame agree within AGREEMENT."""
        return self.disagreement <= AGREEMENT


def assess(
    name: str,
    geometry: Geometry,
    gauges: Sequence[Gauge],
    *,
    loads: LoadSet,
    noise_microstrain: float,
    gauge_length_m: float,
    slit_m: float,
) -> Assessment:
    """Return the figures of one structure, stresses at loads.load_newtons.

    Points of Table 1 are read at the point itself: a gauge there would reach beyond the beam. Raises InputError
    for gauges that are not usable.
    """
    A = gauge_matrix(geometry, gauges)
    length_m = 0.0 if any(isinstance(gauge, str) for gauge in gauges) else gauge_length_m
    block = FrameModel(shear=True, root=ELASTIC_ROOTS.root, finite_joint=True)
    matrices = [Frame(geometry, model).strain_matrix(gauges, length_m) for model in (ELASTIC_ROOTS, block)]
    theory, frame, finite = (merit(matrix, noise_microstrain, loads) for matrix in (A, *matrices))
    return Assessment(
        name, geometry, tuple(gauges), theory, frame, finite,
        worst_stress(geometry, loads.load_newtons), worst_strain(A, loads.load_newtons),
        slit_m / slit_closure(geometry, 1.0),
    )  # fmt: skip


def glued(geometry: Geometry, gauges: Sequence[str], gauge_length_m: float, clearance_m: float) -> tuple[Gauge, ...]:
    """Return gauges of that length as near to the points of Table 1 as the body allows.

    At the joint a gauge of the arms begins beside the vertical beam, h2 / 2 from the middle. Raises InputError for
    an unknown point.
    """
    inset = 0.5 * gauge_length_m + clearance_m
    found: list[Gauge] = []
    for point in gauges:
        spot = nominal_position(geometry, point)
        if spot.position_m > 0.0:
            found.append(spot._replace(position_m=spot.position_m - inset))
        else:
            beside = 0.5 * geometry.h2_m if spot.beam == "H" else 0.0
            found.append(spot._replace(position_m=beside + inset))
    return tuple(found)


FIGURES: dict[str, Callable[[Assessment], float]] = {
    "theta": lambda entry: entry.theory.u_theta_deg,
    "noise": lambda entry: entry.theory.noise_gain_newtons,
    "singular": lambda entry: 1.0 / entry.theory.smallest_singular_value,
    "condition": lambda entry: entry.theory.condition_number,
}
"""The quantities that the search's objectives minimise."""


def pareto(entries: Sequence[Assessment], figures: Sequence[Callable[[Assessment], float]]) -> list[Assessment]:
    """Return the entries that no other dominates in every figure (smaller is better), the best in the first one first.

    An entry that is better by less than one percent counts as dominated.
    """
    kept: list[Assessment] = []
    for entry in sorted(entries, key=lambda e: tuple(figure(e) for figure in figures)):
        values = [figure(entry) for figure in figures]
        others = ([figure(other) for figure in figures] for other in kept)
        if not any(all(o <= v * 1.01 for o, v in zip(other, values, strict=True)) for other in others):
            kept.append(entry)
    return kept


def _relative(value: float, reference: float) -> float:
    if value == reference:
        return 0.0
    return abs(value / reference - 1.0) if reference and math.isfinite(reference) else math.inf
