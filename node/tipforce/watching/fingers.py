"""Watched fingers: identity, calibration, and where the gauges are."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from tipforce.host.configuration.calibration import Calibration
from tipforce.host.hand.file import HandFile
from tipforce.sensor.structure.gauges import Gauge
from tipforce.sensor.structure.geometry import FABRICATED, Geometry
from tipforce.sensor.structure.layouts import CASE_OF_CODE, LAYOUTS

Fallback = tuple[str, Geometry, tuple[Gauge, ...]]
"""Name, geometry and gauges of a layout."""
FingerMaker = Callable[[int], "Finger | None"]
"""The finger of a node-id found on a bus; None hides it."""


@dataclass(frozen=True, slots=True)
class Finger:
    """One fingertip. ``gauges`` is empty if their positions are unknown."""

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


def with_layout(finger: Finger, layout: str, fallback: Fallback | None) -> Finger:
    """Return the finger with its gauges: from ``layout``, else from its calibration, else from ``fallback``."""
    if not layout and finger.calibration is not None:
        layout = CASE_OF_CODE.get(finger.calibration.layout_code, "")
    if layout:
        return replace(finger, layout=layout, gauges=LAYOUTS[layout])
    if fallback is not None:
        return replace(finger, layout=fallback[0], geometry=fallback[1], gauges=fallback[2])
    return finger


def hand_fingers(file: HandFile, fallback: Fallback | None = None) -> tuple[Finger, ...]:
    """Return the fingers of a hand file, with calibrations and gauge positions. Raises InputError."""
    return tuple(
        with_layout(Finger(plan.node_id, plan.name, file.calibration(plan)), plan.layout, fallback)
        for plan in file.finger
    )


def finger_maker(node_ids: Collection[int] | None = None, fallback: Fallback | None = None) -> FingerMaker:
    """Return what makes the fingers; those that are not in ``node_ids`` are hidden."""

    def make(node_id: int) -> Finger | None:
        return with_layout(Finger(node_id), "", fallback) if node_ids is None or node_id in node_ids else None

    return make
