"""Rows that a fit leaves out: so many, or so gathered, that it is the model that is wrong and not the rows."""

from __future__ import annotations

from math import comb

import numpy as np

from tipforce.arrays import BoolArray
from tipforce.sensor.calibration.data import Readings
from tipforce.sensor.calibration.regressors import grooves
from tipforce.sensor.calibration.result import Fit

LARGEST_SHARE = 0.05
CHANCE = 0.01
"""That rows left out by chance gather as much as these; for all places together."""


def rejections(fit: Fit, readings: Readings) -> list[str]:
    """Return why the rows left out as outliers speak against the model; empty where they do not."""
    m = len(readings.P_newtons)
    out = np.zeros(m, dtype=np.bool_)
    out[list(fit.outliers)] = True
    found = []
    if out.sum() > LARGEST_SHARE * m:
        found.append(
            f"{int(out.sum())} of {m} rows ({100.0 * out.mean():.0f} %) are left out as outliers, over "
            f"{LARGEST_SHARE:.0%}: loads, times or the model (--drift, --angle-scatter, --saturation) are wrong"
        )
    places = _places(readings)
    for words, rows in places:
        here, count = int((out & rows).sum()), int(rows.sum())
        if here >= 3 and _at_least(here, int(out.sum()), count, m) < CHANCE / len(places):
            found.append(
                f"{here} of the {int(out.sum())} rows left out are {words} ({count} of {m} rows): a fault that depends "
                "on it is no outlier"
            )
    return found


def _places(readings: Readings) -> list[tuple[str, BoolArray]]:
    """Where rows may gather: high loads, warm or cold ones, one direction."""
    P = readings.P_newtons
    loaded = P > 0.0
    high = np.median(P[loaded]) < P if (P[loaded] > np.median(P[loaded])).any() else P.max() <= P
    found = [("at high load", np.asarray(high & loaded))]
    T = readings.temperature_degC
    if T is not None and np.ptp(T) > 1.0:
        third = T.min() + np.ptp(T) / 3.0
        found += [("warm", np.asarray(third + np.ptp(T) / 3.0 < T)), ("cold", np.asarray(third > T))]
    groove = grooves(readings.phi_rad, readings.theta_rad)
    for one in np.unique(groove[loaded]):
        rows = loaded & (groove == one)
        first = int(np.argmax(rows))
        phi, theta = np.degrees(readings.phi_rad[first]), np.degrees(readings.theta_rad[first])
        found.append((f"at phi {phi:g}, theta {theta:g} degrees", np.asarray(rows)))
    for phi in np.unique(np.round(readings.phi_rad[loaded], 6)):
        rows = loaded & (np.abs(readings.phi_rad - phi) < 1e-6)
        found.append((f"of loads along phi {np.degrees(phi):g} degrees", np.asarray(rows)))
    return [(words, rows) for words, rows in found if 0 < rows.sum() < 0.7 * len(P)]


def _at_least(here: int, out: int, count: int, m: int) -> float:
    """The chance that of ``out`` rows among m at least ``here`` fall on ``count`` given ones (hypergeometric)."""
    ways = sum(comb(count, k) * comb(m - count, out - k) for k in range(here, min(out, count) + 1))
    return ways / comb(m, out)
