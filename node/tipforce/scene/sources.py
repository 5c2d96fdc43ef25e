"""Simulated gauges of one finger: structure, load history, dynamics, front end, each only if the scene names it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tipforce.errors import InputError
from tipforce.scene import schema
from tipforce.scene.loads import LoadHistory, Triple
from tipforce.sensor.structure.layouts import layout
from tipforce.sources.simulated import SimulatedSource

if TYPE_CHECKING:
    from tipforce.sources.front_end import FrontEnd


class Clock:
    """Start of the scene in the node's microseconds. Simulated time begins at 0."""

    __slots__ = ("start_us",)

    def __init__(self) -> None:
        self.start_us = 0


def source_of(
    scene: schema.Scene, group: schema.Nodes, node_id: int, load: LoadHistory | None, clock: Clock, built: list[str]
) -> SimulatedSource:
    """Return the gauge source of one node. Raises InputError for a front end that is not allowed."""
    options: dict[str, Any] = {}
    seed = 256 * scene.seed + 2 * node_id
    if group.offset_microstrain:
        options["offset_microstrain"] = group.offset_microstrain
    if scene.noise is not None and scene.noise.gauge_microstrain is not None:
        built.append("noise")
        options |= {"noise_microstrain": scene.noise.gauge_microstrain, "seed": seed}
    front_end = _front_end(scene, seed + 1, built)
    if front_end is not None:
        options["front_end"] = front_end
    if load is None:
        return SimulatedSource([(0.0, 0.0, 0.0)] * len(layout(group.layout)), **options)
    from tipforce.sensor.structure.geometry import FABRICATED
    from tipforce.sensor.structure.strain import strain_matrix

    built.append("structure")
    if not load.constant or scene.dynamics is not None:
        built.append("load history")
        options["forces"] = _forces(scene, load, clock, built)
    source = SimulatedSource(strain_matrix(FABRICATED, group.layout).tolist(), **options)
    if load.constant:
        source.load = load.at(0.0)
    return source


def _forces(scene: schema.Scene, load: LoadHistory, clock: Clock, built: list[str]) -> Callable[[int], Triple]:
    """Return the load on the gauges at a time: the load itself, or with [dynamics] the elastic force of the tip."""
    if scene.dynamics is None:
        return lambda now_us: load.force(1e-6 * (now_us - clock.start_us))
    from tipforce.scene.motion import Motion

    built.append("dynamics")
    return Motion(scene.dynamics, load, clock)


def _front_end(scene: schema.Scene, seed: int, built: list[str]) -> FrontEnd | None:
    given, noise = scene.front_end, scene.noise
    pink = None if noise is None else noise.one_over_f_microstrain
    if given is None and pink is None:
        return None
    from tipforce.sources.front_end import Bridge, FrontEnd

    built.append("front end")
    options: dict[str, Any] = {"one_over_f": pink, "seed": seed}
    if pink is not None:
        built.append("1/f noise")
    try:
        if given is not None:
            options |= {
                "bits": given.bits,
                "gain": given.gain,
                "reference_volts": given.reference_volts,
                "temperature": given.temperature_degC,
                "apparent_strain": given.apparent_microstrain_per_degC,
                "gain_drift_ppm": given.gain_drift_ppm_per_degC,
            }
            if given.bridge is not None:
                options["bridge"] = Bridge(given.bridge, given.gauge_factor, given.excitation_volts)
            if given.temperature_degC is not None:
                built.append("temperature")
        return FrontEnd(**options)
    except ValueError as error:
        raise InputError(f"[front_end] {error}") from None
