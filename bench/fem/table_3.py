"""What stands behind Table 3's simulation column: outline, places of gauges, and what cannot give the measurement."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from bench.fem.studies import GAUGES, case_conditions

from tipforce.sensor.structure.gauge_shift import GaugePosition
from tipforce.sensor.structure.layouts import CASES, LAYOUTS
from tipforce.sensor.structure.published import GAUGE_LENGTH_M, TABLE_3_MEASUREMENT, TABLE_3_SIMULATION
from tipforce_lab.fem.gauges import nearest_place, strain_matrix
from tipforce_lab.fem.mesh import Resolution
from tipforce_lab.fem.outline import STATED
from tipforce_lab.fem.plane_stress import Model, Patch, Solution, solve

FloatArray = npt.NDArray[np.float64]


def conditions(solution: Solution, moved: dict[str, GaugePosition] | None = None) -> tuple[float, ...]:
    """Condition numbers of cases I, II, III, 1 mm gauges where they fit or at the places of ``moved``."""
    places = {point: (moved or {}).get(point) or nearest_place(solution.model.outline, point) for point in GAUGES}
    matrix = strain_matrix(solution, [places[point] for point in GAUGES])
    return case_conditions(matrix)


class Variant(NamedTuple):
    """One body or one placing of gauges, with the condition numbers of cases I, II, III."""

    what: str
    conditions: tuple[float, ...]


def outline_variants(cells: int) -> list[Variant]:
    """How the outline's unstated parts move the condition numbers, gauges where they fit."""
    mm = 1e-3
    bodies: list[tuple[str, Model]] = [("stated outline", Model())]
    bodies += [(f"legs {leg:g} mm", _body(leg_m=leg * mm)) for leg in (0.2, 0.25, 0.3, 0.4, 0.5, 1.0, 4.0)]
    bodies += [(f"slit {slit:g} mm", _body(slit_m=slit * mm)) for slit in (0.1, 1.0)]
    bodies += [("legs 2 mm below the beam too", _body(leg_below_m=2.0 * mm))]
    bodies += [
        (f"fillets {radius:g} mm at joint and foot", _body(fillet_m=radius * mm)) for radius in (0.05, 0.25, 0.5)
    ]
    bodies += [("slit ends round, 0.125 mm", _body(slit_fillet_m=0.125 * mm))]
    bodies += [("foot clamped, no fixture", _body(fixture_depth_m=0.0)), ("plane strain", Model(plane="strain"))]
    bodies += [
        (f"load on 10 degrees of arc at theta {theta}", Model(patch=Patch(math.radians(theta)))) for theta in (30, 90)
    ]
    return [Variant(what, conditions(solve(replace(m, resolution=Resolution(cells))))) for what, m in bodies]


def _body(**change: float) -> Model:
    return Model(replace(STATED, **change))  # type: ignore[arg-type]


def outer_gauges(position_m: float) -> dict[str, GaugePosition]:
    """L and R at one distance from the middle."""
    return {"L": GaugePosition("H", "left", position_m), "R": GaugePosition("H", "right", position_m)}


def position_variants(solution: Solution) -> list[Variant]:
    """L and R elsewhere, K, S, U where they fit. Beyond 14.5 mm a part of the gauge is glued under the leg."""
    places_mm = (15.25, 15.0, 14.75, 14.5, 14.0, 13.5, 13.0)
    return [Variant(f"L, R at {x:g} mm", conditions(solution, outer_gauges(x * 1e-3))) for x in places_mm]


def inner_variants(solution: Solution) -> list[Variant]:
    """K, S and U further from their corners than 0.5 mm."""
    found = []
    for shift_mm in (0.0, 0.25, 0.5, 1.0):
        moved = {}
        for point, sign in (("K_H", 1.0), ("S_H", 1.0), ("U", -1.0)):
            place = nearest_place(solution.model.outline, point)
            moved[point] = place._replace(position_m=place.position_m + sign * shift_mm * 1e-3)
        found.append(Variant(f"K, S, U {0.5 + shift_mm:g} mm from the corner", conditions(solution, moved)))
    return found


class Match(NamedTuple):
    """What reaches a condition number that ANSYS has."""

    what: str
    case: str
    wanted: float
    found: float
    unit: str
    conditions: tuple[float, ...]


def matches(solution: Solution, cells: int) -> list[Match]:
    """The places of L and R, and the thickness of the legs, that give ANSYS's numbers for II and III."""
    inward: dict[str, Callable[[float], tuple[float, ...]]] = {
        "L, R inward": lambda x: conditions(solution, outer_gauges(x * 1e-3)),
        "L, R outward": lambda x: conditions(solution, outer_gauges(x * 1e-3)),
        "legs thin": lambda leg: conditions(solve(replace(_body(leg_m=leg * 1e-3), resolution=Resolution(cells)))),
    }
    ranges = {"L, R inward": (14.4, 12.6), "L, R outward": (14.6, 15.4), "legs thin": (0.5, 0.2)}
    found = []
    for what, evaluate in inward.items():
        for index, case in ((1, "II"), (2, "III")):
            wanted = TABLE_3_SIMULATION[case]
            value = _root(lambda x, i=index, w=wanted, f=evaluate: f(x)[i] - w, *ranges[what])  # type: ignore[misc]
            found.append(Match(what, case, wanted, value, "mm", evaluate(value)))
    return found


