"""Simulated calibrations for the tests of the fit."""

from dataclasses import replace

import numpy as np

from tipforce.arrays import IntArray
from tipforce.sensor import Readings, layout
from tipforce.sensor.calibration.simulation import Faults, Simulated, simulate

CLEAN = Faults(drift_strain=0.0, groove_scatter_rad=0.0, hang_scatter_rad=0.0, outlier_share=0.0, saturation=None)


def readings(sim: Simulated, **changes: object) -> Readings:
    given = Readings(sim.strain, sim.P_newtons, sim.phi_rad, sim.theta_rad, sim.t_s)
    return replace(given, **changes)  # type: ignore[arg-type]


def simulated(seed: int, faults: Faults = CLEAN, gauges: tuple[str, ...] = layout("I")) -> Simulated:
    return simulate(gauges, np.random.default_rng(seed), faults)


def some(sim: Simulated, rows: IntArray | list[int]) -> Readings:
    return Readings(sim.strain[rows], sim.P_newtons[rows], sim.phi_rad[rows], sim.theta_rad[rows])
