"""Every extreme case of the stability report."""

from __future__ import annotations

import importlib

from tipforce_lab.report.stability.case import Case

AREAS = (
    "contact", "uncertainty", "layout", "gauges", "filters", "calibration", "fit", "wire", "clock", "dynamics",
    "integrators", "impact",
)  # fmt: skip
"""Modules of this package, in the order of the report."""


def cases() -> list[Case]:
    """Return all cases by area. The modules of the areas are imported here, not with this file."""
    found: list[Case] = []
    for area in AREAS:
        found += importlib.import_module(f"tipforce_lab.report.stability.{area}").cases()
    return found
