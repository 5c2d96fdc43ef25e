"""Structure models side by side: Table 1, the plane frame, and finite elements on uniform and graded meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor.structure.layouts import CASES
from tipforce_lab.report.study import Effort, Need, Point, Series, Study, Timing, timed

if TYPE_CHECKING:
    from tipforce.sensor.structure.plane_frame import FrameModel
    from tipforce_lab.fem.gauges import Limit

Matrix = Callable[[], FloatArray]

GAUGES = ("L", "R", "K_H", "S_H", "U")
"""The gauges of the three cases: the rows of the strain matrix."""
BEAMS = 5
"""Models without a mesh."""
MESHES = 3
STEPS = 1 + BEAMS + 2 * MESHES
LEFT_OUT = 'scikit-fem or scipy is missing: pip install "tipforce[fem]"'
_QUICK_CELLS, _FULL_CELLS = (1, 2, 3), (2, 3, 5)
_QUICK_REFERENCE, _FULL_REFERENCE = (1, 2, 4), (2, 4, 8)


@dataclass(frozen=True, slots=True)
class _Reference:
    """The finest graded meshes, extrapolated."""

    conditions: tuple[Limit, ...]
    matrix: FloatArray
    matrix_error: float
    """Relative, Frobenius norm."""
    cells: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Found:
    """One setting of one model."""

    setting: str
    matrix: FloatArray
    timing: Timing


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return two studies, of the condition numbers and of the strain matrix; they share models, runs and times.

    Without scikit-fem there is no reference: both are returned without series, with the package to install.
    """
    try:
        import scipy.sparse.linalg  # noqa: F401
        import skfem  # noqa: F401
    except ImportError:
        for _ in range(STEPS):
            advance()
        return [_left_out(key, title) for key, title in _TITLES.items()]
    reference = _reference(effort)
    advance()
    results: dict[str, list[_Found]] = {}
    for method, matrix in _beam_models().items():
        results[method] = [_Found("", matrix(), timed(matrix, effort))]
        advance()
    for method, grading in (("FE, uniform meshes", 1.0), ("FE, graded meshes", None)):
        results[method] = []
        for cells in _QUICK_CELLS if effort.quick else _FULL_CELLS:
            results[method].append(_finite_elements(effort, cells, grading))
            advance()
    return [_conditions(reference, results), _matrices(reference, results)]


_TITLES = {
    "structure-condition": "Structure models: condition number",
    "structure-strain": "Structure models: strain matrix",
}


def _conditions(reference: _Reference, results: dict[str, list[_Found]]) -> Study:
    """Return the error of a model: the largest of the three cases."""

    def error(matrix: FloatArray) -> float:
        pairs = zip(conditions(matrix), reference.conditions, strict=True)
        return max(abs(value / limit.value - 1.0) for value, limit in pairs)

    limits = zip(CASES, reference.conditions, strict=True)
    values = ", ".join(f"{case} {limit.value:.4f} +- {limit.error:.4f}" for case, limit in limits)
    return _study(
        "structure-condition", "relative error of the condition number, the largest of cases I, II, III",
        f"{_what(reference)}: {values}", max(limit.error / limit.value for limit in reference.conditions),
        results, error,
        (Need("rank gauge layouts, condition number to 6 %", 0.06), Need("condition number to 0.5 %", 5e-3)),
    )  # fmt: skip


def _matrices(reference: _Reference, results: dict[str, list[_Found]]) -> Study:
    def error(matrix: FloatArray) -> float:
        return float(np.linalg.norm(matrix - reference.matrix) / np.linalg.norm(reference.matrix))

    return _study(
        "structure-strain", f"relative error of the strain matrix ({', '.join(GAUGES)}), Frobenius norm",
        _what(reference), reference.matrix_error, results, error,
        (Need("strain of a gauge to 5 %", 0.05), Need("strain of a gauge to 0.5 %", 5e-3)),
    )  # fmt: skip


def _study(
    key: str, error_unit: str, reference: str, known: float, results: dict[str, list[_Found]],
    error: Callable[[FloatArray], float], needs: tuple[Need, ...],
) -> Study:  # fmt: skip
    return Study(
        key, _TITLES[key], error_unit, "s per structure (mesh to strain matrix)", reference, known,
        tuple(
            Series(method, tuple(Point(result.setting, error(result.matrix), result.timing) for result in points))
            for method, points in results.items()
        ),
        remarks=(_against_uniform(results, error), _beams_against_meshes(results, error)), needs=needs,
    )  # fmt: skip


