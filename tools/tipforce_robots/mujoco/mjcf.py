"""The fingertip as a MuJoCo body in MJCF: outline, mass, tip site, and the compliance of its beams as joints.

Axes: x along the horizontal beam, y from the fixture to the tip, z along the width; SI units. The body ``fixture`` has
its origin in the middle of its mounting face; the site ``tip`` is in the middle of the horizontal beam, where the
sensor's forces and angles count from. The tip is the half cylinder of ``sensor.dynamics``; the fixture's block is
assumed, as drawn in docs/mechanics.md. The beams have no mass and touch nothing.
"""

from __future__ import annotations

import math
import re

from tipforce.errors import InputError
from tipforce.sensor.dynamics.model import HIGHEST_DAMPING_RATIO, compliances, half_cylinder, modes
from tipforce.sensor.structure.geometry import FABRICATED, Geometry
from tipforce.sensor.structure.plane_frame import Frame

FIXTURE_DEPTH_M, FIXTURE_HALF_WIDTH_M = 4e-3, 9e-3
FIXTURE_DENSITY = 7850.0
"""kg/m3, of steel as the tip."""
FACETS = 64
"""Of the half circle: a normal is at most 1.4 degrees off."""
DAMPING_RATIO = 0.05
"""Of the lowest mode, assumed; damping is proportional to stiffness, so that the higher modes have more."""
_PREFIX = re.compile(r"[A-Za-z0-9_.-]*")


def fingertip_mjcf(
    prefix: str = "", *, rigid: bool = False, damping_ratio: float = DAMPING_RATIO, geometry: Geometry = FABRICATED
) -> str:
    """Return the MJCF text of a model with one fingertip, to attach to a hand.

    prefix: in front of every name. rigid: without the joints of the beams. damping_ratio: of the lowest mode. Raises
    InputError for a prefix with other characters than letters, digits, ``_``, ``-`` and ``.``, and a damping ratio that
    is negative or not finite.
    """
    if not _PREFIX.fullmatch(prefix):
        raise InputError(f"prefix {prefix!r}: allowed are letters, digits, _, - and .")
    if not 0.0 <= damping_ratio <= HIGHEST_DAMPING_RATIO:
        raise InputError(f"damping_ratio = {damping_ratio!r}: allowed is 0 to {HIGHEST_DAMPING_RATIO:g}")
    g, n, foot_m = geometry, prefix, FIXTURE_DEPTH_M
    comment = joints = ""
    if not rigid:
        low, middle, high = modes(g).frequency_hz.tolist()
        comment = (
            f"\n  <!-- modes at {low:.0f}, {middle:.0f} and {high:.0f} Hz against a fixed fixture; "
            f"explicit springs need a time step below {1.0 / (math.pi * high):.2g} s -->"
        )
        springs, hinge_m = beam_joints(g, damping_ratio)
        kinds = {
            "x": 'type="slide" axis="1 0 0"',
            "y": 'type="slide" axis="0 1 0"',
            "turn": f'type="hinge" axis="0 0 1" pos="{_numbers(0.0, hinge_m, 0.0)}"',
        }
        joints = "".join(
            f"""
        <joint name="{n}{name}" {kind} stiffness="{_numbers(springs[name][0])}" damping="{_numbers(springs[name][1])}" \
limited="false" />"""
            for name, kind in kinds.items()
        )
    half_width_m, unseen = 0.5 * g.width_m, 'mass="0" contype="0" conaffinity="0"'  # by the collisions
    return f"""\
<mujoco model="{n}fingertip">
  <compiler angle="radian" autolimits="true" />{comment}
  <asset>
    <mesh name="{n}tip" vertex="{_numbers(*_half_cylinder_vertices(g))}" />
  </asset>
  <worldbody>
    <body name="{n}fixture">
      <geom name="{n}fixture" type="box" pos="{_numbers(0.0, 0.5 * foot_m, 0.0)}" \
size="{_numbers(FIXTURE_HALF_WIDTH_M, 0.5 * foot_m, half_width_m)}" density="{_numbers(FIXTURE_DENSITY)}" />
      <geom type="box" pos="{_numbers(0.0, foot_m + 0.5 * g.d_m, 0.0)}" \
size="{_numbers(0.5 * g.h2_m, 0.5 * g.d_m, half_width_m)}" {unseen} />
      <body name="{n}tip" pos="{_numbers(0.0, foot_m + g.d_m + 0.5 * g.h1_m, 0.0)}">{joints}
        <geom type="box" size="{_numbers(g.a_m, 0.5 * g.h1_m, half_width_m)}" {unseen} />
        <geom name="{n}tip" type="mesh" mesh="{n}tip" mass="{_numbers(half_cylinder(g).mass_kg)}" />
        <site name="{n}tip" size="{_numbers(0.5 * g.h2_m)}" />
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def beam_joints(geometry: Geometry, damping_ratio: float) -> tuple[dict[str, tuple[float, float]], float]:
    """Return ((stiffness, damping) of the joints ``x``, ``y`` and ``turn``, y of the hinge in metres).

    About the centre of compliance a force along x turns nothing, and a moment moves nothing along x: there the
    compliance (3, 3) of the beams is diagonal. N/m and N s/m; N m/rad and N m s/rad.
    """
    r = geometry.r_m
    arms, vertical = compliances(Frame(geometry))
    (c_v, _, _), (_, c_turn, c_both), (_, _, c_u) = (arms + vertical).tolist()
    stiffness = {"x": 1.0 / (c_u - c_both * c_both / c_turn), "y": 1.0 / c_v, "turn": r * r / c_turn}
    per_stiffness = 2.0 * damping_ratio / float(modes(geometry).omega_rad_s[0])
    return {name: (k, per_stiffness * k) for name, k in stiffness.items()}, r * c_both / c_turn


def _half_cylinder_vertices(g: Geometry) -> list[float]:
    vertices: list[float] = []
    for k in range(FACETS + 1):
        angle = math.pi * k / FACETS
        for z in (-0.5 * g.width_m, 0.5 * g.width_m):
            vertices += (round(g.r_m * math.cos(angle), 12), round(g.r_m * math.sin(angle), 12), z)
    return vertices


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.9g}" for value in values)
