"""Dynamics of the tip on its beams for one finger: from the load's history to the force at the gauges."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, cast

from tipforce.scene import schema
from tipforce.sensor.dynamics.first_order_hold import node_coefficients
from tipforce.sensor.dynamics.model import modes
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sources.dynamic_forces import DynamicForces
from tipforce.sources.dynamic_load import DynamicLoad

if TYPE_CHECKING:
    from tipforce.scene.loads import LoadHistory, Triple
    from tipforce.scene.sources import Clock
    from tipforce.sources.dynamic_load import Coefficients


class Motion:
    """The elastic force (F1, F2, F3) at the time of a conversion; the tip starts in equilibrium under its load.

    Steps of ``step_us`` from the start; a conversion between two steps gets the force of the earlier one.
    """

    def __init__(self, dynamics: schema.Dynamics, load: LoadHistory, clock: Clock) -> None:
        coefficients = _coefficients(dynamics.damping_ratio, dynamics.step_us)
        self._forces = DynamicForces(DynamicLoad(coefficients), self._applied, dynamics.step_us)
        self._load = load
        self._clock = clock
        self._begun = False

    def _applied(self, now_us: int) -> Triple:
        return self._load.force(1e-6 * (now_us - self._clock.start_us))

    def __call__(self, now_us: int) -> Triple:
        """Return F1, F2, F3 in newtons."""
        if not self._begun:
            self._begun = True
            self._forces(self._clock.start_us)
        return self._forces(now_us)


@lru_cache(maxsize=8)
def _coefficients(damping_ratio: float, step_us: int) -> Coefficients:
    """Return the coefficients, cached because the fingers of one scene are identical."""
    return cast("Coefficients", node_coefficients(modes(FABRICATED, damping_ratio), 1e-6 * step_us))
