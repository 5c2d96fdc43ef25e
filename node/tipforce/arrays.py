"""Names of numpy's array types; shapes and units are in the docstrings that use them."""

import numbers
import operator
from contextlib import suppress
from decimal import Decimal
from typing import Any

import numpy as np
import numpy.typing as npt

from canopen_device.visible_text import shortened
from tipforce.errors import InputError

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


def occurring(small: npt.NDArray[np.unsignedinteger[Any]]) -> list[int]:
    """Return the different ones of small numbers (k,), ascending: faster than np.unique, which imports numpy.ma."""
    if not small.any():  # one channel is the usual case
        return [0] if len(small) else []
    numbers_found: list[int] = np.flatnonzero(np.bincount(small)).tolist()
    return numbers_found


def floats(name: str, values: npt.ArrayLike) -> FloatArray:
    """Return values as an array of float64; NaN and infinity stay. Raises InputError naming ``name`` for text, complex
    numbers, truth values, rows of different lengths, and masked entries, whose values do not count."""
    try:
        given = np.ma.asarray(values) if isinstance(values, list | tuple | np.ma.MaskedArray) else np.asarray(values)
        real, truth = numbers.Real | Decimal, bool | np.bool_
        objects = given.flat if given.dtype.kind == "O" else [None]  # Decimal, Fraction
        if given.dtype.kind not in "iuf" and not all(isinstance(x, real) and not isinstance(x, truth) for x in objects):
            raise TypeError
        if np.ma.is_masked(given):
            count = np.count_nonzero(np.ma.getmaskarray(given))
            raise InputError(f"{name}: {count} masked entries: allowed are numbers, NaN for unknown")
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name}: {shortened(' '.join(repr(values).split()))} is no array of numbers") from None


def real(value: object) -> float:
    """Return a number of any real type; NaN for what is none."""
    return float(value) if isinstance(value, numbers.Real) else float("nan")


def whole(name: str, value: object, within: range | None = None) -> int:
    """Return an integer of any type. Raises InputError naming ``name`` for what is none, or not ``within``."""
    with suppress(TypeError):  # of what is no integer
        if within is None or operator.index(value) in within:  # type: ignore[arg-type]
            return operator.index(value)  # type: ignore[arg-type]
    raise InputError(f"{name} {value!r}: allowed are {f'{within[0]} to {within[-1]}' if within else 'integers'}")
