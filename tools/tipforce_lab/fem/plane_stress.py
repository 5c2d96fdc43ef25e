"""Plane elasticity of the body with scikit-fem: P2 triangles, one sparse factorisation for three loads.

Young's modulus and the width are 1 inside; strain and displacement are divided by both at the end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import EnvironmentLackError, InputError
from tipforce.sensor.structure.plane_frame import POISSON_RATIO
from tipforce_lab.fem.mesh import STATED, Outline, Resolution, Triangles, triangulate

Plane = Literal["stress", "strain"]

HOW_TO_INSTALL = 'pip install "tipforce[fem]"'


@dataclass(frozen=True, slots=True)
class Patch:
    """The loaded part of the tip's arc: a contact; a load on the whole arc is statically equivalent."""

    theta_rad: float
    half_angle_rad: float = math.radians(5.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.theta_rad) and 0.0 < self.half_angle_rad < math.pi):
            raise InputError(f"patch {self!r}: allowed are a finite theta and a half angle above 0 and below pi")


@dataclass(frozen=True, slots=True)
class Model:
    """Parameters of the solution. Raises InputError for an unknown plane or a Poisson's ratio out of range."""

    outline: Outline = STATED
    resolution: Resolution = field(default_factory=Resolution)
    plane: Plane = "stress"
    """stress: plane stress of a thin slice; strain: no strain along z, as in the middle of a wide beam."""
    poisson_ratio: float = POISSON_RATIO
    patch: Patch | None = None
    """None: the load is spread over the whole arc."""

    def __post_init__(self) -> None:
        if self.plane not in ("stress", "strain"):
            raise InputError(f"plane {self.plane!r}: allowed are stress or strain")
        if not -1.0 < self.poisson_ratio < 0.5:
            raise InputError(f"poisson_ratio = {self.poisson_ratio!r}: allowed is above -1 and below 0.5")


@dataclass(frozen=True, slots=True)
class Solution:
    """Displacements for F1 = 1, F2 = 1 and F3 = 1 newton."""

    model: Model
    triangles: Triangles
    faces: tuple[FloatArray, FloatArray, FloatArray]
    """Sides of the boundary: their first ends, middles and second ends, each (2, m) in m."""
    face_motion: tuple[FloatArray, FloatArray, FloatArray]
    """Displacement there, each (2, m, 3), in metres per newton times E times width."""
    reactions: FloatArray
    """(3, 3): force along x and y, and moment about the origin, of the clamp per newton of F."""
    unknowns: int

    @property
    def scale(self) -> float:
        """1 / (E width): factor from the stored displacements to metres per newton."""
        g = self.model.outline.geometry
        return 1.0 / g.youngs_modulus_pascals / g.width_m


