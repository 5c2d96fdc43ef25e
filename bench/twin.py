"""The MuJoCo twin: its cost beside the physics step, and the error of contact parameters and time steps.

    python -m bench.twin             both tables of docs/mujoco.md; half a minute
    python -m bench.twin --figure    docs/figures/mujoco-grasp.png

Physics and twin are timed in turns, of ``hand_model`` holding a ball. The errors are those of ``grasp_model`` with 2 N
of motor force against a reference with short steps and stiff contacts."""

import os
import sys
import time
from collections.abc import Callable
from functools import partial

from bench.measure import ROOT, arguments, in_turns, table

os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported: no display is needed
sys.path.insert(0, str(ROOT / "docs" / "examples"))

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import numpy.typing as npt

import grasp
from grasp_controller import ASKED_NEWTONS, PERIOD_S
from tipforce.arrays import FloatArray
from tipforce.output_file import save_figure
from tipforce_robots.mujoco import Fingertips, grasp_model, hand_model
from tipforce_robots.mujoco.models import FINGERS

STEPS, ROUNDS = 100, 60
SECONDS, GRID_S, SETTLED_S, LIFT_AT_S, LIFT_M = 2.0, 0.002, 0.6, 1.0, 0.03
REFERENCE = (0.00005, 0.001, False)  # time step, time constant of the contacts, rigid
SETTINGS = [
    (0.0001, 0.002, False), (0.0005, 0.002, False), (0.0005, 0.005, False), (0.0005, 0.02, False),
    (0.0005, 0.05, False), (0.0005, 0.02, True), (0.001, 0.02, True), (0.002, 0.02, True), (0.005, 0.02, True),
]  # fmt: skip


def holding() -> tuple[mujoco.MjModel, mujoco.MjData, Fingertips]:
    """Return the hand with its ball, held."""
    model = hand_model()
    data = mujoco.MjData(model)
    data.ctrl[::3] = 0.2
    tips = Fingertips(model, {finger: f"{finger}_tip" for finger in FINGERS})
    mujoco.mj_step(model, data, 2000)
    if not all(load.P_newtons > 0.5 for load in tips.loads(data).values()):
        raise SystemExit("the hand dropped its ball")
    return model, data, tips


def costs() -> str:
    """Return the table of the cost: the smallest of the rounds, which is what the code costs."""
    model, data, tips = holding()
    runs: dict[str, Callable[[], object]] = {
        "load and strain": lambda: [load.microstrain for load in tips.loads(data).values()],
        "counts, F, P": lambda: [tip.P_newtons for tip in tips.read(data).values()],
        "all, status and uncertainty too":
            lambda: [(t.status, t.phi_deg, t.theta_deg, t.u_P_newtons) for t in tips.read(data).values()],
    }  # fmt: skip
    each = {"step (2 kHz)": 1, "SYNC of 500 Hz": 4, "SYNC of 100 Hz": 20}
    ways = {f"{what}; {name}": partial(_timed, model, data, run, steps)
            for name, steps in each.items() for what, run in runs.items()}  # fmt: skip
    rows = []
    for name, times in in_turns(ways, ROUNDS).items():
        physics, twin = (min(column) / STEPS * 1e6 for column in zip(*times, strict=True))
        a_finger = twin / len(FINGERS)
        rows.append([*name.split("; "), f"{physics:.1f}", f"{a_finger:.2f}", f"{a_finger / physics:.3f}"])
    header = ["of each finger", "at each", "physics step, us", "twin, us a finger and step", "over physics"]
    return table(header, rows)


def _timed(model: mujoco.MjModel, data: mujoco.MjData, run: Callable[[], object], steps: int) -> tuple[float, float]:
    """Return seconds of the physics, and of what runs after so many steps of 0.5 ms."""
    physics_s = job_s = 0.0
    for k in range(STEPS):
        start = time.perf_counter()
        mujoco.mj_step(model, data)
        middle = time.perf_counter()
        if k % steps == 0:
            run()
        job_s += time.perf_counter() - middle
        physics_s += middle - start
    return physics_s, job_s


def errors() -> str:
    """Return the table of the errors."""
    reference, largest, _ = _grasp(*REFERENCE)
    settled = round(SETTLED_S / GRID_S)
    rows = []
    for step_s, constant_s, rigid in SETTINGS:
        values, peak, run_s = _grasp(step_s, constant_s, rigid)
        error = (values - reference)[settled:]
        rms = np.sqrt(np.nanmean(error**2, axis=0)) if np.isfinite(error).any() else np.full(2, np.nan)
        rows.append([
            f"{1e3 * step_s:g}", f"{1e3 * constant_s:g}", "rigid" if rigid else "springs", f"{1e3 * rms[0]:.1f}",
            f"{rms[1]:.2f}", f"{peak / largest - 1.0:+.0%}", f"{run_s / SECONDS:.2f}",
        ])  # fmt: skip
    header = ["time step, ms", "solref, ms", "tip", "RMS of P, mN", "RMS of theta, degree", "largest P at the touch",
              "run time, s per s"]  # fmt: skip
    return table(header, rows)


def _grasp(step_s: float, constant_s: float, rigid: bool) -> tuple[FloatArray, float, float]:
    """Return P and theta of the thumb without noise on a grid, the largest P, and the seconds of computing."""
    model = grasp_model(rigid)
    model.opt.timestep = step_s
    model.geom_solref[:] = constant_s, 1.0
    data = mujoco.MjData(model)
    tips = Fingertips(model, {"thumb": "thumb_tip"}, noise_microstrain=0.0)
    rows, largest, each = [], 0.0, max(1, round(GRID_S / step_s))
    start_s = time.perf_counter()
    for k in range(1, round(SECONDS / step_s) + 1):
        data.ctrl[:2] = 2.0
        data.ctrl[2] = LIFT_M * min(max(0.0, 2.0 * (data.time - LIFT_AT_S)), 1.0)
        mujoco.mj_step(model, data)
        if data.time < SETTLED_S:
            largest = max(largest, tips.loads(data)["thumb"].P_newtons)
        if k % each == 0:
            sample = tips.read(data)["thumb"]
            rows.append((data.time, sample.P_newtons, sample.theta_deg))
    run_s = time.perf_counter() - start_s
    values = np.array(rows)
    grid = GRID_S * np.arange(1, round(SECONDS / GRID_S) + 1)
    return np.stack([np.interp(grid, values[:, 0], values[:, k]) for k in (1, 2)], axis=-1), largest, run_s


def figure() -> None:
    """Write the picture of the grasp in MuJoCo's own renderer, beside its forces."""
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
    save_figure(fig, ROOT / "docs" / "figures" / "mujoco-grasp.png", dpi=110)


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


def main() -> None:
    if arguments(__doc__, "--figure").parse_args().figure:
        figure()
    else:
        print(f"MuJoCo {mujoco.__version__}\n\n{errors()}\n\n{costs()}")


if __name__ == "__main__":
    main()
