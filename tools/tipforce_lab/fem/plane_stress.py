"""Plane elasticity of the body with scikit-fem: P2 triangles, one sparse factorisation for three loads, E = width = 1.
A gauge reads the difference of displacement between its ends, finite also at a re-entrant corner."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError, needing
from tipforce.sensor.structure.layouts import GAUGE_LENGTH_M
from tipforce.sensor.structure.plane_frame import POISSON_RATIO
from tipforce.sensor.structure.strain import Gauge, GaugePosition, gauge_name, place
from tipforce_lab.fem.mesh import STATED, Outline, Resolution, triangulate

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
    """Solve for three loads. Raises InputError if the patch holds no side of the mesh, EnvironmentLackError."""
    with needing(f"finite elements need scikit-fem: {HOW_TO_INSTALL}"):
        from scipy.sparse.linalg import splu
        from skfem import Basis, ElementTriP2, ElementVector, MeshTri
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
    return Solution(model, places, moved, _resultant(basis, clamped, forces), len(free))


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
    return trial @ np.linalg.solve(resultants, wanted)


def _resultant(basis: Any, unknowns: Any, forces: FloatArray) -> FloatArray:
    """Return (3, k): force along x, along y, and moment about the origin, of nodal forces (len(unknowns), k)."""
    rigid = np.zeros((3, basis.N))
    x, y = basis.doflocs
    along_x = np.concatenate([basis.nodal_dofs[0], basis.facet_dofs[0]])
    along_y = np.concatenate([basis.nodal_dofs[1], basis.facet_dofs[1]])
    rigid[0, along_x], rigid[2, along_x] = 1.0, -y[along_x]
    rigid[1, along_y], rigid[2, along_y] = 1.0, x[along_y]
    return rigid[:, unknowns] @ forces


class Face(NamedTuple):
    """One straight face of a beam: P2 displacement along it, for F1, F2, F3 = 1."""

    s_m: FloatArray
    """(m + 1,) ends of the m sides: x on the horizontal beam, y on the vertical."""
    ends: FloatArray
    """(m + 1, 3) displacement along the face, times E times width."""
    middles: FloatArray
    """(m, 3)."""

    def displacement(self, s_m: npt.ArrayLike) -> FloatArray:
        """Return the displacement along the face (..., 3) at s_m (...), which lie on the face."""
        side, t, change, bulge = self._side(s_m)
        return self.ends[side] + t * change + 4.0 * t * (1.0 - t) * bulge

    def strain(self, s_m: npt.ArrayLike) -> FloatArray:
        """Return the strain (..., 3) at points s_m (...). It diverges at corners as the mesh is refined."""
        side, t, change, bulge = self._side(s_m)
        length = (self.s_m[side + 1] - self.s_m[side])[..., np.newaxis]
        return (change + 4.0 * (1.0 - 2.0 * t) * bulge) / length

    def _side(self, s_m: npt.ArrayLike) -> tuple[npt.NDArray[np.intp], FloatArray, FloatArray, FloatArray]:
        """Return the side of each point, the place on it (..., 1), and along it change and bulge of displacement."""
        s = np.asarray(s_m, dtype=np.float64)
        side = np.clip(np.searchsorted(self.s_m, s, side="right") - 1, 0, len(self.s_m) - 2)
        t = (s - self.s_m[side]) / (self.s_m[side + 1] - self.s_m[side])
        # Both ends of a side of 1e-9 m nearly agree: the deviation of the middle from their mean is the small term.
        start, end = self.ends[side], self.ends[side + 1]
        return side, t[..., np.newaxis], end - start, self.middles[side] - 0.5 * (start + end)


def face(solution: Solution, gauge: GaugePosition) -> Face:
    """Return the face that a gauge is glued to, from corner (or fillet) to corner. Positions as in GaugePosition."""
    outline = solution.model.outline
    along, level, low, high = _line(outline, gauge)
    starts, middles, ends = solution.faces
    across = 1 - along
    thickness = outline.geometry.h1_m if gauge.beam == "H" else outline.geometry.h2_m
    # Finer than the smallest cell of the other face at the corner.
    on_line = (np.abs(starts[across] - level) < 1e-12 * thickness) & (np.abs(ends[across] - level) < 1e-12 * thickness)
    slack = 1e-9 * (high - low)
    chosen = np.flatnonzero(on_line & (middles[along] > low - slack) & (middles[along] < high + slack))
    chosen = chosen[np.argsort(middles[along, chosen])]
    first, middle, last = (motion[along][chosen] for motion in solution.face_motion)
    left, right = starts[along, chosen], ends[along, chosen]
    backwards = left > right
    first, last = np.where(backwards[:, np.newaxis], (last, first), (first, last))
    left, right = np.where(backwards, (right, left), (left, right))
    return Face(np.append(left, right[-1]), np.concatenate([first, last[-1:]]), middle)


def strain_matrix(solution: Solution, gauges: Sequence[Gauge], gauge_length_m: float = GAUGE_LENGTH_M) -> FloatArray:
    """Return the strain per newton of F, (n, 3), tension positive, averaged over each gauge; at a point (length 0) it
    diverges in corners. Points of Table 1: at nearest_place(). Raises InputError for a gauge beyond its face."""
    if not 0.0 <= gauge_length_m < np.inf:
        raise InputError(f"gauge_length_m = {gauge_length_m!r}: allowed is 0 (a point) or more, finite")
    rows = [_row(solution, gauge, gauge_length_m) for gauge in gauges]
    return np.array(rows, dtype=np.float64).reshape(-1, 3) * solution.scale


def nearest_place(outline: Outline, point: str, gauge_length_m: float = GAUGE_LENGTH_M) -> GaugePosition:
    """Return the nearest position of a gauge to a point of Table 1: half its length from the beam's end, the joint's
    side (which has no width in Table 1), the leg at L and R, or the fillet. Raises InputError for an unknown point."""
    spot, g = place(outline.geometry, point), outline.geometry
    fillet = outline.fillet_m
    if point in ("L", "R"):
        return spot._replace(position_m=g.a_m - 0.5 * gauge_length_m)
    if spot.beam == "H":
        return spot._replace(position_m=0.5 * g.h2_m + fillet + 0.5 * gauge_length_m)
    if point in ("T", "U"):
        fillet = fillet if outline.fixture_depth_m > 0.0 else 0.0
        return spot._replace(position_m=g.d_m - fillet - 0.5 * gauge_length_m)
    return spot._replace(position_m=fillet + 0.5 * gauge_length_m)


def _row(solution: Solution, gauge: Gauge, length_m: float) -> FloatArray:
    outline = solution.model.outline
    spot = nearest_place(outline, gauge, length_m) if isinstance(gauge, str) else gauge
    along, _, low, high = _line(outline, spot)
    if spot.beam == "H":
        middle = spot.position_m if spot.side == "right" else -spot.position_m
    else:
        middle = -0.5 * outline.geometry.h1_m - spot.position_m
    slack = 1e-9 * outline.geometry.a_m
    if not low - slack <= middle - 0.5 * length_m <= middle + 0.5 * length_m <= high + slack:
        raise InputError(
            f"gauge {gauge_name(gauge)} of {1e3 * length_m:g} mm: allowed is a gauge between the corners of its face, "
            f"{1e3 * low:.3f} and {1e3 * high:.3f} mm along {'xy'[along]}"
        )
    surface = face(solution, spot)
    if length_m == 0.0:
        return surface.strain(middle)
    ends = np.clip([middle - 0.5 * length_m, middle + 0.5 * length_m], low, high)
    first, last = surface.displacement(ends)
    result: FloatArray = (last - first) / (ends[1] - ends[0])
    return result


def _line(outline: Outline, gauge: GaugePosition) -> tuple[int, float, float, float]:
    """Return the axis along a face, its position on the other axis, and both ends of its straight part."""
    if gauge.beam not in ("H", "V") or gauge.side not in ("left", "right") or gauge.face not in ("lower", "upper"):
        raise InputError(f"gauge {gauge!r}: allowed are beam H or V, side left or right, face lower or upper")
    g, fillet = outline.geometry, outline.fillet_m
    if gauge.beam == "V":
        bottom = outline.foot_m + (fillet if outline.fixture_depth_m > 0.0 else 0.0)
        return 1, (-0.5 if gauge.side == "left" else 0.5) * g.h2_m, bottom, -0.5 * g.h1_m - fillet
    if gauge.face == "upper":
        # No corner at the joint: the vertical beam is on the other face.
        end = g.a_m - outline.slit_fillet_m
        return 0, 0.5 * g.h1_m, -end, end
    end = g.a_m if outline.leg_below_m > 0.0 else outline.half_width_m
    inner = 0.5 * g.h2_m + fillet
    return 0, -0.5 * g.h1_m, *((inner, end) if gauge.side == "right" else (-end, -inner))


LEAST_ORDER, MOST_ORDER = 0.3, 3.0
SAFETY = 1.25
MODES = {"opening": 1.0, "sliding": -1.0}
"""Williams' two families at a corner with free faces: symmetric and antisymmetric about its bisector."""


