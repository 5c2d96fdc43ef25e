"""The MuJoCo twin: its cost beside the physics step, and the error of contact parameters and time steps.

    python -m bench.twin    both tables of docs/mujoco.md; half a minute

The model of the cost is ``tipforce.mujoco.hand_model``: five fingers of three joints, each with a fingertip on its
springs, holding a ball. Physics and twin are timed in turns in one run. The errors are those of the grasp of
``tipforce.mujoco.grasp_model`` with 2 N of motor force against a reference with short steps and stiff contacts.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from bench.printed import table

from tipforce.mujoco import Fingertips, grasp_model, hand_model
from tipforce.mujoco.models import FINGERS

STEPS, ROUNDS = 100, 60
SECONDS, GRID_S, SETTLED_S, LIFT_AT_S, LIFT_M = 2.0, 0.002, 0.6, 1.0, 0.03
REFERENCE = (0.00005, 0.001, False)  # time step, time constant of the contacts, rigid
SETTINGS = [
    (0.0001, 0.002, False), (0.0005, 0.002, False), (0.0005, 0.005, False), (0.0005, 0.02, False),
    (0.0005, 0.05, False), (0.0005, 0.02, True), (0.001, 0.02, True), (0.002, 0.02, True), (0.005, 0.02, True),
]  # fmt: skip
FloatArray = npt.NDArray[np.float64]


class Job(NamedTuple):
    """What the twin does, and after how many steps of 0.5 ms."""

    what: str
    each: str
    run: Callable[[], object]
    steps: int


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
    jobs = []
    for each, steps in (("step (2 kHz)", 1), ("SYNC of 500 Hz", 4), ("SYNC of 100 Hz", 20)):
        jobs += [
            Job("load and strain", each, lambda: [one.microstrain for one in tips.loads(data).values()], steps),
            Job("counts, F, P", each, lambda: [one.P_newtons for one in tips.read(data).values()], steps),
            Job(
                "all, status and uncertainty too", each,
                lambda: [(one.status, one.phi_deg, one.theta_deg, one.u_P_newtons) for one in tips.read(data).values()],
                steps,
            ),
        ]  # fmt: skip
    found: list[list[tuple[float, float]]] = [[] for _ in jobs]
    for _ in range(ROUNDS):
        for job, times in zip(jobs, found, strict=True):
            times.append(_timed(model, data, job))
    rows = []
    for job, times in zip(jobs, found, strict=True):
        physics, twin = (min(column) / STEPS * 1e6 for column in zip(*times, strict=True))
        rows.append([job.what, job.each, f"{physics:.1f}", f"{twin / len(FINGERS):.2f}",
                     f"{twin / len(FINGERS) / physics:.3f}"])  # fmt: skip
    header = ["of each finger", "at each", "physics step, us", "twin, us a finger and step", "over physics"]
    return table(header, rows, markdown=True)


def _timed(model: mujoco.MjModel, data: mujoco.MjData, job: Job) -> tuple[float, float]:
    """Return seconds of the physics, and of the job."""
    physics_s = job_s = 0.0
    for k in range(STEPS):
        start = time.perf_counter()
        mujoco.mj_step(model, data)
        middle = time.perf_counter()
        if k % job.steps == 0:
            job.run()
        job_s += time.perf_counter() - middle
        physics_s += middle - start
    return physics_s, job_s


def errors() -> str:
    """Return the table of the errors."""
    reference, largest, _ = _grasp(*REFERENCE)
    settled = round(SETTLED_S / GRID_S)
    rows = []
    for step_s, constant_s, rigid in SETTINGS:
        found, peak, run_s = _grasp(step_s, constant_s, rigid)
        error = (found - reference)[settled:]
        rms = np.sqrt(np.nanmean(error**2, axis=0)) if np.isfinite(error).any() else np.full(2, np.nan)
        rows.append([
            f"{1e3 * step_s:g}", f"{1e3 * constant_s:g}", "rigid" if rigid else "springs", f"{1e3 * rms[0]:.1f}",
            f"{rms[1]:.2f}", f"{peak / largest - 1.0:+.0%}", f"{run_s / SECONDS:.2f}",
        ])  # fmt: skip
    header = ["time step, ms", "solref, ms", "tip", "RMS of P, mN", "RMS of theta, degree", "largest P at the touch",
              "run time, s per s"]  # fmt: skip
    return table(header, rows, markdown=True)


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
    found = np.array(rows)
    grid = GRID_S * np.arange(1, round(SECONDS / GRID_S) + 1)
    return np.stack([np.interp(grid, found[:, 0], found[:, k]) for k in (1, 2)], axis=-1), largest, run_s


if __name__ == "__main__":
    print(f"MuJoCo {mujoco.__version__}\n\n{errors()}\n\n{costs()}")
