"""docs/figures/mujoco-grasp.png: the grasp of docs/examples in MuJoCo's own renderer (by EGL), beside its forces.

python -m bench.twin_figure
"""

from __future__ import annotations

import os
import sys

from bench.live_loopback import ROOT

os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported: no display is needed
sys.path.insert(0, str(ROOT / "docs" / "examples"))

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import numpy.typing as npt

import grasp
from grasp_controller import ASKED_NEWTONS, PERIOD_S

FIGURE = ROOT / "docs" / "figures" / "mujoco-grasp.png"


def figure() -> None:
    """Write it."""
    gripper, rows, u_P_newtons = grasp.grasp(grasp.SECONDS)
    fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), width_ratios=(1.0, 1.35), layout="constrained")
    left.imshow(_picture(gripper))
    left.set_axis_off()
    t_s = PERIOD_S * np.arange(1, len(rows) + 1)
    right.plot(t_s, [row.P_newtons[0] for row in rows], lw=0.6, color="tab:orange", label="node 1, read from CAN")
    right.plot(t_s, [loads["thumb"].P_newtons for loads in gripper.loads], lw=1.2, color="tab:blue", label="truth")
    right.axhline(ASKED_NEWTONS, color="black", lw=0.8, ls=":", label="asked")
    right.axvspan(grasp.LIFT_AT_S, grasp.LIFT_AT_S + grasp.LIFT_M / grasp.LIFT_M_PER_S, color="0.9", label="lift")
    right.set(xlabel="simulated time, s", ylabel="force on the thumb, N", ylim=(0.0, 2.4))
    right.legend(loc="lower right", frameon=False, ncols=4, fontsize=8)
    inset = right.inset_axes((0.42, 0.3, 0.55, 0.34))
    last = slice(-250, None)
    inset.plot(t_s[last], [row.P_newtons[0] for row in rows[last]], lw=0.6, color="tab:orange")
    inset.plot(t_s[last], [loads["thumb"].P_newtons for loads in gripper.loads[last]], lw=1.2, color="tab:blue")
    low, high = (ASKED_NEWTONS + sign * u_P_newtons[0] for sign in (-1.0, 1.0))
    inset.axhspan(low, high, color="0.85", lw=0.0)
    inset.set_title("the last half second; grey: asked, plus and minus u(P)", fontsize=8)
    inset.tick_params(labelsize=7)
    fig.savefig(FIGURE, dpi=110, metadata={"Software": ""})


def _picture(gripper: grasp.Gripper) -> npt.NDArray[np.uint8]:
    """Return the gripper as it is now, with its contact forces."""
    model = gripper.model
    model.vis.global_.offwidth, model.vis.global_.offheight = 1000, 860
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.45, 0.5
    model.vis.map.force = 0.005
    model.geom_rgba[model.geom("ball").id] = 0.9, 0.45, 0.25, 1.0
    camera, options = mujoco.MjvCamera(), mujoco.MjvOption()
    mujoco.mjv_defaultFreeCamera(model, camera)
    camera.distance, camera.azimuth, camera.elevation = 0.22, 75.0, -18.0
    camera.lookat[:] = gripper.data.body("hand").xpos
    options.flags[mujoco.mjtVisFlag.mjVIS_CONTACTFORCE] = True
    with mujoco.Renderer(model, 860, 1000) as renderer:
        renderer.update_scene(gripper.data, camera, options)
        pixels: npt.NDArray[np.uint8] = renderer.render().copy()
    background = (pixels.astype(np.int64).sum(axis=-1) == 0)[..., np.newaxis]
    return np.where(background, np.uint8(255), pixels)


if __name__ == "__main__":
    figure()
