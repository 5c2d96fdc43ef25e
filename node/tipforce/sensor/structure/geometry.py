"""Dimensions of the fingertip body: two thin beams in a T, a rigid half-cylinder tip, a rigid fixture."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from tipforce.errors import InputError

THIN_BEAM_RATIO = math.sqrt(8.0 / 3.0)
"""h2 / h1 that makes the largest stresses of both beams equal for a = d = r (section 3.1: 1.633)."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """One fingertip body, with the symbols of figure 2: the horizontal beam spans 2 a between its ends, which carry the
    tip; the vertical one joins its middle to the fixture. Raises InputError, naming the field."""

    a_m: float
    """Half the length of the horizontal beam: from the joint to one outer end."""
    d_m: float
    """Length of the vertical beam."""
    r_m: float
    """Radius of the tip, whose centre is the middle of the horizontal beam."""
    h1_m: float
    """Thickness of the horizontal beam."""
    h2_m: float
    """Thickness of the vertical beam."""
    width_m: float
    """Width of both beams, normal to the plane of the forces."""
    youngs_modulus_pascals: float

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_positive(field.name, getattr(self, field.name))

    def thin(self, h1_m: float) -> Geometry:
        """Return the same body with h1_m and h2 = sqrt(8/3) h1 (section 3.1); h1_m -> 0 is the thin limit."""
        _check_positive("h1_m", h1_m)
        return replace(self, h1_m=h1_m, h2_m=THIN_BEAM_RATIO * h1_m)


def _check_positive(name: str, value: object) -> None:
    if isinstance(value, (int, float)) and not isinstance(value, bool) and 0.0 < value < math.inf:
        return
    raise InputError(f"geometry {name} = {value!r}: allowed is a positive finite number in SI units")


FABRICATED = Geometry(
    a_m=15e-3, d_m=15e-3, r_m=15e-3, h1_m=0.4e-3, h2_m=0.653e-3, width_m=10e-3, youngs_modulus_pascals=205e9
)
"""The body of section 4.2 (its "b" is d); Young's modulus is assumed, for steel AISI 4340."""
