"""The same body of other materials, and smaller bodies: strain, noise and largest load, by beam theory.

The material values are typical ones of data sheets (assumed: the paper names AISI 4340 alone, without values); replace
them by those of the sheet that is bought. Yield is static; repeated loads need a fatigue limit.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from tipforce.sensor.dynamics.model import half_cylinder, modes
from tipforce.sensor.structure.gauge_shift import shifted_matrix
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.layouts import Layout
from tipforce.sensor.structure.limits import PAPER_SLIT_M, slit_closure, worst_stress
from tipforce.sensor.structure.published import GAUGE_LENGTH_M
from tipforce.sensor.structure.strain import calibration_matrix, condition_number, noise_gain, strain_matrix


class Material(NamedTuple):
    """An elastic material, isotropic."""

    name: str
    youngs_modulus_pascals: float
    yield_pascals: float
    density_kg_m3: float


STEEL_4340 = Material("AISI 4340, hardened", 205e9, 1080e6, 7850.0)
MATERIALS = (
    STEEL_4340,
    Material("17-4 PH, H900", 197e9, 1170e6, 7800.0),
    Material("AISI 304, annealed", 193e9, 215e6, 8000.0),
    Material("Ti-6Al-4V, annealed", 114e9, 880e6, 4430.0),
    Material("CuBe C17200, hardened", 128e9, 1000e6, 8250.0),
    Material("Al 7075-T6", 71.7e9, 503e6, 2810.0),
)


class Figures(NamedTuple):
    """One body of one material with one layout."""

    strain_per_newton: float
    """The largest anywhere on the beams, over all loads."""
    noise_gain_newtons: float
    """sqrt(trace(C C^T)), newtons per unit strain."""
    yield_newtons: float
    """Smallest load, over all contacts and directions, that reaches the yield stress."""
    slit_newtons: float
    """And that closes a slit of PAPER_SLIT_M."""
    frequency_hz: float
    """Lowest natural frequency, massless beams."""

    @property
    def largest_newtons(self) -> float:
        """The largest load that neither yields nor closes the slit."""
        return min(self.yield_newtons, self.slit_newtons)


def figures_of(geometry: Geometry, material: Material, gauges: Layout) -> Figures:
    """Return the figures of a body made of a material. Raises InputError for an unusable layout."""
    body = replace(geometry, youngs_modulus_pascals=material.youngs_modulus_pascals)
    stress = worst_stress(body, 1.0)
    moving = modes(body, 0.0, half_cylinder(body, material.density_kg_m3))
    return Figures(
        stress / material.youngs_modulus_pascals, noise_gain(calibration_matrix(body, gauges)),
        material.yield_pascals / stress, PAPER_SLIT_M / slit_closure(body, 1.0),
        float(min(moving.omega_rad_s)) / (2.0 * math.pi),
    )  # fmt: skip


class Scaled(NamedTuple):
    """A body scaled down, and what gauges of the same length make of it."""

    geometry: Geometry
    figures: Figures
    condition: float
    """Gauges at their points."""
    condition_of_gauges: float
    """Gauges of GAUGE_LENGTH_M that begin at the points: their middles are half of it inward."""
    condition_of_shift: float
    """These, and the last one another 0.2 mm inward: how much the place of the gauges matters."""


def scaled(geometry: Geometry, scale: float, gauges: Layout, keep_thickness: bool) -> Scaled:
    """Return a body with lengths and width times ``scale``; thicknesses as well, or kept.

    Stress per newton grows as 1 / scale^2 in the first case, and is the same in the second (a / (b h^2)).
    """
    g = geometry
    body = replace(g, a_m=scale * g.a_m, d_m=scale * g.d_m, r_m=scale * g.r_m, width_m=scale * g.width_m)
    if not keep_thickness:
        body = replace(body, h1_m=scale * g.h1_m, h2_m=scale * g.h2_m)
    half = 0.5 * GAUGE_LENGTH_M
    matrix = strain_matrix(body, gauges)
    off = [half] * (len(matrix) - 1) + [half + 0.2e-3]
    return Scaled(
        body, figures_of(body, STEEL_4340, gauges), condition_number(matrix),
        condition_number(shifted_matrix(body, gauges, half)), condition_number(shifted_matrix(body, gauges, off)),
    )  # fmt: skip
