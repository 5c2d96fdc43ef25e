"""The outline of the fingertip body for the finite-element mesh; the paper does not state that of its figure 2.

x to the right, y away from the fixture, the origin in the middle of the horizontal beam, symmetric about x = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.structure.geometry import FABRICATED, Geometry

NEAR_M = 1e-3
"""Length of the blocks next to a corner of a beam: that of a gauge, so that gauges end on nodes of the mesh."""
_MAY_BE_ZERO = ("leg_below_m", "fixture_depth_m", "fillet_m", "slit_fillet_m")


class Corner(NamedTuple):
    """A re-entrant corner: 270 degrees of material, or a fillet that fills it."""

    x_m: float
    y_m: float
    free_x: float
    """Sign of x - x_m in the empty quadrant."""
    free_y: float
    radius_m: float
    """0: sharp."""
    depth_x_m: float
    """Depth into the material, along x, of the mesh deformation for a fillet."""
    depth_y_m: float


class Rectangle(NamedTuple):
    """A rectangular part of the body; the tip, bounded by an arc above, is not one."""

    left_m: float
    right_m: float
    lower_m: float
    upper_m: float


@dataclass(frozen=True, slots=True)
class Outline:
    """The body's cross-section. Raises InputError, naming the field, for a body that cannot be built or meshed.

    The two beams are those of ``geometry``. A slit of constant width separates the horizontal beam from the tip; at
    its ends legs of the tip hold the beam. The lower face of the beam continues under the legs unless leg_below_m is
    given. The tip is bounded by an arc around the origin above vertical sides.
    """

    geometry: Geometry = FABRICATED
    slit_m: float = 0.25e-3
    """The width of the cutting line, section 4.2."""
    leg_m: float = 2e-3
    """Thickness of a leg, outside of a. The paper states only that "r should be slightly larger than a"."""
    leg_below_m: float = 0.0
    """Extent of a leg below the beam's lower face: 0, or more than the 1 mm next to the corner."""
    tip_side_m: float = 2e-3
    """Height of the tip's straight sides above the slit; the arc begins there."""
    fixture_half_width_m: float = 9e-3
    fixture_depth_m: float = 4e-3
    """Height of the block below the vertical beam's foot; its lower face is clamped. 0: the foot itself is clamped."""
    fillet_m: float = 0.0
    """Radius at the joint and at the foot. Where a leg reaches below the beam the corner stays sharp."""
    slit_fillet_m: float = 0.0
    """Radius in the four corners of the slit's ends, at most half of its width."""

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.name != "geometry":
                value, may_be_zero = getattr(self, field.name), field.name in _MAY_BE_ZERO
                good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
                allowed = "0 or more, finite" if may_be_zero else "a positive finite number in metres"
                self._check(field.name, good and (value > 0.0 or (may_be_zero and value == 0.0)), allowed)
        g = self.geometry
        near = NEAR_M + self.fillet_m
        self._check("slit_fillet_m", self.slit_fillet_m <= 0.5 * self.slit_m, "at most half of slit_m")
        self._check("fillet_m", self.fillet_m < 0.5 * (g.d_m - 2.0 * NEAR_M), "fillets that leave the beam a middle")
        room = g.a_m - 0.5 * g.h2_m - NEAR_M - near - self.slit_fillet_m
        if room <= 0.0 or g.d_m - 2.0 * near <= 0.0:
            raise InputError(
                f"outline of a_m = {g.a_m!r}, d_m = {g.d_m!r}: allowed are beams longer than the 1 mm at both ends "
                "with their fillets"
            )
        lowest, highest = 0.5 * g.h2_m + near, g.a_m - NEAR_M - self.slit_fillet_m
        fits = lowest < self.fixture_half_width_m < highest
        self._check("fixture_half_width_m", fits, f"above {lowest!r} and below {highest!r}")
        fits, highest = self.leg_below_m == 0.0 or near < self.leg_below_m < g.d_m - near, g.d_m - near
        self._check("leg_below_m", fits, f"0, or above {near!r} and below {highest!r}")

    def _check(self, name: str, good: bool, allowed: str) -> None:
        if not good:
            raise InputError(f"outline {name} = {getattr(self, name)!r}: allowed is {allowed}")

    @property
    def foot_m(self) -> float:
        """y of the vertical beam's lower end."""
        return -0.5 * self.geometry.h1_m - self.geometry.d_m

    @property
    def tip_bottom_m(self) -> float:
        """y of the tip's flat side, above the slit."""
        return 0.5 * self.geometry.h1_m + self.slit_m

    @property
    def half_width_m(self) -> float:
        """x of the legs' and the tip's outer sides."""
        return self.geometry.a_m + self.leg_m

    @property
    def tip_radius_m(self) -> float:
        """Radius of the arc, around the origin: slightly larger than a."""
        return math.hypot(self.half_width_m, self.tip_bottom_m + self.tip_side_m)

    def tip_top_m(self, x_m: npt.ArrayLike) -> FloatArray:
        """Return y of the arc at x, |x| <= half_width_m."""
        result: FloatArray = np.sqrt(self.tip_radius_m**2 - np.asarray(x_m, dtype=np.float64) ** 2)
        return result

    def rectangles(self) -> list[Rectangle]:
        """Return the body without the tip and without fillets: parts that touch but do not overlap."""
        g, foot, outer = self.geometry, self.foot_m, self.half_width_m
        half_h1, half_h2 = 0.5 * g.h1_m, 0.5 * g.h2_m
        parts = [
            Rectangle(-outer, outer, -half_h1, half_h1),
            Rectangle(-half_h2, half_h2, foot, -half_h1),
            Rectangle(-outer, -g.a_m, half_h1, self.tip_bottom_m),
            Rectangle(g.a_m, outer, half_h1, self.tip_bottom_m),
        ]
        if self.fixture_depth_m > 0.0:
            half_width = self.fixture_half_width_m
            parts.append(Rectangle(-half_width, half_width, foot - self.fixture_depth_m, foot))
        if self.leg_below_m > 0.0:
            low = -half_h1 - self.leg_below_m
            parts += [Rectangle(-outer, -g.a_m, low, -half_h1), Rectangle(g.a_m, outer, low, -half_h1)]
        return parts

    def corners(self) -> dict[str, Corner]:
        """Return the re-entrant corners by name: K, S at the joint, T, U at the foot, slit, and L, R below."""
        g, fillet, slit = self.geometry, self.fillet_m, self.slit_fillet_m
        half_h1, half_h2, leg = 0.5 * g.h1_m, 0.5 * g.h2_m, self.leg_m
        by_name = {}
        for sign, joint, foot, outer in ((-1.0, "K", "T", "L"), (1.0, "S", "U", "R")):
            side = "left" if sign < 0.0 else "right"
            # Half of the beam's thickness at most: the fillet of its other face has the other half.
            by_name[joint] = Corner(sign * half_h2, -half_h1, sign, -1.0, fillet, half_h2, g.h1_m)
            if self.fixture_depth_m > 0.0:
                by_name[foot] = Corner(sign * half_h2, self.foot_m, sign, 1.0, fillet, half_h2, self.fixture_depth_m)
            edge = sign * g.a_m
            by_name[f"slit {side} lower"] = Corner(edge, half_h1, -sign, 1.0, slit, leg, half_h1)
            by_name[f"slit {side} upper"] = Corner(edge, self.tip_bottom_m, -sign, -1.0, slit, leg, self.tip_side_m)
            if self.leg_below_m > 0.0:
                by_name[outer] = Corner(edge, -half_h1, -sign, -1.0, 0.0, leg, half_h1)
        return by_name


STATED = Outline()
"""The default outline of documents and reports."""
