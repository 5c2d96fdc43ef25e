"""The fingers of a page: identity, calibration, and the cross-section for drawing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from tipforce.host.configuration.calibration import Calibration
from tipforce.sensor.structure.gauge_positions import Gauge, gauge_name, place
from tipforce.sensor.structure.gauge_shift import GaugePosition, strain_row
from tipforce.sensor.structure.geometry import FABRICATED, Geometry
from tipforce.sensor.structure.layouts import CASE_OF_CODE, LAYOUTS
from tipforce.sensor.structure.published import GAUGE_LENGTH_M

MM = 1e3


@dataclass(frozen=True, slots=True)
class Finger:
    """One fingertip of the page. ``gauges`` is empty if their positions are unknown."""

    node_id: int
    name: str = ""
    calibration: Calibration | None = None
    geometry: Geometry = FABRICATED
    gauges: tuple[Gauge, ...] = ()
    layout: str = ""

    @property
    def label(self) -> str:
        """Display name: ``thumb`` or ``finger 5``."""
        return self.name or f"finger {self.node_id}"


def with_layout(finger: Finger, layout: str, fallback: tuple[str, Geometry, tuple[Gauge, ...]] | None) -> Finger:
    """Return the finger with its gauges: from ``layout``, else from its calibration, else from ``fallback``."""
    if not layout and finger.calibration is not None:
        layout = CASE_OF_CODE.get(finger.calibration.layout_code, "")
    if layout:
        return replace(finger, layout=layout, gauges=LAYOUTS[layout])
    if fallback is not None:
        return replace(finger, layout=fallback[0], geometry=fallback[1], gauges=fallback[2])
    return finger


def drawing(finger: Finger, gauges: int) -> dict[str, Any]:
    """Return the drawing of a finger: lengths in mm, x to the right, y from the axis of the horizontal beam upwards.

    ``faces`` holds the strain per newton of F1, F2, F3 at both ends of each face of each beam, in microstrain:
    between the ends the strain is linear.
    """
    geometry = finger.geometry
    return {
        "node_id": finger.node_id, "label": finger.label, "layout": finger.layout,
        "calibrated_here": finger.calibration is not None,
        "a": geometry.a_m * MM, "d": geometry.d_m * MM, "r": geometry.r_m * MM,
        "h1": geometry.h1_m * MM, "h2": geometry.h2_m * MM,
        "gauges": [_gauge(geometry, gauge) for gauge in finger.gauges[:gauges]],
        "faces": _faces(geometry),
    }  # fmt: skip


def _gauge(geometry: Geometry, gauge: Gauge) -> dict[str, Any]:
    """Return its name, both ends of its centre line on the beam's surface, and the outward direction."""
    spot = place(geometry, gauge)
    length_m = geometry.a_m if spot.beam == "H" else geometry.d_m
    begin = min(max(spot.position_m - 0.5 * GAUGE_LENGTH_M, 0.0), length_m - GAUGE_LENGTH_M)
    ends = begin * MM, (begin + GAUGE_LENGTH_M) * MM
    sign = -1.0 if spot.side == "left" else 1.0
    half_h1, half_h2 = 0.5 * geometry.h1_m * MM, 0.5 * geometry.h2_m * MM
    if spot.beam == "H":
        up = 1.0 if spot.face == "upper" else -1.0
        # Drawn beside the vertical beam; the beam model measures from its axis.
        shift = half_h2 if begin == 0.0 and up < 0 else 0.0
        (x0, x1), (y0, y1), out = [sign * (shift + s) for s in ends], (up * half_h1, up * half_h1), (0.0, up)
    else:
        (x0, x1), (y0, y1), out = (sign * half_h2, sign * half_h2), [-half_h1 - s for s in ends], (sign, 0.0)
    return {"name": gauge_name(gauge), "beam": spot.beam, "from": [x0, y0], "to": [x1, y1], "out": out}


def largest_strain_per_newton(geometry: Geometry) -> float:
    """Return the largest strain of a face, in microstrain, for 1 N of F1, F2 or F3."""
    return max(float(np.abs(face["microstrain_per_newton"]).max()) for face in _faces(geometry))


@lru_cache(maxsize=16)
def _faces(geometry: Geometry) -> list[dict[str, Any]]:
    found = []
    for beam, side, face in _FACES:
        length_m = geometry.a_m if beam == "H" else geometry.d_m
        ends = [GaugePosition(beam, side, position, face) for position in (0.0, length_m)]
        rows = np.array([strain_row(geometry, *end) for end in ends]) * 1e6
        found.append({"beam": beam, "side": side, "face": face, "microstrain_per_newton": rows.tolist()})
    return found


_FACES: Sequence[tuple[Literal["H", "V"], Literal["left", "right"], Literal["lower", "upper"]]] = (
    ("H", "left", "lower"), ("H", "right", "lower"), ("H", "left", "upper"), ("H", "right", "upper"),
    ("V", "left", "lower"), ("V", "right", "lower"),
)  # fmt: skip
