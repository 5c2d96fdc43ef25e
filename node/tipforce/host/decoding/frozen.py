"""Gauges whose recorded reading stands still, by the rule of the node (fingertip.application)."""

from __future__ import annotations

import numpy as np

from tipforce.arrays import FloatArray, IntArray
from tipforce.fingertip.application import FROZEN_READINGS
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding import judged


def frozen_gauges(calibration: Calibration, strain: FloatArray, weight: FloatArray) -> IntArray:
    """Bits of the gauges that repeat one reading more often than their noise allows, (m,).

    strain: (m, n) in time order, all of a table; weight: (m,), readings that a row averages. The smallest step in the
    table is its resolution: a gauge with less noise may repeat itself. All rows of a run are marked, the first ones
    too, which a node cannot know yet. At an end of the converter a gauge is saturated, not frozen.
    """
    found = np.zeros(len(strain), dtype=np.int64)
    steps = np.abs(np.diff(strain, axis=0))
    moved = steps[steps > 0.0]
    if len(strain) <= FROZEN_READINGS or not moved.size:
        return found
    noise = np.sqrt(np.diagonal(calibration.covariance_strain2) / weight.max())
    noisy = noise >= moved.min() * (1.0 - 1e-6)
    for gauge in np.flatnonzero(noisy).tolist():
        run = np.concatenate(([0], np.cumsum(steps[:, gauge] != 0.0)))
        found |= np.where(np.bincount(run)[run] > FROZEN_READINGS, 1 << gauge, 0)
    return found & ~judged.at_end(1e6 * strain)
