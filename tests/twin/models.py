"""Small MuJoCo models with fingertips, for the tests of the twin."""

from collections.abc import Iterator

import mujoco
import numpy as np

from tipforce.arrays import FloatArray
from tipforce.sensor import FABRICATED
from tipforce_robots.mujoco import Fingertips, TwinSample, fingertip_mjcf

R = FABRICATED.r_m


def pressed(
    pushes: dict[str, tuple[float, float, float]], *, rigid: bool = True, option: str = ""
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A tip that is fixed to the world, turned out of its axes, and a ball of 10 mm before it at each angle, at rest.

    ``pushes``: by name of the ball its theta in degrees, its z in metres, and its mass in kg; it slides on three axes.
    """
    balls = ""
    for name, (theta_deg, z_m, mass_kg) in pushes.items():
        theta, out = np.radians(theta_deg), R + 0.01
        slides = "".join(f'<joint type="slide" axis="{axis}" damping="5"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
        balls += f"""<body name="{name}" pos="{out * np.cos(theta)} {out * np.sin(theta)} {z_m}">{slides}
            <geom type="sphere" size="0.01" mass="{mass_kg}" condim="6" friction="0.8 0.01 0.001"/></body>"""
    text = f"""<mujoco><option timestep="0.0005" gravity="0 0 0" {option}/><worldbody>
      <frame name="at" pos="0.3 -0.2 0.5" euler="20 30 40">{balls}</frame></worldbody></mujoco>"""
    spec = mujoco.MjSpec.from_string(text)
    frame = next(iter(spec.frames))
    tip = mujoco.MjSpec.from_string(fingertip_mjcf(rigid=rigid))
    fixture = tip.body("fixture")
    fixture.pos = [0.0, -tip.body("tip").pos[1], 0.0]  # the origin of the tip is that of the frame
    frame.attach_body(fixture, "thumb_", "")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def samples(model: mujoco.MjModel, data: mujoco.MjData, tips: Fingertips, steps: int) -> Iterator[TwinSample]:
    """The thumb after each step of a simulation."""
    for _ in range(steps):
        mujoco.mj_step(model, data)
        yield tips.read(data)["thumb"]


def push(model: mujoco.MjModel, data: mujoco.MjData, name: str, force_in_tip: FloatArray) -> None:
    """Push a ball by a force along the axes of the tip, newtons."""
    turn = data.site("thumb_tip").xmat.reshape(3, 3)
    data.xfrc_applied[model.body(name).id, :3] = turn @ force_in_tip


def external_wrench(model: mujoco.MjModel, data: mujoco.MjData, site: str) -> tuple[FloatArray, FloatArray]:
    """Force and moment of the contacts about a site in its axes, by MuJoCo's own recursion (cfrc_ext)."""
    mujoco.mj_rnePostConstraint(model, data)
    where = model.site(site).id
    body = int(model.site_bodyid[where])
    moment, force = data.cfrc_ext[body, :3].copy(), data.cfrc_ext[body, 3:]
    moment += np.cross(data.subtree_com[model.body_rootid[body]] - data.site_xpos[where], force)
    turn = data.site_xmat[where].reshape(3, 3)
    return turn.T @ force, turn.T @ moment
