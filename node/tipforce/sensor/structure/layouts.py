"""The paper's gauge points, cases and calibration: Table 1, the layouts of Table 3, their mirrors, the grooves."""

from collections.abc import Iterable, Sequence
from typing import Any

from tipforce.errors import InputError

POINTS = ("L", "R", "T", "U", "K_H", "S_H", "K_V", "S_V")
"""Gauge points in the order of Table 1: L, R at the outer ends and K_H, S_H at the joint of the horizontal beam; T, U
at the foot and K_V, S_V at the joint of the vertical one. L, T and K lie at negative x."""

VERTICAL_POINTS = frozenset({"T", "U", "K_V", "S_V"})
MIN_GAUGES, MAX_GAUGES = 3, 8

MIRROR = {"L": "R", "R": "L", "T": "U", "U": "T", "K_H": "S_H", "S_H": "K_H", "K_V": "S_V", "S_V": "K_V"}
"""The point on the other side of the y-axis."""

LAYOUTS = {
    "I": ("K_H", "S_H", "U"),
    "II": ("L", "S_H", "U"),
    "III": ("L", "R", "U"),
    "I'": ("S_H", "K_H", "T"),
    "II'": ("R", "K_H", "T"),
    "III'": ("R", "L", "T"),
}
"""Named layouts: the cases of Table 3 (SG1, SG2, SG3 in this order), and with a prime their mirrors."""

CUSTOM_LAYOUT_CODE = 255
CASE_OF_CODE = {1: "I", 2: "II", 3: "III"}
"""Layout code of a calibration -> name; all others have CUSTOM_LAYOUT_CODE."""
CASES = tuple(CASE_OF_CODE.values())
"""The cases of Table 3."""

Layout = str | Sequence[str]
"""A name of LAYOUTS, or the gauge points themselves in the order of the gauges."""


def layout(name_or_points: Layout) -> tuple[str, ...]:
    """Return the gauge points of a layout, SG1 first. Raises InputError unless 3 to 8 different POINTS are named."""
    if isinstance(name_or_points, str):
        if name_or_points not in LAYOUTS:
            raise InputError(
                f"layout {name_or_points!r} is not known: allowed are {', '.join(LAYOUTS)} or a list of points"
            )
        return LAYOUTS[name_or_points]
    points = tuple(name_or_points) if isinstance(name_or_points, Iterable) else (name_or_points,)
    for point in points:
        if point not in POINTS:
            raise InputError(f"gauge point {point!r} is not known: allowed are {', '.join(POINTS)}")
    if not MIN_GAUGES <= len(points) <= MAX_GAUGES:
        raise InputError(f"a layout of {len(points)} gauge points: allowed are {MIN_GAUGES} to {MAX_GAUGES}")
    twice = sorted({point for point in points if points.count(point) > 1})
    if twice:
        raise InputError(f"gauge point {', '.join(twice)} is given more than once: each point is allowed once")
    return points


def layout_code(gauges: str | Sequence[Any]) -> int:
    """Return 1, 2, 3 for the cases I, II, III with SG1 to SG3 in their order, else 255, as with a place along a beam.
    Raises as layout() does."""
    points = layout(gauges) if all(isinstance(gauge, str) for gauge in gauges) else ()
    return next((code for code, case in CASE_OF_CODE.items() if LAYOUTS[case] == points), CUSTOM_LAYOUT_CODE)


_X_GROOVES_DEG = (5.0, 15.0, 30.0, 45.0, 60.0, 120.0, 135.0, 150.0, 165.0, 175.0)
_Y_GROOVES_DEG = (30.0, 45.0, 60.0, 75.0, 90.0, 105.0, 120.0, 135.0, 150.0)
GROOVES_DEG = (
    *((0.0 if theta < 90.0 else 180.0, theta) for theta in _X_GROOVES_DEG),
    *((90.0, theta) for theta in _Y_GROOVES_DEG),
)
"""Section 4.1: (phi, theta) of the 10 grooves along x and the 9 along y. The paper does not state their sense; a rope
can only pull away from the tip: along x to +x (phi = 0) below theta = 90 degrees, else to -x (180), along y up."""
CALIBRATION_WEIGHT_NEWTONS = 4.4
GAUGE_LENGTH_M = 1e-3
