"""The grasp of a ball as a gymnasium environment: observations as a controller on the bus has them."""

from typing import Any

import numpy as np
import numpy.typing as npt

from tipforce.errors import InputError, needing
from tipforce_robots.learning.observations import observation, observation_space
from tipforce_robots.mujoco.models import grasp_model
from tipforce_robots.mujoco.twin import Fingertips

with needing('gymnasium is not installed: pip install "tipforce[gymnasium]"'):
    import gymnasium
import mujoco

MOST_NEWTONS = 6.0
ASKED_NEWTONS = (1.0, 4.0)
BALL_KG = (0.03, 0.09)
EPISODE_S, LIFT_AT_S, LIFT_M = 2.0, 1.0, 0.03
_STEPS = 20  # of 0.5 ms for one action


class GraspEnv(gymnasium.Env[dict[str, Any], npt.NDArray[np.float32]]):
    """Hold a ball of 30 to 90 g with ``asked_newtons`` and lift it, 10 ms a step, for 2 s. Action (1,): motor force
    over 6 N. Reward: minus the distance of the true tip forces from it, N; -100 and the end if the ball falls."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own)

    def __init__(self, noise_microstrain: float = 0.5) -> None:
        self._model = grasp_model()
        self._data = mujoco.MjData(self._model)
        sites = {"thumb": "thumb_tip", "index": "index_tip"}
        self._tips = Fingertips(self._model, sites, noise_microstrain=noise_microstrain)
        self._inertia = self._model.body("ball").inertia / self._model.body("ball").mass
        low, high = (np.array([newtons], dtype=np.float32) for newtons in ASKED_NEWTONS)
        self._asked = low
        asked = gymnasium.spaces.Box(low, high)
        self.observation_space = gymnasium.spaces.Dict({**observation_space(2).spaces, "asked_newtons": asked})
        self.action_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode with another asked force and ball; the same for the same ``seed``."""
        super().reset(seed=seed, options=options)
        mujoco.mj_resetData(self._model, self._data)
        self._asked = self.np_random.uniform(*ASKED_NEWTONS, size=1).astype(np.float32)
        ball = self._model.body("ball")
        ball.mass[:] = self.np_random.uniform(*BALL_KG)
        ball.inertia[:] = self._inertia * ball.mass
        mujoco.mj_setConst(self._model, self._data)
        mujoco.mj_forward(self._model, self._data)
        self._tips.reset(int(self.np_random.integers(1 << 31)))
        return self._observed()

    def step(self, action: npt.NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Apply the force for 10 ms. Raises InputError for an action outside of its space."""
        if not self.action_space.contains(action):
            raise InputError(f"action {action!r}: allowed is float32 of the shape (1,) from 0 to 1")
        self._data.ctrl[:2] = MOST_NEWTONS * float(action[0])
        self._data.ctrl[2] = LIFT_M if self._data.time >= LIFT_AT_S else 0.0
        mujoco.mj_step(self._model, self._data, _STEPS)
        observed, info = self._observed()
        fallen = bool(self._data.body("ball").xpos[2] < self._data.body("hand").xpos[2] - 0.015)
        reward = -float(np.abs(info["true_newtons"] - self._asked).mean()) - (100.0 if fallen else 0.0)
        return observed, reward, fallen, bool(self._data.time >= EPISODE_S - 1e-9), info

    def _observed(self) -> tuple[dict[str, Any], dict[str, Any]]:
        samples = self._tips.read(self._data)
        loads = [sample.load for sample in samples.values()]
        info = {
            "true_newtons": np.array([load.P_newtons for load in loads]),
            "unseen_newtons": np.array([load.unseen_newtons for load in loads]),
        }
        return {**observation(samples), "asked_newtons": self._asked.copy()}, info
