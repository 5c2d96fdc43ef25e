"""The outline of the body (assumed: the paper does not state that of figure 2) and its triangles: a grid of lines
mapped to its shape. x to the right, y away from the fixture, origin in the middle of the horizontal beam. Cells form
rings around a re-entrant corner, ring k of m as far as (k / m)^grading. A mesh of 2 n has the nodes of n."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray
from tipforce.errors import InputError
from tipforce.sensor.structure.strain import FABRICATED, Geometry

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
    """A rectangular part of the body."""

    left_m: float
    right_m: float
    lower_m: float
    upper_m: float


@dataclass(frozen=True, slots=True)
class Outline:
    """The cross-section: a slit of constant width between horizontal beam and tip, whose legs hold the beam; above
    vertical sides an arc around the origin. Raises InputError, naming the field, for a body that cannot be meshed."""

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
        return np.sqrt(self.tip_radius_m**2 - np.asarray(x_m, dtype=np.float64) ** 2)

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

GRADING = 4.0
"""A gauge that ends in a corner is wrong by (size of the smallest cell)^0.5445: the order is 0.5445 times the grading.
5.5 would give 3, the most of P2, but up to 2e5 unknowns its wide outer rings double the error of condition numbers."""
PATCH_M = 0.3e-3
"""Extent of the rings of a corner if no other dimension limits them."""
RINGS = 2
"""Rings of a corner per cell of the other blocks: corners cause most of the error, the rest has most of the cells."""
MOST_CELLS = 32
SMALLEST = 1e-9
"""Smallest cell relative to the extent of its rings: below, coordinates near 15 mm lack digits."""


@dataclass(frozen=True, slots=True)
class Resolution:
    """Resolution of a mesh. Raises InputError for values out of range."""

    cells: int = 4
    """n: the corners have 2 n rings, half a beam's thickness 2 n cells, the middle of a beam 6 n."""
    grading: float = GRADING
    """1: uniform within each block. Above: towards the corners."""

    def __post_init__(self) -> None:
        if isinstance(self.cells, bool) or not isinstance(self.cells, int) or not 1 <= self.cells <= MOST_CELLS:
            raise InputError(f"cells = {self.cells!r}: allowed is a whole number of 1 to {MOST_CELLS}")
        if not 1.0 <= self.grading <= 8.0:
            raise InputError(f"grading = {self.grading!r}: allowed is 1 (uniform) to 8")
        if (RINGS * self.cells) ** -self.grading < SMALLEST:
            raise InputError(
                f"cells = {self.cells!r} with grading = {self.grading!r}: allowed are corner cells not below "
                f"{SMALLEST:g} of their rings' extent; choose fewer cells or less grading"
            )


@dataclass(frozen=True, slots=True)
class Triangles:
    """A triangulation: plain arrays, so that it can be checked without scikit-fem."""

    points_m: FloatArray
    """(2, number of points)."""
    corners: IntArray
    """(3, number of triangles), counter-clockwise."""


class Grid(NamedTuple):
    """Grid lines before the mapping; in the tip heights are those at x = a."""

    xs: FloatArray
    ys: FloatArray
    rows_below_tip: int


def triangulate(outline: Outline, resolution: Resolution) -> Triangles:
    """Return the mesh of an outline. It is symmetric about x = 0, triangle by triangle."""
    xs, ys, _ = grid = Grid(_x_lines(outline, resolution), *_y_lines(outline, resolution))
    solid = _solid(outline, grid)
    numbers = np.arange(len(xs) * len(ys)).reshape(len(xs), len(ys))
    low_left, low_right = numbers[:-1, :-1], numbers[1:, :-1]
    up_left, up_right = numbers[:-1, 1:], numbers[1:, 1:]
    right = np.broadcast_to((0.5 * (xs[1:] + xs[:-1]) > 0.0)[:, np.newaxis], solid.shape)
    # Each cell is cut by one diagonal, mirrored left of x = 0.
    rising, falling = solid & right, solid & ~right
    halves = (
        (rising, low_left, low_right, up_right), (rising, low_left, up_right, up_left),
        (falling, low_left, low_right, up_left), (falling, low_right, up_right, up_left),
    )  # fmt: skip
    triangles = np.concatenate([np.stack([corner[cells] for corner in three]) for cells, *three in halves], axis=1)
    used, corners = np.unique(triangles, return_inverse=True)
    points = np.ascontiguousarray(_bent(outline, resolution, grid)[:, used])
    return Triangles(points, np.ascontiguousarray(corners.reshape(triangles.shape), dtype=np.int64))


