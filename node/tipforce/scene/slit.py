"""Detect loads that close the slit between tip and beam: the simulated gauges stay linear, real ones do not."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.scene import schema
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce.sensor.structure.limits import closing_load


def slit_closed(slit: schema.Slit, applied: FloatArray) -> npt.NDArray[np.bool_]:
    """Return whether a static load would close the slit, (k,). applied: (k, 3), P newtons, phi and theta degrees."""
    directions, which = np.unique(applied[:, 1:], axis=0, return_inverse=True)
    limits = [
        closing_load(FABRICATED, math.radians(theta), math.radians(phi), 1e-3 * slit.gap_mm)
        for phi, theta in directions.tolist()
    ]
    closed: npt.NDArray[np.bool_] = applied[:, 0] >= np.array(limits)[which.reshape(-1)]
    return closed
