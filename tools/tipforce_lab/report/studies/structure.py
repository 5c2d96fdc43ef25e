"""Structure models side by side: Table 1, the plane frame, and finite elements on uniform and graded meshes."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor.structure.layouts import CASES, GAUGE_LENGTH_M, LAYOUTS
from tipforce.sensor.structure.plane_frame import ELASTIC_ROOTS, EULER_BERNOULLI, TIMOSHENKO, Frame, FrameModel
from tipforce.sensor.structure.quality import condition_number
from tipforce.sensor.structure.strain import position_matrix, strain_matrix
from tipforce_lab.fem import plane_stress as fem
from tipforce_lab.fem.mesh import GRADING, STATED, Resolution
from tipforce_lab.fem.plane_stress import Model, solve
from tipforce_lab.report.study import Effort, Need, Point, Study, Timing, series_of, timed

GAUGES = ("L", "R", "K_H", "S_H", "U")
"""The gauges of the three cases: the rows of the strain matrix."""
STEPS = 1 + 5 + 2 * 3
"""The references, the models without a mesh, three meshes of both kinds."""
LEFT_OUT = 'scikit-fem or scipy is missing: pip install "tipforce[fem]"'
_UNIFORM, _GRADED = "FE, uniform meshes", "FE, graded meshes"
_Results = list[tuple[str, str, FloatArray, Timing]]
"""Method, setting, strain matrix, time."""


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return two studies, of condition numbers and strain matrix; without scikit-fem both lack their series."""
    try:
        import scipy.sparse.linalg  # noqa: F401
        import skfem  # noqa: F401
    except ImportError:
        for _ in range(STEPS):
            advance()
        lack = {"finite elements and all that they judge": LEFT_OUT}
        return [Study(key, title, "", "", "none", float("nan"), (), lack) for key, title in _TITLES.items()]
    levels = (1, 2, 4) if effort.quick else (2, 4, 8)
    references = [_finite_elements(cells, GRADING)[0] for cells in levels]
    advance()
    results: _Results = []
    for method, matrix in _beam_models().items():
        results.append((method, "", matrix(), timed(matrix, effort)))
        advance()
    for method, grading in ((_UNIFORM, 1.0), (_GRADED, GRADING)):
        for cells in (1, 2, 3) if effort.quick else (2, 3, 5):
            fe, unknowns = _finite_elements(cells, grading)
            timing = timed(partial(_finite_elements, cells, grading), effort)
            results.append((method, f"n = {cells}, {unknowns} unknowns", fe, timing))
            advance()
    shown = ", ".join(map(str, levels))
    what = f"plane-stress FE of the stated outline, 1 mm gauges, graded meshes n = {shown} extrapolated"
    limits = [fem.extrapolate(values) for values in zip(*map(conditions, references), strict=True)]
    values = (f"{case} {limit.value:.4f} +- {limit.error:.4f}" for case, limit in zip(CASES, limits, strict=True))
    matrix_limit, own_error = fem.extrapolate_matrix(references)
    return [
        _study(
            "structure-condition", "relative error of the condition number, the largest of cases I, II, III",
            f"{what}: {', '.join(values)}", max(limit.error / limit.value for limit in limits), results,
            lambda matrix: worst_error(conditions(matrix), [limit.value for limit in limits]),
            (Need("rank gauge layouts, condition number to 6 %", 0.06), Need("condition number to 0.5 %", 5e-3)),
        ),
        _study(
            "structure-strain", f"relative error of the strain matrix ({', '.join(GAUGES)}), Frobenius norm", what,
            own_error, results, lambda matrix: distance(matrix, matrix_limit),
            (Need("strain of a gauge to 5 %", 0.05), Need("strain of a gauge to 0.5 %", 5e-3)),
        ),
    ]  # fmt: skip


_TITLES = {
    "structure-condition": "Structure models: condition number",
    "structure-strain": "Structure models: strain matrix",
}


def _study(
    key: str, error_unit: str, reference: str, own_error: float, results: _Results,
    error: Callable[[FloatArray], float], needs: tuple[Need, ...],
) -> Study:  # fmt: skip
    series = series_of((method, Point(setting, error(matrix), timing)) for method, setting, matrix, timing in results)
    errors = {model.method: model.points[-1].error for model in series}
    best = min((method for method in errors if not method.startswith("FE")), key=lambda method: errors[method])
    remarks = (
        f"With as many unknowns ({series[-1].points[-1].setting}) the graded mesh has an error of "
        f"{errors[_GRADED]:.1e}, the uniform one {errors[_UNIFORM]:.1e}.",
        f"No beam model includes the corners: the best, {best}, is {errors[best]:.1%} off, where gauges fit; Table 1 "
        f"at its points is {errors['Table 1, at its points']:.0%} off.",
    )
    return Study(
        key, _TITLES[key], error_unit, "s per structure (mesh to strain matrix)", reference, own_error, series,
        remarks=remarks, needs=needs,
    )  # fmt: skip


def conditions(matrix: FloatArray) -> list[float]:
    """Return the condition numbers of the three cases from the rows GAUGES (5, 3)."""
    return [condition_number(matrix[[GAUGES.index(point) for point in LAYOUTS[case]]]) for case in CASES]


def worst_error(values: Sequence[float], limits: Sequence[float]) -> float:
    """Return the largest relative error of the cases."""
    return max(abs(value / limit - 1.0) for value, limit in zip(values, limits, strict=True))


def distance(matrix: FloatArray, other: FloatArray) -> float:
    """Return the relative distance in the Frobenius norm."""
    return float(np.linalg.norm(matrix - other) / np.linalg.norm(other))


def _beam_models() -> dict[str, Callable[[], FloatArray]]:
    """Return models without a mesh. All but the first have the gauge positions of the finite elements."""
    geometry = STATED.geometry
    places = [fem.nearest_place(STATED, point) for point in GAUGES]

    def frame(model: FrameModel) -> Callable[[], FloatArray]:
        return lambda: Frame(geometry, model).strain_matrix(places, GAUGE_LENGTH_M)

    frames = {"Euler-Bernoulli": EULER_BERNOULLI, "Timoshenko": TIMOSHENKO, "roots that rotate": ELASTIC_ROOTS}
    return {
        "Table 1, at its points": lambda: strain_matrix(geometry, GAUGES),
        "Table 1, where 1 mm gauges fit": lambda: position_matrix(geometry, places),
        **{f"frame, {name}": frame(model) for name, model in frames.items()},
    }


def _finite_elements(cells: int, grading: float) -> tuple[FloatArray, int]:
    solution = solve(Model(resolution=Resolution(cells, grading)))
    return fem.strain_matrix(solution, GAUGES), solution.unknowns