def _joined(blocks: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([blocks[0], *(block[1:] for block in blocks[1:])])


def _from_corner(corner: float, sign: float, radius: float, reach: float, n: int) -> list[FloatArray]:
    """Return the blocks from a corner: its rings (all of a short block) or its fillet, then the rest to ``reach``."""
    extent = radius if radius > 0.0 else PATCH_M if reach > 2.0 * PATCH_M else reach
    edge, far = corner + sign * extent, corner + sign * reach
    blocks = [np.linspace(corner, edge, RINGS * n + 1)]
    if edge != far:
        blocks.append(np.linspace(edge, far, n + 1))
    return blocks


def _to_corner(corner: float, radius: float, reach: float, n: int) -> list[FloatArray]:
    return [block[::-1] for block in reversed(_from_corner(corner, -1.0, radius, reach, n))]


def _x_lines(outline: Outline, resolution: Resolution) -> FloatArray:
    g, n, half_h2 = outline.geometry, resolution.cells, 0.5 * outline.geometry.h2_m
    inner = _from_corner(half_h2, 1.0, outline.fillet_m, outline.fillet_m + NEAR_M, n)
    outer = _to_corner(g.a_m, outline.slit_fillet_m, outline.slit_fillet_m + NEAR_M, n)
    middle = _middle(float(inner[-1][-1]), float(outer[0][0]), outline.fixture_half_width_m, n)
    leg = _from_corner(g.a_m, 1.0, 0.0, outline.leg_m, n)
    right = _joined([np.linspace(0.0, half_h2, RINGS * n + 1), *inner, *middle, *outer, *leg])
    return np.concatenate([-right[:0:-1], right])


def _middle(start: float, end: float, between: float, n: int) -> list[FloatArray]:
    """Return the middle of a beam in two blocks, 6 n cells together, each at least n."""
    share = min(5, max(1, round(6.0 * (between - start) / (end - start))))
    return [np.linspace(start, between, share * n + 1), np.linspace(between, end, (6 - share) * n + 1)]


def _y_lines(outline: Outline, resolution: Resolution) -> tuple[FloatArray, int]:
    """Return the lines, and the number of cells below the tip. In the tip heights are those at x = a."""
    g, n, fillet, foot = outline.geometry, resolution.cells, outline.fillet_m, outline.foot_m
    half_h1, bottom, depth = 0.5 * g.h1_m, outline.tip_bottom_m, outline.fixture_depth_m
    near_joint = _to_corner(-half_h1, fillet, fillet + NEAR_M, n)
    near_foot = _from_corner(foot, 1.0, fillet, fillet + NEAR_M, n)
    start, end = float(near_foot[-1][-1]), float(near_joint[0][0])
    leg_end = -half_h1 - outline.leg_below_m if outline.leg_below_m > 0.0 else 0.5 * (start + end)
    middle_of_slit = half_h1 + 0.5 * outline.slit_m
    slit_lower = _from_corner(half_h1, 1.0, outline.slit_fillet_m, 0.5 * outline.slit_m, n)
    slit_upper = _to_corner(bottom, outline.slit_fillet_m, 0.5 * outline.slit_m, n)
    # Both halves end at the same rounded number.
    slit_lower[-1][-1] = slit_upper[0][0] = middle_of_slit
    below = _to_corner(foot, 0.0, depth, n) if depth > 0.0 else []
    beam = [np.linspace(*ends, RINGS * n + 1) for ends in ((-half_h1, 0.0), (0.0, half_h1))]
    stem = [*near_foot, *_middle(start, end, leg_end, n), *near_joint]
    lines = _joined([*below, *stem, *beam, *slit_lower, *slit_upper])
    height = float(outline.tip_top_m(g.a_m)) - bottom
    tip = _joined(_from_corner(bottom, 1.0, 0.0, height, n))
    return np.concatenate([lines, tip[1:]]), len(lines) - 1


def _solid(outline: Outline, grid: Grid) -> npt.NDArray[np.bool_]:
    x, y = (0.5 * (lines[1:] + lines[:-1]) for lines in (grid.xs, grid.ys))
    solid = np.zeros((len(x), len(y)), dtype=np.bool_)
    solid[:, grid.rows_below_tip :] = True
    for part in outline.rectangles():
        columns, rows = (x > part.left_m) & (x < part.right_m), (y > part.lower_m) & (y < part.upper_m)
        rows[grid.rows_below_tip :] = False
        solid |= columns[:, np.newaxis] & rows
    return solid


def _bent(outline: Outline, resolution: Resolution, grid: Grid) -> FloatArray:
    """Return the mapped nodes (2, count): rings around sharp corners, faces in fillets, the tip under its arc."""
    x, y = (values.ravel() for values in np.meshgrid(grid.xs, grid.ys, indexing="ij"))
    row = np.tile(np.arange(len(grid.ys)), len(grid.xs))
    points = np.stack([x, y])
    moved = points.copy()
    for corner in outline.corners().values():
        if corner.radius_m > 0.0:
            moved += _towards_fillet(corner, points)
        elif resolution.grading > 1.0:
            moved += _rings(corner, points, grid, resolution)
    bottom = outline.tip_bottom_m
    stretch = (outline.tip_top_m(moved[0]) - bottom) / (outline.tip_top_m(outline.geometry.a_m) - bottom)
    moved[1] = np.where(row > grid.rows_below_tip, bottom + (moved[1] - bottom) * stretch, moved[1])
    return moved


def _rings(corner: Corner, points: FloatArray, grid: Grid, resolution: Resolution) -> FloatArray:
    """Return the displacement of nodes towards a sharp corner: of the rings in all blocks around it."""
    offset = points - np.array([[corner.x_m], [corner.y_m]])
    ratio = np.zeros_like(offset)
    count = RINGS * resolution.cells
    for axis, lines in enumerate((grid.xs, grid.ys)):
        at = int(np.argmin(np.abs(lines - (corner.x_m, corner.y_m)[axis])))
        below, above = lines[at] - lines[at - count], lines[at + count] - lines[at]
        ratio[axis] = np.abs(offset[axis]) / np.where(offset[axis] < 0.0, below, above)
    ring = ratio.max(axis=0)
    # Nodes on the outermost ring stay; 1e-9 is smaller than any cell and larger than rounding.
    inside = (ring < 1.0 - 1e-9) & (ring > 1e-9)
    shrink = np.where(inside, np.where(inside, ring, 1.0) ** (resolution.grading - 1.0) - 1.0, 0.0)
    result: FloatArray = offset * shrink
    return result


def _towards_fillet(corner: Corner, points: FloatArray) -> FloatArray:
    """Return the displacement of nodes that maps both faces of a corner onto an arc: full on the faces, 0 inside."""
    radius = corner.radius_m
    u, v = (points[0] - corner.x_m) * corner.free_x, (points[1] - corner.y_m) * corner.free_y
    inside = (u <= radius) & (v <= radius) & ((u <= 0.0) | (v <= 0.0))
    fade = np.clip(1.0 + np.minimum(u, 0.0) / corner.depth_x_m, 0.0, 1.0) * np.clip(
        1.0 + np.minimum(v, 0.0) / corner.depth_y_m, 0.0, 1.0
    )
    # The face along u maps to the half of the arc from 225 to 270 degrees around its centre (radius, radius).
    from_u, from_v = np.clip(u, 0.0, radius), np.clip(v, 0.0, radius)
    angle = 1.25 * math.pi + 0.25 * math.pi * (from_u - from_v) / radius
    move_u = radius * (1.0 + np.cos(angle)) - from_u
    move_v = radius * (1.0 + np.sin(angle)) - from_v
    weight = np.where(inside, fade, 0.0)
    return np.stack([corner.free_x * weight * move_u, corner.free_y * weight * move_v])
