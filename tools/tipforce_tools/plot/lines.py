"""Points of lines that do not cross what is unknown, and of angles that leave at 180 and come back at -180."""

from __future__ import annotations

import numpy as np

from tipforce.arrays import BoolArray, FloatArray

TURN = 360.0


def broken(starts: BoolArray, *columns: FloatArray) -> tuple[FloatArray, ...]:
    """The columns (k,) with a NaN before each point that starts a line."""
    at = np.flatnonzero(starts[1:]) + 1
    return tuple(np.insert(column.astype(np.float64), at, np.nan) for column in columns)


def wrapped(starts: BoolArray, x: FloatArray, mean: FloatArray, *others: FloatArray) -> tuple[FloatArray, ...]:
    """Angles (k,) in degrees that may go on over many turns, as (x, mean, others...) with ``mean`` within -180..180.

    Where a line crosses 180, it is continued beyond it, and begun anew a turn lower from beyond -180: with the axis
    cut at both, it leaves on one side and comes back on the other. ``others`` are shifted as ``mean`` is.
    """
    turn = np.ceil((mean - TURN / 2) / TURN)
    crossing = np.flatnonzero((np.diff(turn) != 0) & ~starts[1:]) + 1  # the point behind each
    shift = TURN * turn

    def inserted(column: FloatArray, shifts: FloatArray | None) -> FloatArray:
        base = column if shifts is None else column - shifts
        beyond = column[crossing] if shifts is None else column[crossing] - shifts[crossing - 1]
        before = column[crossing - 1] if shifts is None else column[crossing - 1] - shifts[crossing]
        three = np.stack((beyond, np.full(len(crossing), np.nan), before), axis=-1).ravel()
        return np.insert(base, np.repeat(crossing, 3), three)

    begins = np.insert(starts, np.repeat(crossing, 3), False)
    columns = [inserted(x, None), *(inserted(column, shift) for column in (mean, *others))]
    return broken(begins, *columns)
