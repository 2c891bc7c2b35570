"""gym_pusht with sparse reward and pictures of the size that was asked for."""

import os
import warnings
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from .pusht_config import KEYPOINTS, PushtSmallEnv
from .sim_env import Observation, SimEnv
from .simulator import needed

__all__ = ["PushT"]

_WORLD = 512.0  # units a side
_RENDER_SIZE = 384  # pixels a side of `render()`


class PushT(SimEnv):
    """A disc pushes a T onto a drawn one, at 10 Hz; physics, start and success are gym_pusht's own.

    Action, (2,) float32: the place the disc is sent to, x and y in 0 to 512, absolute. Values out of range are
    clipped.

    Observation:
        agent_pos: (2,) float32, the disc's x and y.
        environment_state: (16,) float32, x and y of the T's eight corners; not with "pixels".
        pixels: (image_size, image_size, 3) uint8, one picture without a camera's name; not with "state".

    Success: the T covers 95 % of the drawn one; it ends the episode. Reward "sparse": 1 on success, else 0; "dense":
    the covered share of what success asks for, 0 to 1. `info["is_success"]` is always present, after a step
    `info["coverage"]` too.

    Attributes:
        task, task_description: "pusht", and the sentence that instructs it.
        state_names, action_names, environment_state_names: of the numbers above.
        action_kind: "command": each action stands for itself, so that leaving steps out changes no other.
    """

    action_kind: ClassVar[str] = "command"

    def __init__(self, **settings: Any) -> None:
        """Build the scene from fields of `PushtSmallEnv`.

        Raises:
            ConfigError: a setting that `PushtSmallEnv` refuses, or gym_pusht is missing.
        """
        config = PushtSmallEnv(**settings)
        size = config.image_size
        self._simulator = _load()(
            obs_type="environment_state_agent_pos",
            observation_width=size,
            observation_height=size,
            visualization_width=_RENDER_SIZE,
            visualization_height=_RENDER_SIZE,
        )
        # The disc may be sent beyond the walls, and the T is pushed through them now and then: no bounds.
        super().__init__(config)
        self._with_picture = config.obs_type != "state"
        if self._with_picture:
            self.observation_space.spaces["pixels"] = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        self._dense = config.reward == "dense"
        self.task_description = "Push the T-shaped block onto the T-shaped target."
        self.state_names = ["x", "y"]
        self.action_names = ["x", "y"]
        self.environment_state_names = [f"corner{i}.{axis}" for i in range(KEYPOINTS // 2) for axis in "xy"]
        self.action_space = gym.spaces.Box(0.0, _WORLD, (2,), np.float32)

    def _begin(self, seed: int | None) -> Observation:
        """Lay the scene out as gym_pusht does for the seed; without one the stream goes on."""
        observation, _ = self._simulator.reset(seed=seed)
        return self._observe(observation)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 0.1 s.

        Raises:
            DataError: the action is not two finite numbers.
        """
        checked = self._checked(action)
        observation, coverage, _, _, info = self._simulator.step(checked)
        success = bool(info["is_success"])
        reward = float(coverage) if self._dense else float(success)
        facts = {"is_success": success, "coverage": float(info["coverage"])}
        return self._observe(observation), reward, success, False, facts

    def render(self) -> NDArray[np.uint8]:
        """The whole scene with the last action, (384, 384, 3) uint8 RGB."""
        return np.asarray(self._simulator.render(), np.uint8)

    def close(self) -> None:
        """Nothing is held open."""
        self._simulator.close()

    def _observe(self, native: dict[str, Any]) -> Observation:
        observation: Observation = {"agent_pos": np.asarray(native["agent_pos"], np.float32)}
        if self._with_state:
            observation["environment_state"] = np.asarray(native["environment_state"], np.float32)
        if self._with_picture:
            observation["pixels"] = np.asarray(self._simulator._render(), np.uint8)
        return observation


def _load() -> Any:
    """gym_pusht's class. Raises ConfigError when it is not installed."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it greets on stdout
    with needed("The environment 'pusht_small' needs gym_pusht", "pusht"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pygame's, about how it looks for its own files
        from gym_pusht.envs import PushTEnv
    return PushTEnv