def solve(model: Model) -> Solution:
    """Mesh, assemble, factorise once, solve for three loads.

    Raises InputError if the patch contains no side of the mesh, EnvironmentLackError without scikit-fem.
    """
    try:
        from scipy.sparse.linalg import splu
        from skfem import Basis, ElementTriP2, ElementVector, MeshTri
    except ImportError:
        raise EnvironmentLackError(f"finite elements need scikit-fem: {HOW_TO_INSTALL}") from None
    triangles = triangulate(model.outline, model.resolution)
    mesh = MeshTri(triangles.points_m, triangles.corners)
    # Strain is linear in a P2 triangle: order 2 integrates the energy exactly.
    basis = Basis(mesh, ElementVector(ElementTriP2()), intorder=2)
    stiffness = _stiffness(basis, model)
    sides = mesh.boundary_facets()
    loads = _loads(model, mesh, basis, sides)
    bottom = model.outline.foot_m - model.outline.fixture_depth_m  # lines of the mesh there equal this number exactly
    clamped = basis.get_dofs(sides[(mesh.p[1, mesh.facets[:, sides]] <= bottom).all(axis=0)]).all()
    free = np.setdiff1d(np.arange(basis.N), clamped)
    motion = np.zeros((basis.N, 3))
    # Symmetric positive definite: no pivoting, an ordering for symmetric matrices.
    inner, symmetric = stiffness[free][:, free].tocsc(), {"SymmetricMode": True}
    factors = splu(inner, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    motion[free] = factors.solve(loads[free])
    forces = (stiffness[clamped] @ motion) - loads[clamped]
    ends = mesh.facets[:, sides]
    places = (mesh.p[:, ends[0]], mesh.p[:, ends].mean(axis=1), mesh.p[:, ends[1]])
    nodes = (basis.nodal_dofs[:, ends[0]], basis.facet_dofs[:, sides], basis.nodal_dofs[:, ends[1]])
    moved = (motion[nodes[0]], motion[nodes[1]], motion[nodes[2]])
    return Solution(model, triangles, places, moved, _resultant(basis, clamped, forces), len(free))


def _stiffness(basis: Any, model: Model) -> Any:
    from skfem import BilinearForm
    from skfem.helpers import ddot, eye, sym_grad, trace

    # Lame's constants for E = 1; for plane stress the first is the effective one of the plane.
    nu, mu = model.poisson_ratio, 0.5 / (1.0 + model.poisson_ratio)
    first = nu / (1.0 - nu * nu) if model.plane == "stress" else nu / (1.0 + nu) / (1.0 - 2.0 * nu)

    def elasticity(u: Any, v: Any, _: Any) -> Any:
        strain = sym_grad(u)
        return ddot(first * eye(trace(strain), 2) + 2.0 * mu * strain, sym_grad(v))

    return BilinearForm(elasticity).assemble(basis)


def _loads(model: Model, mesh: Any, basis: Any, sides: Any) -> FloatArray:
    """Return loads (unknowns, 3): tractions on the arc, w (p + q (-y, x)), with resultants exactly F1, F2, F3 = 1."""
    from skfem import FacetBasis, LinearForm

    x, y = mesh.p[:, mesh.facets[:, sides]]
    top = y >= model.outline.tip_top_m(x) * (1.0 - 1e-12)
    arc = sides[top.all(axis=0) & (np.abs(x.mean(axis=0)) < model.outline.half_width_m * (1.0 - 1e-12))]
    patch = model.patch
    facets = FacetBasis(mesh, basis.elem, facets=arc, intorder=4)

    def weight(where: Any) -> Any:
        if patch is None:
            return 1.0
        off = np.arctan2(where[1], where[0]) - patch.theta_rad
        return np.where(np.abs(off) < patch.half_angle_rad, np.cos(0.5 * np.pi * off / patch.half_angle_rad) ** 2, 0.0)

    directions = (
        LinearForm(lambda v, w: weight(w.x) * v[0]),
        LinearForm(lambda v, w: weight(w.x) * v[1]),
        LinearForm(lambda v, w: weight(w.x) * (w.x[0] * v[1] - w.x[1] * v[0])),
    )
    trial = np.stack([form.assemble(facets) for form in directions], axis=1)
    everything = np.arange(basis.N)
    resultants = _resultant(basis, everything, trial)
    if not np.linalg.cond(resultants / model.outline.tip_radius_m ** np.array([[0], [0], [1]])) < 1e12:
        raise InputError(f"{patch!r} contains too few sides of the mesh: use a wider patch or a finer mesh")
    # F = (Fy, M / r, Fx), equation (16).
    wanted = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, model.outline.geometry.r_m, 0.0]])
    result: FloatArray = trial @ np.linalg.solve(resultants, wanted)
    return result


def _resultant(basis: Any, unknowns: Any, forces: FloatArray) -> FloatArray:
    """Return (3, k): force along x, along y, and moment about the origin, of nodal forces (len(unknowns), k)."""
    rigid = np.zeros((3, basis.N))
    x, y = basis.doflocs
    along_x = np.concatenate([basis.nodal_dofs[0], basis.facet_dofs[0]])
    along_y = np.concatenate([basis.nodal_dofs[1], basis.facet_dofs[1]])
    rigid[0, along_x], rigid[2, along_x] = 1.0, -y[along_x]
    rigid[1, along_y], rigid[2, along_y] = 1.0, x[along_y]
    result: FloatArray = rigid[:, unknowns] @ forces
    return result
