"""Triangulations and the solver: valid, exact area; patch test, equilibrium, beam theory where it holds."""

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from skfem import Basis, ElementTriP2, ElementVector, MeshTri

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.sensor.structure.layouts import LAYOUTS
from tipforce.sensor.structure.quality import condition_number, mirror
from tipforce.sensor.structure.strain import FABRICATED, GaugePosition, strain_row
from tipforce_lab.fem.mesh import GRADING, STATED, Outline, Resolution, Triangles, triangulate
from tipforce_lab.fem.plane_stress import Model, Patch, Plane, Solution, _stiffness, solve, strain_matrix

THIN_LEGS = Outline(leg_m=0.2e-3, tip_side_m=0.5e-3)
ROUND = Outline(fillet_m=0.5e-3, slit_fillet_m=0.125e-3)
HALF_ROUND = Outline(fillet_m=0.05e-3, slit_fillet_m=0.05e-3)
LOW_LEGS = Outline(leg_below_m=2e-3, slit_fillet_m=0.1e-3)
NO_FIXTURE = Outline(fixture_depth_m=0.0)
ODD = Outline(replace(FABRICATED, a_m=11e-3, d_m=17e-3, r_m=19e-3, h1_m=0.5e-3, h2_m=0.7e-3), fixture_half_width_m=4e-3)
OUTLINES = [STATED, THIN_LEGS, ROUND, HALF_ROUND, LOW_LEGS, NO_FIXTURE, ODD]


def areas_m2(mesh: Triangles) -> np.ndarray:
    p, q, s = (mesh.points_m[:, index] for index in mesh.corners)
    result: np.ndarray = 0.5 * ((q[0] - p[0]) * (s[1] - p[1]) - (s[0] - p[0]) * (q[1] - p[1]))
    return result


def area_with_chords(outline: Outline, mesh: Triangles) -> float:
    """The exact area of the body with its arcs replaced by the chords of the mesh."""
    x, y = mesh.points_m
    rectangles = sum((part.right_m - part.left_m) * (part.upper_m - part.lower_m) for part in outline.rectangles())
    on_arc = np.isclose(np.hypot(x, y), outline.tip_radius_m, rtol=1e-12, atol=0.0) & (y > outline.tip_bottom_m)
    along = np.sort(x[on_arc])
    heights = outline.tip_top_m(along) - outline.tip_bottom_m
    tip = float(np.diff(along) @ (heights[1:] + heights[:-1])) / 2.0
    fillets = 0.0
    for corner in outline.corners().values():
        if corner.radius_m > 0.0:
            # A fillet of 2 m chords: the square less the polygon sector of a quarter circle.
            count = np.sum(_on_fillet(corner.x_m, corner.y_m, corner.free_x, corner.free_y, corner.radius_m, x, y)) - 1
            sector = 0.5 * count * math.sin(0.5 * math.pi / count)
            fillets += corner.radius_m**2 * (1.0 - sector)
    return rectangles + tip + fillets


