"""The fingertip as a MuJoCo body in MJCF, its beams as joints; a gripper with a ball, and a hand of five fingers.

Axes: x along the horizontal beam, y from the fixture to the tip, z along the width; SI units. Body ``fixture``: origin
in the middle of its mounting face; site ``tip``: the middle of the horizontal beam, from where forces and angles count.
The fixture is assumed, as in docs/mechanics.md; the beams have no mass and touch nothing."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from tipforce.errors import InputError, needing
from tipforce.sensor.dynamics.model import HIGHEST_DAMPING_RATIO, compliances, half_cylinder, modes
from tipforce.sensor.structure.plane_frame import Frame
from tipforce.sensor.structure.strain import FABRICATED, Geometry

if TYPE_CHECKING:
    import mujoco

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
    """Return the MJCF text of one fingertip, to attach to a hand; ``damping_ratio``: of the lowest mode. Raises
    InputError for a prefix not of letters, digits, ``_``, ``-``, ``.``, and a negative or infinite damping ratio."""
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
        for name, (stiffness, damping) in springs.items():
            joints += f"""
        <joint name="{n}{name}" {kinds[name]} stiffness="{_numbers(stiffness)}" damping="{_numbers(damping)}" \
limited="false" />"""
    half_width_m, unseen = 0.5 * g.width_m, 'mass="0" contype="0" conaffinity="0"'  # by the collisions
    vertices: list[float] = []  # of the half cylinder
    for angle in (math.pi * k / FACETS for k in range(FACETS + 1)):
        for z in (-half_width_m, half_width_m):
            vertices += (round(g.r_m * math.cos(angle), 12), round(g.r_m * math.sin(angle), 12), z)
    return f"""\
<mujoco model="{n}fingertip">
  <compiler angle="radian" autolimits="true" />{comment}
  <asset>
    <mesh name="{n}tip" vertex="{_numbers(*vertices)}" />
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
    """Return (stiffness, damping) of the joints x, y (N/m, N s/m) and turn (N m/rad, N m s/rad), and y of the hinge,
    metres: the centre of compliance, about which the compliance (3, 3) of the beams is diagonal."""
    r = geometry.r_m
    arms, vertical = compliances(Frame(geometry))
    (c_v, _, _), (_, c_turn, c_both), (_, _, c_u) = (arms + vertical).tolist()
    stiffness = {"x": 1.0 / (c_u - c_both * c_both / c_turn), "y": 1.0 / c_v, "turn": r * r / c_turn}
    per_stiffness = 2.0 * damping_ratio / float(modes(geometry).omega_rad_s[0])
    return {name: (k, per_stiffness * k) for name, k in stiffness.items()}, r * c_both / c_turn


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.9g}" for value in values)


BALL_RADIUS_M = 0.02
FINGERS = ("thumb", "index", "middle", "ring", "little")
_OPTION = '<option timestep="0.0005" integrator="implicitfast" cone="elliptic" impratio="10"/>'
_LENGTH_M = FIXTURE_DEPTH_M + FABRICATED.d_m + 0.5 * FABRICATED.h1_m + FABRICATED.r_m  # from flange to summit
_START_M = BALL_RADIUS_M + _LENGTH_M + 0.01  # of a flange from the ball's middle: the tips are 10 mm away from it
_GRASP = f"""<mujoco model="grasp">
  <compiler angle="degree"/>{_OPTION}
  <default><geom friction="0.8 0.005 0.0001"/></default>
  <visual><global offwidth="1280" offheight="960"/></visual>
  <worldbody>
    <light pos="0.1 -0.4 0.5" dir="-0.2 0.8 -1"/>
    <geom name="plate" type="cylinder" size="0.012 0.02" pos="0 0 0.02" rgba="0.6 0.6 0.6 1"/>
    <body name="ball" pos="0 0 {0.04 + BALL_RADIUS_M}">
      <freejoint/>
      <geom name="ball" type="sphere" size="{BALL_RADIUS_M}" mass="0.06" condim="4" rgba="0.85 0.35 0.2 1"/>
    </body>
    <body name="hand" pos="0 0 {0.04 + BALL_RADIUS_M}">
      <joint name="lift" type="slide" axis="0 0 1" damping="200" range="-0.02 0.1"/>
      <inertial pos="0 0 0" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="left" pos="-{_START_M} 0 0">
        <joint name="left" type="slide" axis="1 0 0" damping="3" frictionloss="0.3" range="-0.01 0.03"/>
        <geom type="box" size="0.01 0.01 0.01" pos="-0.01 0 0" mass="0.05" contype="0" conaffinity="0"/>
        <frame name="thumb" euler="90 0 0"><frame name="thumb_flange" euler="0 0 -90"/></frame>
      </body>
      <body name="right" pos="{_START_M} 0 0">
        <joint name="right" type="slide" axis="-1 0 0" damping="3" frictionloss="0.3" range="-0.01 0.03"/>
        <geom type="box" size="0.01 0.01 0.01" pos="0.01 0 0" mass="0.05" contype="0" conaffinity="0"/>
        <frame name="index" euler="90 0 0"><frame name="index_flange" euler="0 0 90"/></frame>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="left" joint2="right"/></equality>
  <actuator>
    <motor name="grip_left" joint="left" ctrlrange="-10 10"/>
    <motor name="grip_right" joint="right" ctrlrange="-10 10"/>
    <position name="lift" joint="lift" kp="20000" ctrlrange="-0.02 0.1"/>
  </actuator>
</mujoco>"""


