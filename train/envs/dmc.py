"""The DeepMind Control suite behind gymnasium's interface, with fast pictures."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError, one_of

from .cameras import Cameras
from .common import RENDER_SIZE, checked_action, dict_space, make_lean
from .dmc_config import CAMERAS, TASKS, check_settings, default_repeat
from .simulator import load_mujoco

__all__ = ["ControlSuite"]

# Where the suite's first camera does not show the animal well: from far above, or the ball alone.
_CAMERA_NUMBERS = {"quadruped": 2, "dog-fetch": 2}

Observation = dict[str, Any]


class ControlSuite(gym.Env[Observation, NDArray[np.float32]]):
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
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 100}

    def __init__(
        self,
        task: str = "cartpole-swingup",
        obs_type: str = "state",
        cameras: list[str] | tuple[str, ...] = CAMERAS,
        image_size: int = 84,
        action_repeat: int | None = None,
        render_mode: str | None = "rgb_array",
    ) -> None:
        """Build the scene; no graphics context is opened before the first picture.

        Raises:
            ConfigError: an unknown task, obs_type or camera; a size or repeat out of range; dm_control is missing.
        """
        check_settings(task, obs_type, cameras, image_size, action_repeat)
        domain, name = task.split("-", 1)
        self._suite = _load(domain, name)
        physics = self._suite.physics
        model = physics.model.ptr
        make_lean(model, image_size)
        self._cameras = Cameras(model)
        self._camera = model.camera(_CAMERA_NUMBERS.get(task, _CAMERA_NUMBERS.get(domain, 0))).name
        self._camera_names = tuple(cameras) if obs_type != "state" else ()
        self._with_state = obs_type != "pixels"
        self._image_size = image_size
        self._repeat = default_repeat(obs_type) if action_repeat is None else action_repeat
        self._over = True
        self.render_mode = render_mode
        step_s = self._suite.control_timestep() * self._repeat
        self.metadata = {**type(self).metadata, "render_fps": max(1, round(1 / step_s))}  # type: ignore[misc]
        self.task = task
        self.task_description = f"{domain} {name}".replace("_", " ")
        bounds = self._suite.action_spec()
        self._low, self._high = np.asarray(bounds.minimum), np.asarray(bounds.maximum)
        self.action_names = [model.actuator(i).name or f"actuator_{i}" for i in range(model.nu)]
        self.state_names = [
            f"{key}_{i}"
            for key, spec in self._suite.observation_spec().items()
            for i in range(int(np.prod(spec.shape)))
        ]
        self.action_space = gym.spaces.Box(-1.0, 1.0, self._low.shape, np.float32)
        size = len(self.state_names) if self._with_state else 0
        self.observation_space = dict_space(size, 0, self._camera_names, image_size)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the same `seed` gives the same episode, without one the random stream goes on.

        `options` is accepted for callers that pass marks of their own; none changes anything.
        """
        super().reset(seed=seed)
        # The task draws from a generator of its own, of numpy's older kind, seeded with 32 bits.
        self._suite.task.random.seed(int(self.np_random.integers(2**32)))
        self._over = False
        return self._observe(self._suite.reset()), {"is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for `action_repeat` suite steps, or until the episode's end.

        Raises:
            DataError: the action is not A finite numbers.
            gymnasium.error.ResetNeeded: the episode is over.
        """
        checked = checked_action(action, self.action_space, self.action_names)
        if self._over:
            # The suite would begin another episode unasked.
            raise gym.error.ResetNeeded("The episode is over: call reset() before the next step().")
        wanted = self._low + (checked + 1.0) / 2.0 * (self._high - self._low)
        reward = 0.0
        for _ in range(self._repeat):
            moment = self._suite.step(wanted)
            reward += float(moment.reward or 0.0)
            if moment.last():
                break
        self._over = bool(moment.last())
        terminated = self._over and moment.discount == 0.0
        return self._observe(moment), reward, terminated, self._over and not terminated, {"is_success": False}

    def render(self) -> NDArray[np.uint8]:
        """What the camera sees, (360, 480, 3) uint8 RGB."""
        return self._cameras.picture(self._suite.physics.data.ptr, self._camera, *RENDER_SIZE)

    def close(self) -> None:
        """Release graphics contexts; calling it twice is harmless."""
        self._cameras.close()

    @property
    def suite(self) -> Any:
        """dm_control's environment (`control.Environment`)."""
        return self._suite

    def _observe(self, moment: Any) -> Observation:
        observation: Observation = {}
        if self._with_state:
            parts = [np.ravel(value) for value in moment.observation.values()]
            observation["agent_pos"] = np.concatenate(parts).astype(np.float32)
        if self._camera_names:
            size, data = self._image_size, self._suite.physics.data.ptr
            observation["pixels"] = {
                name: self._cameras.picture(data, self._camera, size, size) for name in self._camera_names
            }
        return observation


def _load(domain: str, task: str) -> Any:
    """One of dm_control's environments; its seed matters only where the scene itself is drawn at random."""
    try:
        load_mujoco()
        from dm_control import suite
    except (ImportError, ConfigError) as error:
        raise ConfigError(
            "The DeepMind Control suite needs dm-control, which is not installed: "
            "run `pip install 'lerobot_policy_cqn[dmc]'`."
        ) from error
    if (domain, task) not in suite.ALL_TASKS:
        known = [f"{one}-{other}" for one, other in suite.ALL_TASKS if f"{one}-{other}" in TASKS]
        raise ConfigError(one_of("task of this dm-control", f"{domain}-{task}", known))
    return suite.load(domain, task, task_kwargs={"random": 0})
