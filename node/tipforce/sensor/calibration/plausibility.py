"""Units and order of a calibration's data: the size of the response beside beam theory, angles, gauges swapped."""

from __future__ import annotations

import numpy as np

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.calibration.data import Readings

STANDARD_GRAVITY = 9.80665
LIKE, UNLIKE = 0.95, 0.8
"""Cosine of the angle between rows of A, as measured and by theory: the same gauge, and another one."""
_SUSPECTS = {
    1e-6: "strain in SI units where microstrain is meant (multiply SG1.. by 1e6)",
    1e6: "microstrain given twice (multiply SG1.. by 1e-6)",
    1e-3: "strain in millistrain, or loads in millinewtons (a factor of 1000)",
    1e3: "strain in nanostrain, or loads in kilonewtons (a factor of 1000)",
    STANDARD_GRAVITY / 1000.0: "loads in grams (multiply P_N by 0.00980665)",
    STANDARD_GRAVITY: "loads in kilograms (multiply P_N by 9.80665)",
}
"""Response over theory -> what gives it."""


def require_degrees(readings: Readings) -> None:
    """Raise InputError where all directions of loads fit into a turn in radians: they were meant as degrees."""
    loaded = np.asarray(readings.P_newtons) > 0.0
    phi, theta = (np.degrees(np.asarray(values)[loaded]) for values in (readings.phi_rad, readings.theta_rad))
    if (np.abs(phi) <= 2.0 * np.pi).all() and (np.abs(theta) <= 2.0 * np.pi).all() and len(np.unique(theta)) > 2:
        raise InputError(
            f"theta_deg runs from {theta.min():.4g} to {theta.max():.4g}, phi_deg as little: those look like radians; "
            "allowed are degrees (multiply phi_deg and theta_deg by 57.29578)"
        )


def require_size(A: FloatArray, theory: FloatArray, allowed: float, whose: str) -> None:
    """Raise InputError where the response to a newton is not as large as theory says, with the factor it suspects.

    A, theory: (n, 3), strain per newton. allowed: factor to either side.
    """
    size = np.linalg.norm(A, axis=1) / np.linalg.norm(theory, axis=1)
    ratio = float(np.exp(np.median(np.log(size))))
    if 1.0 / allowed <= ratio <= allowed:
        return
    factor = min(_SUSPECTS, key=lambda one: abs(np.log(one / ratio)))
    near = abs(np.log(factor / ratio)) < np.log(3.0)
    words = _SUSPECTS[factor] if near else "another unit of strain or load, or another gauge factor"
    raise InputError(
        f"the gauges respond {ratio:.3g} times as much as beam theory says for {whose} (allowed {1.0 / allowed:.2g} to "
        f"{allowed:g}): suspected is {words}; for another structure give --layout FILE with its dimensions"
    )


def require_order(A: FloatArray, theory: FloatArray, layout: str) -> None:
    """Raise InputError where two gauges respond as theory says of each other, and not as it says of themselves."""
    unit = [rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (A, theory)]
    like = np.abs(unit[0] @ unit[1].T)
    for i in range(len(A)):
        for k in range(i + 1, len(A)):
            if min(like[i, k], like[k, i]) > LIKE and max(like[i, i], like[k, k]) < UNLIKE:
                raise InputError(
                    f"SG{i + 1} and SG{k + 1} look swapped: each responds as beam theory says of the other in {layout} "
                    f"(cosine {like[i, k]:.2f} and {like[k, i]:.2f}, of its own place {like[i, i]:.2f} and "
                    f"{like[k, k]:.2f}): exchange their columns, or give --layout in the order of the columns"
                )