def _on_fillet(cx: float, cy: float, fx: float, fy: float, radius: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    u, v = (x - cx) * fx, (y - cy) * fy
    near = (u > -1e-9) & (u < radius + 1e-9) & (v > -1e-9) & (v < radius + 1e-9)
    result: np.ndarray = near & np.isclose(np.hypot(u - radius, v - radius), radius, rtol=1e-9, atol=0.0)
    return result


@pytest.mark.parametrize("grading", [1.0, GRADING])
@pytest.mark.parametrize("cells", [1, 3])
@pytest.mark.parametrize("outline", OUTLINES)
def test_no_triangle_is_inverted_and_the_area_is_exact(outline: Outline, cells: int, grading: float) -> None:
    mesh = triangulate(outline, Resolution(cells, grading))
    areas = areas_m2(mesh)
    assert areas.min() > 0.0
    assert areas.sum() == pytest.approx(area_with_chords(outline, mesh), rel=1e-12)


@pytest.mark.parametrize("outline", OUTLINES)
def test_the_mesh_is_its_own_mirror_image(outline: Outline) -> None:
    mesh = triangulate(outline, Resolution(2))
    centres = mesh.points_m[:, mesh.corners].mean(axis=1).T
    found, wanted = (part[np.lexsort(np.round(part.T, 15))] for part in (centres * (-1.0, 1.0), centres))
    np.testing.assert_allclose(found, wanted, atol=1e-15)


def test_halving_keeps_the_nodes() -> None:
    # Below the arc, whose chords move.
    coarse, fine = (triangulate(NO_FIXTURE, Resolution(n)).points_m for n in (2, 4))
    coarse = coarse[:, coarse[1] <= NO_FIXTURE.tip_bottom_m]
    assert np.array([np.abs(fine - point[:, np.newaxis]).max(axis=0).min() for point in coarse.T]).max() < 1e-15


def test_graded_cells_do_not_get_long_and_thin() -> None:
    mesh = triangulate(STATED, Resolution(6))
    corner = np.array([[0.5 * STATED.geometry.h2_m], [-0.5 * STATED.geometry.h1_m]])
    p = mesh.points_m[:, mesh.corners]
    near = np.abs(p - corner[:, :, np.newaxis]).max(axis=(0, 1)) < 0.05e-3
    sides = np.linalg.norm(p - np.roll(p, 1, axis=1), axis=0)[:, near]
    assert near.sum() > 50
    assert (sides.max(axis=0) ** 2 / areas_m2(mesh)[near]).max() < 60.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (partial(Outline, slit_m=0.0), "outline slit_m = 0.0: allowed is a positive finite number"),
        (partial(Outline, leg_m=float("nan")), "outline leg_m = nan"),
        (partial(Outline, leg_m=True), "outline leg_m = True"),
        (partial(Outline, fillet_m=-1e-4), "outline fillet_m = -0.0001: allowed is 0 or more"),
        (partial(Outline, slit_fillet_m=0.2e-3), "outline slit_fillet_m = 0.0002: allowed is at most half of slit_m"),
        (partial(Outline, fillet_m=7e-3), "outline fillet_m = 0.007"),
        (partial(Outline, fixture_half_width_m=1e-3), "outline fixture_half_width_m = 0.001: allowed is above"),
        (partial(Outline, fixture_half_width_m=20e-3), "outline fixture_half_width_m = 0.02"),
        (partial(Outline, leg_below_m=0.5e-3), "outline leg_below_m = 0.0005: allowed is 0, or above"),
        (partial(Outline, leg_below_m=15e-3), "outline leg_below_m = 0.015"),
        (partial(Outline, geometry=replace(FABRICATED, a_m=2e-3)),
         "allowed are beams longer than the 1 mm at both ends"),
        (partial(Outline, geometry=replace(FABRICATED, d_m=1.5e-3)), "allowed"),
        (partial(Outline, fixture_depth_m=float("inf")), "outline fixture_depth_m = inf"),
        *(
            (partial(Resolution, *given), "allowed")
            for given in ((0, 2.0), (33, 1.0), (True, 2.0), (4, 0.5), (4, 9.0), (32, 6.0))
        ),
        (partial(Model, plane="shell"), "plane 'shell': allowed are stress or strain"),  # type: ignore[arg-type]
        (partial(Model, poisson_ratio=0.5), "poisson_ratio = 0.5: allowed is above -1"),
        (partial(Model, poisson_ratio=float("nan")), "poisson_ratio = nan"),
        (partial(Patch, math.nan), "half angle"),
        (partial(solve, Model(resolution=Resolution(1), patch=Patch(-1.0, 0.01))), "a wider patch or a finer mesh"),
    ],
)  # fmt: skip
def test_bad_outlines_and_models(make: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value)


@cache
def solved(cells: int = 2, plane: Plane = "stress", theta_deg: float | None = None) -> Solution:
    patch = None if theta_deg is None else Patch(math.radians(theta_deg))
    return solve(Model(resolution=Resolution(cells), plane=plane, patch=patch))


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_patch(plane: Plane) -> None:
    """A linear displacement leaves no force inside the body, and stores exactly its energy."""
    model = Model(Outline(fillet_m=0.2e-3), Resolution(2), plane)
    mesh = triangulate(model.outline, model.resolution)
    basis = Basis(MeshTri(mesh.points_m, mesh.corners), ElementVector(ElementTriP2()), intorder=2)
    K = _stiffness(basis, model)
    exx, eyy, gxy = 1.0, -0.4, 0.7
    x, y = basis.doflocs
    u = np.zeros(basis.N)
    first = np.concatenate([basis.nodal_dofs[0], basis.facet_dofs[0]])
    second = np.concatenate([basis.nodal_dofs[1], basis.facet_dofs[1]])
    u[first], u[second] = exx * x[first] + gxy * y[first], eyy * y[second]
    force = K @ u
    inside = np.setdiff1d(np.arange(basis.N), basis.get_dofs().all())
    assert np.abs(force[inside]).max() < 1e-9 * np.abs(force).max()
    nu = model.poisson_ratio
    if plane == "stress":
        density = (exx**2 + eyy**2 + 2.0 * nu * exx * eyy) / (1.0 - nu**2)
    else:
        density = ((1.0 - nu) * (exx**2 + eyy**2) + 2.0 * nu * exx * eyy) / (1.0 + nu) / (1.0 - 2.0 * nu)
    density += gxy**2 * 0.5 / (1.0 + nu)
    assert u @ force == pytest.approx(density * areas_m2(mesh).sum(), rel=1e-9)


