"""Names of numpy's array types; shapes and units are in the docstrings that use them."""

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


def floats(name: str, values: npt.ArrayLike) -> FloatArray:
    """Return values as an array of float64. Raises InputError naming ``name`` if they are no array of real numbers."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {values!r} is no array of numbers") from None
