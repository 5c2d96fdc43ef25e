"""Two MuJoCo models with fingertips: a gripper that grasps a ball, and a hand of five fingers of three joints."""

from __future__ import annotations

import math

from tipforce.errors import EnvironmentLackError
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce_robots.mujoco.mjcf import FIXTURE_DEPTH_M, fingertip_mjcf

try:
    import mujoco
except ImportError:
    raise EnvironmentLackError('MuJoCo is not installed: pip install "tipforce[mujoco]"') from None

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
    """Return a gripper with two fingertips, sites ``thumb_tip`` and ``index_tip``, before a ball of 60 g on a plate.

    Actuators: ``grip_left`` and ``grip_right`` close it, newtons; ``lift``, metres. Its joints have friction of 0.3 N,
    so that the force at the ball is not that of the motors. ``rigid``: without the springs of the tips, which allows
    longer time steps.
    """
    spec = mujoco.MjSpec.from_string(_GRASP)
    for finger in FINGERS[:2]:
        _attach(spec, finger, rigid)
    return spec.compile()


def hand_model() -> mujoco.MjModel:
    """Return five fingers of three joints with fingertips, sites ``thumb_tip`` to ``little_tip``, around a ball.

    Position actuators ``thumb_1`` to ``little_3`` from the base to the tip, radians; positive closes the finger.
    """
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
    spec = mujoco.MjSpec.from_string(text)
    for finger in FINGERS:
        _attach(spec, finger, rigid=False)
    return spec.compile()


def _attach(spec: mujoco.MjSpec, finger: str, rigid: bool) -> None:
    tip = mujoco.MjSpec.from_string(fingertip_mjcf(rigid=rigid))
    spec.frame(f"{finger}_flange").attach_body(tip.body("fixture"), f"{finger}_", "")