class Limit(NamedTuple):
    """The limit of a sequence on meshes of n, 2 n, 4 n."""

    value: float
    error: float
    """1.25 times the finest value's distance from its limit (Roache); without an order the larger last change."""
    order: float
    """NaN: the differences do not decrease with one sign, and the value is the finest one."""


def extrapolate(values: Sequence[float]) -> Limit:
    """Return the limit of the last three values, finite, each on a mesh twice as fine as the one before."""
    coarse, middle, fine = (float(value) for value in values[-3:])
    first, second = middle - coarse, fine - middle
    ratio = first / second if second != 0.0 else math.inf
    if not ratio > 2.0**LEAST_ORDER or math.isinf(ratio):
        return Limit(fine, max(abs(first), abs(second)), math.nan)
    # fine + second (1 / ratio + 1 / ratio^2 + ...)
    change = second / (min(ratio, 2.0**MOST_ORDER) - 1.0)
    return Limit(fine + change, SAFETY * abs(change), math.log2(ratio))


def extrapolate_matrix(values: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """Return the limit of the last three matrices, one ratio for all entries, and its relative error (Frobenius)."""
    coarse, middle, fine = values[-3:]
    ratio = float(np.linalg.norm(middle - coarse) / np.linalg.norm(fine - middle))
    change = (fine - middle) / max(min(ratio, 2.0**MOST_ORDER) - 1.0, 1.0)
    return fine + change, SAFETY * float(np.linalg.norm(change) / np.linalg.norm(fine))


def corner_exponent(material_angle_rad: float, mode: str) -> float:
    """Return lambda, displacement ~ r^lambda, of a corner with free faces (Williams 1952): the smallest root above 1/2
    of sin(lambda w) + s lambda sin(w) = 0, s = 1 (opening) or -1 (sliding). Raises InputError if it is not singular."""
    from scipy.optimize import brentq

    if mode not in MODES:
        raise InputError(f"mode {mode!r}: allowed are {', '.join(MODES)}")
    w, sign = float(material_angle_rad), MODES[mode]
    if not math.pi < w < 2.0 * math.pi:
        raise InputError(f"material angle {math.degrees(w):g} degrees: allowed is above 180 and below 360")

    def mismatch(exponent: float) -> float:
        return math.sin(exponent * w) + sign * exponent * math.sin(w)

    # lambda = 1 is a root of the sliding family, but only a rotation; singular roots are below it.
    low, high = 0.5, 1.0 - 1e-9
    if mismatch(low) * mismatch(high) > 0.0:
        raise InputError(f"material angle {math.degrees(w):g} degrees: the {mode} mode is not singular there")
    return float(brentq(mismatch, low, high, xtol=1e-15))
