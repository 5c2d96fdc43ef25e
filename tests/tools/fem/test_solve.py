"""The solver: patch test, equilibrium, beam theory where it holds, symmetry, and loads."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from skfem import Basis, ElementTriP2, ElementVector, MeshTri

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.sensor.structure.gauges import GaugePosition, strain_row
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.layouts import LAYOUTS, mirror
from tipforce.sensor.structure.strain import condition_number
from tipforce_lab.fem.mesh import STATED, Outline, Resolution, triangulate
from tipforce_lab.fem.plane_stress import Model, Patch, Plane, Solution, _stiffness, solve, strain_matrix
from tools.fem.test_mesh import areas_m2

FloatArray = npt.NDArray[np.float64]


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"plane": "shell"}, "plane 'shell': allowed are stress or strain"),
        ({"poisson_ratio": 0.5}, "poisson_ratio = 0.5: allowed is above -1"),
        ({"poisson_ratio": float("nan")}, "poisson_ratio = nan"),
    ],
)
def test_bad_models(change: dict[str, float], message: str) -> None:
    with pytest.raises(InputError) as caught:
        Model(**change)  # type: ignore[arg-type]
    assert message in str(caught.value)


def test_bad_patches() -> None:
    with pytest.raises(InputError, match="half angle"):
        Patch(math.nan)
    with pytest.raises(InputError, match="a wider patch or a finer mesh"):
        solve(Model(resolution=Resolution(1), patch=Patch(-1.0, 0.01)))


def test_without_scikit_fem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skfem", None)
    with pytest.raises(EnvironmentLackError, match=r'pip install "tipforce\[fem\]"'):
        solve(Model(resolution=Resolution(1)))