def _what(reference: _Reference) -> str:
    levels = ", ".join(str(n) for n in reference.cells)
    return f"plane-stress FE of the stated outline, 1 mm gauges, graded meshes n = {levels} extrapolated"


def _against_uniform(results: dict[str, list[_Found]], error: Callable[[FloatArray], float]) -> str:
    uniform, graded = results["FE, uniform meshes"][-1], results["FE, graded meshes"][-1]
    return (
        f"With as many unknowns ({graded.setting}) the graded mesh has an error of {error(graded.matrix):.1e}, the "
        f"uniform one {error(uniform.matrix):.1e}."
    )


def _beams_against_meshes(results: dict[str, list[_Found]], error: Callable[[FloatArray], float]) -> str:
    beams = {method: error(points[0].matrix) for method, points in results.items() if not method.startswith("FE")}
    best = min(beams, key=lambda method: beams[method])
    return (
        f"No beam model includes the corners: the best, {best}, is {beams[best]:.1%} off, where gauges fit; Table 1 at "
        f"its points is {beams['Table 1, at its points']:.0%} off."
    )


def conditions(matrix: FloatArray) -> list[float]:
    """Return the condition numbers of the three cases from the rows GAUGES (5, 3)."""
    from tipforce.sensor.structure.layouts import LAYOUTS
    from tipforce.sensor.structure.strain import condition_number

    return [condition_number(matrix[[GAUGES.index(point) for point in LAYOUTS[case]]]) for case in CASES]


def _beam_models() -> dict[str, Matrix]:
    """Return models without a mesh. All but the first have the gauge positions of the finite elements."""
    from tipforce.sensor.structure.gauges import position_matrix
    from tipforce.sensor.structure.plane_frame import ELASTIC_ROOTS, EULER_BERNOULLI, TIMOSHENKO, Frame
    from tipforce.sensor.structure.published import GAUGE_LENGTH_M
    from tipforce.sensor.structure.strain import strain_matrix
    from tipforce_lab.fem.gauges import nearest_place
    from tipforce_lab.fem.outline import STATED

    geometry = STATED.geometry
    places = [nearest_place(STATED, point) for point in GAUGES]

    def frame(model: FrameModel) -> Matrix:
        return lambda: Frame(geometry, model).strain_matrix(places, GAUGE_LENGTH_M)

    return {
        "Table 1, at its points": lambda: strain_matrix(geometry, GAUGES),
        "Table 1, where 1 mm gauges fit": lambda: position_matrix(geometry, places),
        "frame, Euler-Bernoulli": frame(EULER_BERNOULLI),
        "frame, Timoshenko": frame(TIMOSHENKO),
        "frame, roots that rotate": frame(ELASTIC_ROOTS),
    }


def _fe_matrix(cells: int, grading: float | None) -> tuple[FloatArray, int]:
    from tipforce_lab.fem.gauges import strain_matrix
    from tipforce_lab.fem.mesh import GRADING, Resolution
    from tipforce_lab.fem.plane_stress import Model, solve

    solution = solve(Model(resolution=Resolution(cells, GRADING if grading is None else grading)))
    return strain_matrix(solution, GAUGES), solution.unknowns


def _finite_elements(effort: Effort, cells: int, grading: float | None) -> _Found:
    matrix, unknowns = _fe_matrix(cells, grading)
    return _Found(f"n = {cells}, {unknowns} unknowns", matrix, timed(lambda: _fe_matrix(cells, grading), effort))


def _reference(effort: Effort) -> _Reference:
    from tipforce_lab.fem.gauges import extrapolate, extrapolate_matrix

    levels = _QUICK_REFERENCE if effort.quick else _FULL_REFERENCE
    matrices = [_fe_matrix(cells, None)[0] for cells in levels]
    limits = tuple(extrapolate(values) for values in zip(*(conditions(matrix) for matrix in matrices), strict=True))
    matrix, error = extrapolate_matrix(matrices)
    return _Reference(limits, matrix, error, levels)


def _left_out(key: str, title: str) -> Study:
    return Study(key, title, "", "", "none", float("nan"), (), {"finite elements and all that they judge": LEFT_OUT})