def grasp_model(rigid: bool = False) -> mujoco.MjModel:
    """Return a gripper with sites ``thumb_tip`` and ``index_tip`` before a ball of 60 g; actuators ``grip_left``,
    ``grip_right`` (N, 0.3 N friction), ``lift`` (m). ``rigid``: without springs of the tips, for longer time steps."""
    return _with_fingertips(_GRASP, FINGERS[:2], rigid)


def hand_model() -> mujoco.MjModel:
    """Return five fingers of three joints with fingertips, sites ``thumb_tip`` to ``little_tip``, around a ball.
    Position actuators ``thumb_1`` to ``little_3`` from the base to the tip, radians; positive closes the finger."""
    bodies, actuators = "", ""
    links = ((0.04, 0.008), (0.03, 0.007), (0.02, 0.006))  # length and radius, metres
    for k, finger in enumerate(FINGERS):
        turn = 2.0 * math.pi * k / len(FINGERS)
        servos = ""
        inner = f'<frame name="{finger}_flange" pos="0 0 {links[-1][0]}" euler="90 0 0"/>'
        for j in (2, 1, 0):
            length, radius = links[j]
            at = "0 0 0" if j == 0 else f"0 0 {links[j - 1][0]}"
            bend = (0, 30, 30)[j]
            inner = f"""<body name="{finger}_link_{j + 1}" pos="{at}" euler="0 {-bend} 0">
                <joint name="{finger}_{j + 1}" axis="0 -1 0" damping="0.02" armature="0.0001" range="-60 60"/>
                <geom type="capsule" fromto="0 0 0 0 0 {length}" size="{radius}" mass="0.02"/>{inner}</body>"""
            name = f"{finger}_{j + 1}"
            servos = f'<position name="{name}" joint="{name}" kp="1.5" ctrlrange="-1 1"/>{servos}'
        actuators += servos
        x, y = 0.1 * math.cos(turn), 0.1 * math.sin(turn)
        bodies += f'<frame pos="{x} {y} 0" euler="0 0 {math.degrees(turn)}">{inner}</frame>'
    text = f"""<mujoco model="hand"><compiler angle="degree"/>{_OPTION}
      <worldbody>{bodies}
        <geom name="palm" type="cylinder" size="0.012 0.0315" pos="0 0 0.0315"/>
        <body name="ball" pos="0 0 0.095">
          <freejoint/><geom name="ball" type="sphere" size="0.032" mass="0.05" condim="4"/>
        </body></worldbody><actuator>{actuators}</actuator></mujoco>"""
    return _with_fingertips(text, FINGERS, rigid=False)


def _with_fingertips(text: str, fingers: Sequence[str], rigid: bool) -> mujoco.MjModel:
    with needing('MuJoCo is not installed: pip install "tipforce[mujoco]"'):
        import mujoco
    spec = mujoco.MjSpec.from_string(text)
    for finger in fingers:
        tip = mujoco.MjSpec.from_string(fingertip_mjcf(rigid=rigid))
        spec.frame(f"{finger}_flange").attach_body(tip.body("fixture"), f"{finger}_", "")
    return spec.compile()
