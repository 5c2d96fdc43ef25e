"""Dynamic error of the gauges: the elastic force compared with the applied one, by frequency and after a step."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.dynamics.model import Modes

ComplexArray = npt.NDArray[np.complex128]


def quasi_static_error(modes: Modes, frequency_hz: npt.ArrayLike) -> FloatArray:
    """Return the largest error of the elastic force relative to a sinusoidal load, (...).

    Largest over all directions of F: a 2-norm.
    """
    ratio = np.asarray(frequency_hz, dtype=np.float64)[..., np.newaxis] / modes.frequency_hz
    # gain - 1 without the difference of two numbers near 1.
    squared = ratio * ratio - 2j * modes.damping_ratio * ratio
    gain = squared / (1.0 - squared)
    error = (modes.force_shape * gain[..., np.newaxis, :]) @ modes.load_shape
    found: FloatArray = np.linalg.norm(error, ord=2, axis=(-2, -1))
    return found


def frequency_of_error(modes: Modes, error: float) -> float:
    """Return the lowest frequency in Hz at which quasi_static_error() reaches ``error``, by bisection.

    Raises InputError unless 0 < error <= 0.5: a larger one is near resonance.
    """
    if not 0.0 < error <= 0.5:
        raise InputError(f"error = {error!r}: allowed is above 0, at most 0.5")
    low, high = 0.0, 0.9 * float(modes.frequency_hz[0])
    while float(quasi_static_error(modes, high)) < error:
        high = 0.5 * (high + float(modes.frequency_hz[0]))
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (middle, high) if float(quasi_static_error(modes, middle)) < error else (low, middle)
    return high
