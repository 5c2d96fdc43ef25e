"""The mass of the beams, spread along them as they bend: the consistent mass matrix."""

from __future__ import annotations

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.plane_frame import FrameModel


def beam_mass_matrix(geometry: Geometry, density_kg_m3: float, model: FrameModel) -> FloatArray:
    """Return the mass matrix (6, 6), kg, for (motion of the joint, motion of the tip relative to it), each as y.

    Beams move as their end loads bend them (Hermite's cubic along, linear stretch); shear, root compliance, rotatory
    inertia and the beams' own inner modes are left out.
    """
    g = geometry
    inner = 0.5 * g.h2_m if model.finite_joint else 0.0
    total = np.zeros((6, 6))
    for sign in (-1.0, 1.0):
        local = _local_mass(g.a_m - inner, g.h1_m * g.width_m * density_kg_m3)
        near = _end(g, (sign * inner, 0.0), (sign, 0.0))
        far = _end(g, (sign * g.a_m, 0.0), (sign, 0.0))
        ends = np.block([[near, np.zeros((3, 3))], [far, far]])
        total += ends.T @ local @ ends
    local = _local_mass(g.d_m, g.h2_m * g.width_m * density_kg_m3)
    on_joint = _end(g, (0.0, -0.5 * g.h1_m), (0.0, 1.0))
    total[:3, :3] += on_joint.T @ local[3:, 3:] @ on_joint
    return total


def _local_mass(length: float, mass_per_length: float) -> FloatArray:
    """Along, across, rotation at either end (Przemieniecki, Theory of Matrix Structural Analysis, 11.3)."""
    L = length
    bend = np.array(
        [
            [156.0, 22.0 * L, 54.0, -13.0 * L],
            [22.0 * L, 4.0 * L * L, 13.0 * L, -3.0 * L * L],
            [54.0, 13.0 * L, 156.0, -22.0 * L],
            [-13.0 * L, -3.0 * L * L, -22.0 * L, 4.0 * L * L],
        ]
    )
    M = np.zeros((6, 6))
    M[np.ix_([0, 3], [0, 3])] = np.array([[140.0, 70.0], [70.0, 140.0]])
    M[np.ix_([1, 2, 4, 5], [1, 2, 4, 5])] = bend
    return M * (mass_per_length * L / 420.0)


def _end(geometry: Geometry, place: tuple[float, float], direction: tuple[float, float]) -> FloatArray:
    """Local displacement (along, across, rotation) at a place of a body per its motion y = (v, r rotation, u)."""
    (x, y), (c, s), r = place, direction, geometry.r_m
    u, v = np.array([0.0, -y / r, 1.0]), np.array([1.0, x / r, 0.0])
    return np.array([c * u + s * v, -s * u + c * v, [0.0, 1.0 / r, 0.0]])