class OneBody(NamedTuple):
    """Legs and fillets that give cases I and III at once; II is then a check."""

    leg_mm: float
    fillet_mm: float
    conditions: tuple[float, ...]


def one_body(cells: int) -> OneBody:
    """Solve for ANSYS's I and III with the fillets at joint and foot and the legs' thickness, in turn.

    The numbers returned are those of the found body on a mesh twice as fine.
    """

    def body(leg: float, fillet: float, n: int = cells) -> tuple[float, ...]:
        changed = _body(leg_m=leg * 1e-3, fillet_m=fillet * 1e-3)
        return conditions(solve(replace(changed, resolution=Resolution(n))))

    leg, fillet = 0.25, 0.3
    for _ in range(3):
        fillet = _root(lambda x, t=leg: body(t, x)[0] - TABLE_3_SIMULATION["I"], 0.05, 0.6)  # type: ignore[misc]
        leg = _root(lambda x, t=fillet: body(x, t)[2] - TABLE_3_SIMULATION["III"], 0.15, 0.5)  # type: ignore[misc]
    return OneBody(leg, fillet, body(leg, fillet, 2 * cells))


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    from scipy.optimize import brentq

    return float(brentq(function, low, high, xtol=1e-4))


class Miss(NamedTuple):
    """The best that places alone can do for the measured column."""

    places_mm: tuple[float, ...]
    """L, R, K, S from the middle of the joint, U from its underside."""
    conditions: tuple[float, ...]
    worst: float


def best_for_measured(solution: Solution, steps: int) -> Miss:
    """Search a grid of places of all five gauges, up to 6 mm inward, for the measured 3.50, 3.50, 3.34."""
    outline = solution.model.outline
    shifts = np.linspace(0.0, 6e-3, steps)
    rows, places = {}, {}
    for point in GAUGES:
        start = nearest_place(outline, point)
        sign = 1.0 if point in ("K_H", "S_H") else -1.0
        positions = [start._replace(position_m=start.position_m + sign * shift) for shift in shifts]
        rows[point], places[point] = strain_matrix(solution, positions), positions
    wanted = np.array([TABLE_3_MEASUREMENT[case] for case in CASES])
    tables = [_all_conditions([rows[point] for point in LAYOUTS[case]]) for case in CASES]
    one, two, three = tables  # [K, S, U], [L, S, U], [L, R, U]
    best, found = math.inf, (0, 0, 0, 0, 0)
    for l_at, u_at in itertools.product(range(steps), repeat=2):
        # Given L, S and U, case II is fixed; K and R are free for I and III.
        miss_one = np.abs(one[:, :, u_at] - wanted[0])  # [K, S]
        miss_two = np.abs(two[l_at, :, u_at] - wanted[1])  # [S]
        miss_three = np.abs(three[l_at, :, u_at] - wanted[2])  # [R]
        worst = np.maximum(np.maximum(miss_one.min(axis=0), miss_two), miss_three.min())
        s_at = int(worst.argmin())
        if worst[s_at] < best:
            best = float(worst[s_at])
            found = (l_at, int(miss_three.argmin()), int(miss_one[:, s_at].argmin()), s_at, u_at)
    at = tuple(float(1e3 * places[point][index].position_m) for point, index in zip(GAUGES, found, strict=True))
    matrix = np.array([rows[point][index] for point, index in zip(GAUGES, found, strict=True)])
    return Miss(at, case_conditions(matrix), best)


def _all_conditions(rows: list[FloatArray]) -> FloatArray:
    """Condition numbers [i, j, k] of the layouts of row i of the first gauge, j of the second, k of the third."""
    first, second, third = rows
    n = len(first)
    shape = (n, n, n, 3)
    stacked = np.stack(
        [
            np.broadcast_to(first[:, None, None], shape),
            np.broadcast_to(second[None, :, None], shape),
            np.broadcast_to(third[None, None, :], shape),
        ],
        axis=-2,
    )
    singular = np.linalg.svd(stacked, compute_uv=False)
    with np.errstate(divide="ignore"):
        result: FloatArray = singular[..., 0] / singular[..., -1]
    return result


def gauge_length_variants(solution: Solution) -> list[Variant]:
    """Gauges of other lengths, each beginning at its corner; the paper's is 1 mm."""
    found = []
    for length_mm in (0.1, 0.25, 0.5, 1e3 * GAUGE_LENGTH_M, 2.0):
        matrix = strain_matrix(solution, GAUGES, length_mm * 1e-3)
        found.append(Variant(f"gauges of {length_mm:g} mm", case_conditions(matrix)))
    return found