@pytest.mark.parametrize("theta_deg", [None, 40.0])
def test_reactions_balance_the_load(theta_deg: float | None) -> None:
    found, r = solved(theta_deg=theta_deg).reactions, FABRICATED.r_m
    np.testing.assert_allclose(found, -np.array([[0, 0, 1], [1, 0, 0], [0, r, 0]]), atol=2e-6)


@pytest.mark.parametrize(("plane", "factor"), [("stress", 1.0), ("strain", 1.0 - 0.29**2)])
def test_away_from_its_ends_the_vertical_beam_is_a_beam(plane: Plane, factor: float) -> None:
    # Statically determinate: nothing but the sections' own stiffness is in it.
    cells = 3
    length_m = 2.0 * (15.0 - 2.0) * 1e-3 / (6 * cells)  # ends on nodes: between them displacement is less exact
    for side in ("left", "right"):
        place = GaugePosition("V", side, 7.5e-3)
        row = strain_matrix(solved(cells, plane), [place], length_m)[0]
        theory = strain_row(FABRICATED, *place) * factor
        np.testing.assert_allclose(row, theory, atol=3e-4 * np.abs(theory).max())


def test_a_cantilever_bends_and_shears() -> None:
    """u_x of the vertical beam's middle line under F3, clamped at its foot: bending, and s / (kappa G A)."""
    stubby = Outline(replace(FABRICATED, h2_m=3e-3), fixture_depth_m=0.0)
    solution = solve(Model(stubby, Resolution(2)))
    g = stubby.geometry
    length, inertia = g.d_m + 0.5 * g.h1_m, g.h2_m**3 / 12.0
    middles, motion = solution.faces[1], solution.face_motion[1]
    chosen = (np.abs(np.abs(middles[0]) - 0.5 * g.h2_m) < 1e-9) & (middles[1] < stubby.foot_m + 13e-3)
    chosen &= middles[1] > stubby.foot_m + 9e-3
    s, found = middles[1, chosen] - stubby.foot_m, motion[0, chosen, 2]
    bending = (0.5 * length * s**2 - s**3 / 6.0) / inertia
    shear = s * 2.0 * (1.0 + solution.model.poisson_ratio) * 6.0 / 5.0 / g.h2_m
    assert chosen.sum() >= 8
    assert np.abs(found / (bending + shear) - 1.0).max() < 0.006
    assert (found / bending - 1.0).min() > 0.02


def test_left_and_right_are_mirror_images() -> None:
    A = strain_matrix(solved(), ["L", "R", "K_H", "S_H", "T", "U", "K_V", "S_V"])
    np.testing.assert_allclose(A[0::2] * (1.0, -1.0, -1.0), A[1::2], atol=1e-6 * np.abs(A).max())
    for case in ("I", "II", "III"):
        one, other = (condition_number(strain_matrix(solved(), points)) for points in (LAYOUTS[case], mirror(case)))
        assert one == pytest.approx(other, rel=1e-5)


def test_where_on_the_arc_the_load_acts_hardly_matters() -> None:
    gauges = ("L", "R", "K_H", "S_H", "U")
    everywhere, one = strain_matrix(solved(), gauges), strain_matrix(solved(theta_deg=40.0), gauges)
    assert 1e-6 < np.abs(one - everywhere).max() / np.abs(everywhere).max() < 1e-2


def test_youngs_modulus_and_width_only_scale() -> None:
    other = replace(STATED, geometry=replace(FABRICATED, youngs_modulus_pascals=70e9, width_m=5e-3))
    gauges = ["S_H", "U"]
    ratio = strain_matrix(solve(Model(other, Resolution(1))), gauges) / strain_matrix(solved(1), gauges)
    np.testing.assert_allclose(ratio, 205.0 / 70.0 * 2.0, rtol=1e-9)


def test_without_scikit_fem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skfem", None)
    with pytest.raises(EnvironmentLackError, match=r'pip install "tipforce\[fem\]"'):
        solve(Model(resolution=Resolution(1)))
