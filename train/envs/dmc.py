"""The DeepMind Control suite behind gymnasium's interface, with fast pictures."""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from .cameras import RENDER_SIZE, make_lean
from .dmc_config import TASKS, DMCEnv
from .env_config import check_name
from .sim_env import MujocoEnv, Observation
from .simulator import load_mujoco, needed

__all__ = ["ControlSuite"]

# Where the suite's first camera does not show the animal well: from far above, or the ball alone.
_CAMERA_NUMBERS = {"quadruped": 2, "dog-fetch": 2}


class ControlSuite(MujocoEnv):
    """One of the suite's tasks.

    Action, (A,) float32 in [-1, 1], stretched to the task's own bounds. Values out of range are clipped.

    Observation:
        agent_pos: (S,) float32, all of the task's observations one after the other; not with "pixels".
        pixels: one (image_size, image_size, 3) uint8; not with "state".

    Reward: the sum of the suite's, 0 to 1 each, over the repeated steps. There is no success: `info["is_success"]` is
    always False. An episode ends by time; it is terminated only where a task says so by a discount of 0.

    Attributes:
        task, task_description: domain and task as dm_control names them, and the same in words.
        state_names, action_names: of `agent_pos` and the action.
        suite: dm_control's environment (`control.Environment`).
    """

    def __init__(self, **settings: Any) -> None:
        """Build the scene from fields of `DMCEnv`.

        Raises:
            ConfigError: a setting that `DMCEnv` refuses, or dm_control is missing.
        """
        config = DMCEnv(**settings)
        domain, name = str(config.task).split("-", 1)
        self.suite = _load(domain, name)
        model = self.suite.physics.model.ptr
        make_lean(model, config.image_size)
        super().__init__(config, model)
        self._camera = model.camera(_CAMERA_NUMBERS.get(self.task, _CAMERA_NUMBERS.get(domain, 0))).name
        self._with_numbers = config.sizes.agent_pos > 0
        self._repeat = config.repeat
        self._over = True
        self.task_description = f"{domain} {name}".replace("_", " ")
        bounds = self.suite.action_spec()
        self._low, self._high = np.asarray(bounds.minimum), np.asarray(bounds.maximum)
        self.action_names = [model.actuator(i).name or f"actuator_{i}" for i in range(model.nu)]
        self.state_names = [
            f"{key}_{i}" for key, spec in self.suite.observation_spec().items() for i in range(int(np.prod(spec.shape)))
        ]
        self.action_space = gym.spaces.Box(-1.0, 1.0, self._low.shape, np.float32)

    def _begin(self, seed: int | None) -> Observation:
        """Lay the scene out; an episode follows from its seed alone."""
        # The task draws from a generator of its own, of numpy's older kind, seeded with 32 bits.
        self.suite.task.random.seed(int(self.np_random.integers(2**32)))
        self._over = False
        return self._observe(self.suite.reset())

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for `action_repeat` suite steps, or until the episode's end.

        Raises:
            DataError: the action is not A finite numbers.
            gymnasium.error.ResetNeeded: the episode is over.
        """
        checked = self._checked(action)
        if self._over:
            # The suite would begin another episode unasked.
            raise gym.error.ResetNeeded("The episode is over: call reset() before the next step().")
        wanted = self._low + (checked + 1.0) / 2.0 * (self._high - self._low)
        reward = 0.0
        for _ in range(self._repeat):
            moment = self.suite.step(wanted)
            reward += float(moment.reward or 0.0)
            if moment.last():
                break
        self._over = bool(moment.last())
        terminated = self._over and moment.discount == 0.0
        return self._observe(moment), reward, terminated, self._over and not terminated, {"is_success": False}

    def render(self) -> NDArray[np.uint8]:
        """View of the camera, (360, 480, 3) uint8 RGB."""
        return self._cameras.picture(self.suite.physics.data.ptr, self._camera, *RENDER_SIZE)

    def _observe(self, moment: Any) -> Observation:
        observation: Observation = {}
        if self._with_numbers:
            parts = [np.ravel(value) for value in moment.observation.values()]
            observation["agent_pos"] = np.concatenate(parts).astype(np.float32)
        if self._camera_names:
            observation["pixels"] = self._pictures(self.suite.physics.data.ptr, {"camera0": self._camera})
        return observation


def _load(domain: str, task: str) -> Any:
    """One of dm_control's environments; its seed matters only where the scene itself is drawn at random."""
    with needed("The DeepMind Control suite needs dm-control", "dmc"):
        load_mujoco()
        from dm_control import suite
    known = {f"{one}-{other}" for one, other in suite.ALL_TASKS} & set(TASKS)
    check_name("task of this dm-control", f"{domain}-{task}", known)
    return suite.load(domain, task, task_kwargs={"random": 0})
