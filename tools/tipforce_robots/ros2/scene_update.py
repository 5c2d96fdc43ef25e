"""Draw fingertips for Foxglove's 3D panel: the outline and the force as an arrow, ``foxglove.SceneUpdate`` in JSON.

All fingertips are side by side in one frame, FRAME_ID, because a recording of CAN does not say where they are mounted.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import msgspec

from tipforce.samples import reasons
from tipforce.sensor.structure.geometry import FABRICATED, Geometry
from tipforce_robots.ros2.cdr import stamp

SCHEMA_NAME, FRAME_ID = "foxglove.SceneUpdate", "tipforce"
METRES_PER_NEWTON = 0.005
_SPACING_M = 0.06
_ARC_POINTS = 33
_GREY, _FORCE = {"r": 0.4, "g": 0.45, "b": 0.5, "a": 1.0}, {"r": 0.85, "g": 0.2, "b": 0.1, "a": 1.0}
_HERE = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}

_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _array(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_POINT = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_COLOR = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_POSE = _object(position=_POINT, orientation=_object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER))
_LINE = _object(
    type={"type": "integer"}, pose=_POSE, thickness=_NUMBER, scale_invariant={"type": "boolean"},
    points=_array(_POINT), color=_COLOR,
)  # fmt: skip
_ARROW = _object(
    pose=_POSE, shaft_length=_NUMBER, shaft_diameter=_NUMBER, head_length=_NUMBER, head_diameter=_NUMBER, color=_COLOR
)
_LABEL = _object(
    pose=_POSE, billboard={"type": "boolean"}, font_size=_NUMBER, scale_invariant={"type": "boolean"}, color=_COLOR,
    text=_TEXT,
)  # fmt: skip
_TIME = _object(sec={"type": "integer"}, nsec={"type": "integer"})
_ENTITY = _object(
    timestamp=_TIME, frame_id=_TEXT, id=_TEXT, lifetime=_TIME, frame_locked={"type": "boolean"},
    lines=_array(_LINE), arrows=_array(_ARROW), texts=_array(_LABEL),
)  # fmt: skip
SCHEMA = json.dumps({"title": SCHEMA_NAME, **_object(entities=_array(_ENTITY))}).encode()
"""The fields of foxglove.SceneUpdate that are used."""


def scene_update(t_ns: int, tips: Mapping[str, tuple[tuple[float, float, float], int]]) -> bytes:
    """Return one message: of each fingertip by name P in newtons, phi and theta in degrees, and the status."""
    entities = [_entity(t_ns, number, name, *tip, FABRICATED) for number, (name, tip) in enumerate(tips.items())]
    return msgspec.json.encode({"entities": entities})


def _entity(
    t_ns: int, number: int, name: str, contact: tuple[float, float, float], status: int, geometry: Geometry
) -> dict[str, Any]:
    x_m = number * _SPACING_M
    time = stamp(t_ns)
    known = all(map(math.isfinite, contact))
    return {
        "timestamp": {"sec": time["sec"], "nsec": time["nanosec"]}, "frame_id": FRAME_ID, "id": name,
        "lifetime": {"sec": 0, "nsec": 0}, "frame_locked": False,
        "lines": [{
            "type": 0, "pose": _pose(x_m, 0.0), "thickness": 0.0006, "scale_invariant": False,
            "points": _outline(geometry), "color": _GREY,
        }],
        "arrows": [_arrow(x_m, contact, geometry.r_m)] if known and contact[0] > 0.0 else [],
        "texts": [{
            "pose": _pose(x_m, -geometry.d_m - 0.008), "billboard": True, "font_size": 0.005, "scale_invariant": False,
            "color": _GREY, "text": f"{name}: {_said(contact, status)}",
        }],
    }  # fmt: skip


def _said(contact: tuple[float, float, float], status: int) -> str:
    if math.isnan(contact[0]):
        return ", ".join(reasons.why_no_force(status)) or reasons.UNKNOWN_TO_THE_NODE
    text = f"{contact[0]:.2f} N"
    return text if all(map(math.isfinite, contact)) else f"{text}, {reasons.why_no_angle(status) or 'no angle'}"


def _arrow(x_m: float, contact: tuple[float, float, float], radius_m: float) -> dict[str, Any]:
    """Return the force at its place: a push ends there, a pull begins there."""
    P, phi, theta = contact[0], *map(math.radians, contact[1:])
    length_m = METRES_PER_NEWTON * P
    back_m = length_m if math.cos(phi - theta) < 0.0 else 0.0
    x = radius_m * math.cos(theta) - back_m * math.cos(phi)
    y = radius_m * math.sin(theta) - back_m * math.sin(phi)
    head_m = min(0.004, 0.5 * length_m)
    return {
        "pose": _pose(x_m + x, y, phi), "shaft_length": length_m - head_m, "shaft_diameter": 0.0012,
        "head_length": head_m, "head_diameter": 0.003, "color": _FORCE,
    }  # fmt: skip


def _pose(x_m: float, y_m: float, turn_rad: float = 0.0) -> dict[str, Any]:
    half = 0.5 * turn_rad
    orientation = {**_HERE, "z": math.sin(half), "w": math.cos(half)}
    return {"position": {"x": x_m, "y": y_m, "z": 0.0}, "orientation": orientation}


@lru_cache(maxsize=4)
def _outline(geometry: Geometry) -> list[dict[str, float]]:
    """Return the half circle of the tip, the horizontal beam below it, and the vertical beam, in one line."""
    angles = [math.pi * k / (_ARC_POINTS - 1) for k in range(_ARC_POINTS)]
    arc = [(geometry.r_m * math.cos(angle), geometry.r_m * math.sin(angle)) for angle in angles]
    line = [*arc, (geometry.r_m, 0.0), (0.0, 0.0), (0.0, -geometry.d_m)]
    return [{"x": x, "y": y, "z": 0.0} for x, y in line]
