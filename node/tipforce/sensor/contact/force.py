"""Force vector F = (F1, F2, F3) from a load on the tip, and from the strain of the gauges."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, floats
from tipforce.errors import InputError


def force_vector(P_newtons: npt.ArrayLike, phi_rad: npt.ArrayLike, theta_rad: npt.ArrayLike) -> FloatArray:
    """Return F = (P sin(phi), P sin(phi - theta), P cos(phi)) in newtons, shape (..., 3): equation (16).

    The three arguments broadcast against each other to the shape (...). phi is the direction of the force on
    the tip, theta the angle of the contact on it, both from the x-axis. Raises InputError where the shapes do
    not broadcast.
    """
    P, phi, theta = floats("P", P_newtons), floats("phi", phi_rad), floats("theta", theta_rad)
    try:
        P, phi, theta = np.broadcast_arrays(P, phi, theta)
    except ValueError:
        raise InputError(
            f"P {P.shape}, phi {phi.shape}, theta {theta.shape}: allowed are shapes that broadcast together"
        ) from None
    F: FloatArray = np.stack((P * np.sin(phi), P * np.sin(phi - theta), P * np.cos(phi)), axis=-1)
    return F


def force_from_strain(
    C: npt.ArrayLike,
    strain: npt.ArrayLike,
    offset_strain: npt.ArrayLike = 0.0,
    tare_newtons: npt.ArrayLike = 0.0,
) -> FloatArray:
    """Return F = C (strain - offset) - tare in newtons, shape (..., 3): equation (1) with offset and tare.

    C: (3, n), newtons per unit strain. strain: (..., n). offset_strain: (n,) or a scalar. tare_newtons: (3,)
    or a scalar. NaN or infinity in a strain makes that row NaN or infinite, no other. Raises InputError where
    the shapes do not fit.
    """
    matrix, V = floats("C", C), floats("strain", strain)
    offset, tare = floats("offset_strain", offset_strain), floats("tare", tare_newtons)
    if matrix.ndim != 2 or matrix.shape[0] != 3:
        raise InputError(f"C has the shape {matrix.shape}: allowed is (3, n), n gauges")
    n = matrix.shape[1]
    if V.ndim < 1 or V.shape[-1] != n:
        raise InputError(f"strain has the shape {V.shape}: allowed is (..., {n}), as C has {n} columns")
    if offset.shape not in {(), (n,)}:
        raise InputError(f"offset_strain has the shape {offset.shape}: allowed is ({n},) or a scalar")
    if tare.shape not in {(), (3,)}:
        raise InputError(f"tare_newtons has the shape {tare.shape}: allowed is (3,) or a scalar")
    with np.errstate(invalid="ignore", over="ignore"):
        F: FloatArray = (V - offset) @ matrix.T - tare
    return F
