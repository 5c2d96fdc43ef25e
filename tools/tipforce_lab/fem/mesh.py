"""Triangles for an outline: a grid of lines in x and y without the cells outside of the body, mapped to its shape.

Around a re-entrant corner the cells form rings, ring k of m as far from the corner as (k / m)^grading: cells shrink
towards it equally in both directions, and none becomes long and thin. The topology of the grid is unchanged, so a
graded mesh has as many unknowns as the uniform one (grading = 1), and the mesh of 2 n contains the nodes of that of n.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tipforce.arrays import FloatArray, IntArray
from tipforce.errors import InputError
from tipforce_lab.fem.outline import NEAR_M, Corner, Outline

GRADING = 4.0
"""Displacement goes as r^0.5445 at a corner. A gauge that ends in one reads the corner's own displacement, wrong by
(size of the smallest cell)^0.5445, so the order is 0.5445 times the grading. 5.5 would give 3, the most that P2 can;
up to 2e5 unknowns its wide outer rings still make condition numbers twice as wrong, strains a third less."""
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

    def areas_m2(self) -> FloatArray:
        """Return the signed areas, positive for a triangle that is not inverted."""
        p, q, s = (self.points_m[:, index] for index in self.corners)
        result: FloatArray = 0.5 * ((q[0] - p[0]) * (s[1] - p[1]) - (s[0] - p[0]) * (q[1] - p[1]))
        return result


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
    triangles = np.concatenate(
        [
            np.stack([low_left[rising], low_right[rising], up_right[rising]]),
            np.stack([low_left[rising], up_right[rising], up_left[rising]]),
            np.stack([low_left[falling], low_right[falling], up_left[falling]]),
            np.stack([low_right[falling], up_right[falling], up_left[falling]]),
        ],
        axis=1,
    )
    used, corners = np.unique(triangles, return_inverse=True)
    points = np.ascontiguousarray(_bent(outline, resolution, grid)[:, used])
    return Triangles(points, np.ascontiguousarray(corners.reshape(triangles.shape), dtype=np.int64))


def _joined(blocks: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([blocks[0], *(block[1:] for block in blocks[1:])])


def _from_corner(corner: float, sign: float, radius: float, reach: float, n: int) -> list[FloatArray]:
    """Return the blocks from a corner: its rings or its fillet, then the rest up to ``reach``.

    The rings are the whole of a short block, such as half of the slit.
    """
    extent = radius if radius > 0.0 else PATCH_M if reach > 2.0 * PATCH_M else reach
    edge, far = corner + sign * extent, corner + sign * reach
    blocks = [np.linspace(corner, edge, RINGS * n + 1)]
    if edge != far:
        blocks.append(np.linspace(edge, far, n + 1))
    return blocks


def _to_corner(corner: float, sign: float, radius: float, reach: float, n: int) -> list[FloatArray]:
    """Return the same blocks in the other direction, ending in the corner."""
    return [block[::-1] for block in reversed(_from_corner(corner, sign, radius, reach, n))]


def _x_lines(outline: Outline, resolution: Resolution) -> FloatArray:
    g, n, half_h2 = outline.geometry, resolution.cells, 0.5 * outline.geometry.h2_m
    inner = _from_corner(half_h2, 1.0, outline.fillet_m, outline.fillet_m + NEAR_M, n)
    outer = _to_corner(g.a_m, -1.0, outline.slit_fillet_m, outline.slit_fillet_m + NEAR_M, n)
    right = _joined(
        [
            np.linspace(0.0, half_h2, RINGS * n + 1),
            *inner,
            *_middle(float(inner[-1][-1]), float(outer[0][0]), outline.fixture_half_width_m, n),
            *outer,
            *_from_corner(g.a_m, 1.0, 0.0, outline.leg_m, n),
        ]
    )
    return np.concatenate([-right[:0:-1], right])


def _middle(start: float, end: float, between: float, n: int) -> list[FloatArray]:
    """Return the middle of a beam in two blocks, 6 n cells together, each at least n."""
    share = min(5, max(1, round(6.0 * (between - start) / (end - start))))
    return [np.linspace(start, between, share * n + 1), np.linspace(between, end, (6 - share) * n + 1)]


def _y_lines(outline: Outline, resolution: Resolution) -> tuple[FloatArray, int]:
    """Return the lines, and the number of cells below the tip. In the tip heights are those at x = a."""
    g, n, fillet, foot = outline.geometry, resolution.cells, outline.fillet_m, outline.foot_m
    half_h1, bottom, depth = 0.5 * g.h1_m, outline.tip_bottom_m, outline.fixture_depth_m
    near_joint = _to_corner(-half_h1, -1.0, fillet, fillet + NEAR_M, n)
    near_foot = _from_corner(foot, 1.0, fillet, fillet + NEAR_M, n)
    start, end = float(near_foot[-1][-1]), float(near_joint[0][0])
    leg_end = -half_h1 - outline.leg_below_m if outline.leg_below_m > 0.0 else 0.5 * (start + end)
    middle_of_slit = half_h1 + 0.5 * outline.slit_m
    slit_lower = _from_corner(half_h1, 1.0, outline.slit_fillet_m, 0.5 * outline.slit_m, n)
    slit_upper = _to_corner(bottom, -1.0, outline.slit_fillet_m, 0.5 * outline.slit_m, n)
    # Both halves end at the same rounded number.
    slit_lower[-1][-1] = slit_upper[0][0] = middle_of_slit
    lines = _joined(
        [
            *(_to_corner(foot, -1.0, 0.0, depth, n) if depth > 0.0 else []),
            *near_foot,
            *_middle(start, end, leg_end, n),
            *near_joint,
            np.linspace(-half_h1, 0.0, RINGS * n + 1),
            np.linspace(0.0, half_h1, RINGS * n + 1),
            *slit_lower,
            *slit_upper,
        ]
    )
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
