"""One observation of n fingers: values, uncertainties and a validity mask, (n, 3) each, for P, phi and theta.

``values`` and ``uncertainties`` are float32, P in newtons and the angles in radians; ``valid`` is int8, 1 or 0. A value
that is unknown, or beyond the bounds of the space, is 0 with ``valid`` 0 and the largest uncertainty of the space. So
is the uncertainty of a value where it is not known; the value stays valid then.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from tipforce.errors import EnvironmentLackError, InputError
from tipforce.host.decoding.contacts import Contact

if TYPE_CHECKING:
    from gymnasium import spaces

FloatArray = npt.NDArray[np.float64]
Observation = dict[str, npt.NDArray[np.float32] | npt.NDArray[np.int8]]
"""``values``, ``uncertainties`` and ``valid``."""

LARGEST = np.array([32.767, pi, pi], dtype=np.float32)
"""Of P, as INTEGER16 in mN on the bus, and of the angles; of their uncertainties as well."""
_LEAST = np.array([0.0, -pi, -pi], dtype=np.float32)


class HasContact(Protocol):
    """A sample of a simulation: ``tipforce.mujoco.TwinSample``."""

    @property
    def contact(self) -> Contact:
        """The sample as the host has it."""


def observation_space(fingers: int) -> spaces.Dict:
    """Return the space of ``observation`` for this number of fingers.

    Raises InputError for a number below 1, EnvironmentLackError where gymnasium is not installed.
    """
    try:
        from gymnasium import spaces
    except ImportError:
        raise EnvironmentLackError('gymnasium is not installed: pip install "tipforce[gymnasium]"') from None
    if fingers < 1:
        raise InputError(f"fingers = {fingers}: allowed is 1 or more")
    largest = np.tile(LARGEST, (fingers, 1))
    return spaces.Dict(
        {
            "values": spaces.Box(np.tile(_LEAST, (fingers, 1)), largest),
            "uncertainties": spaces.Box(np.zeros_like(largest), largest),
            "valid": spaces.MultiBinary((fingers, 3)),
        }
    )


def observation(row: Mapping[str, Contact] | Mapping[str, HasContact]) -> Observation:
    """Return one row of fingers, in its order: a ``HandRow``, or what ``Fingertips.read`` returned."""
    found = [one if isinstance(one, Contact) else one.contact for one in row.values()]
    values = [(one.P_newtons, one.phi_deg, one.theta_deg) for one in found]
    uncertainties = [(one.u_P_newtons, one.u_phi_deg, one.u_theta_deg) for one in found]
    return masked(np.array(values), np.array(uncertainties))


def masked(values: FloatArray, uncertainties: FloatArray) -> Observation:
    """Return the observation of values and uncertainties (..., 3), P in newtons and angles in degrees, NaN unknown."""
    found, u = values.astype(np.float32), uncertainties.astype(np.float32)
    for array in (found, u):
        array[..., 1:] *= np.float32(pi / 180.0)
    with np.errstate(invalid="ignore"):
        valid = (found >= _LEAST) & (found <= LARGEST)
        known = valid & (u >= 0.0) & (u <= LARGEST)
    found[~valid] = 0.0
    return {"values": found, "uncertainties": np.where(known, u, LARGEST), "valid": valid.astype(np.int8)}
