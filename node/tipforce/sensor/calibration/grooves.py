"""The grooves of section 4.1 of the paper, in which a rope pulls at the tip to calibrate it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.sensor.structure.published import X_GROOVES_DEG, Y_GROOVES_DEG


@dataclass(frozen=True, slots=True, eq=False)
class Grooves:
    """Directions in which a rope pulls, one entry per groove."""

    theta_rad: FloatArray
    phi_rad: FloatArray
    along_x: npt.NDArray[np.bool_]


def paper_grooves() -> Grooves:
    """Return the 19 grooves of section 4.1.

    The paper does not state their sense; a rope can only pull away from the tip. So grooves along x pull to +x
    (phi = 0) if theta is below 90 degrees and to -x (phi = 180) above; grooves along y pull up (phi = 90).
    """
    along_x = np.array([True] * len(X_GROOVES_DEG) + [False] * len(Y_GROOVES_DEG))
    theta = np.radians(X_GROOVES_DEG + Y_GROOVES_DEG)
    phi = np.where(along_x, np.where(theta < 0.5 * np.pi, 0.0, np.pi), 0.5 * np.pi)
    return Grooves(theta, phi, along_x)
