"""Any LeRobot environment (`--env.type=...`) behind the `Environment` interface."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env, make_env_pre_post_processors
from lerobot.envs.utils import preprocess_observation
from lerobot.utils.constants import ACTION
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError, DataError

from .interfaces import Frame, Outcome

__all__ = ["GymEnvironment"]


class GymEnvironment:
    """One environment made by LeRobot's factory, with LeRobot's observation names and processors."""

    def __init__(self, config: EnvConfig, policy_config: PreTrainedConfig) -> None:
        try:
            suites = make_env(config, n_envs=1)
        except ImportError as error:
            raise ConfigError(f"The environment '{config.type}' is not installed: {error}") from error
        vectors = [vector for tasks in suites.values() for vector in tasks.values()]
        if len(vectors) != 1:
            raise DataError(f"Expected one task, '{config.type}' made {len(vectors)}: name one with `--env.task=`.")
        self._vector = vectors[0]
        self.env: gym.Env[Any, Any] = self._vector.envs[0]
        self._fps = int(config.fps)
        self._pre, self._post = make_env_pre_post_processors(config, policy_config)

    @property
    def max_steps(self) -> int:
        """Control steps before an episode is cut off."""
        return int(self.env.get_wrapper_attr("_max_episode_steps"))

    @property
    def fps(self) -> int:
        """Control steps a second, as LeRobot's environment config says."""
        return self._fps

    def reset(self, seed: int) -> Frame:
        """Start an episode that `seed` determines."""
        observation, _ = self.env.reset(seed=seed, options={"lerobot_new_rollout": True})
        return self._frame(observation)

    def step(self, action: torch.Tensor) -> Outcome:
        """Apply an action [1, D] in the environment's own units."""
        command = self._post({ACTION: action})[ACTION].squeeze(0).cpu().numpy()
        observation, reward, terminated, truncated, info = self.env.step(command)
        success = bool(info.get("is_success", info.get("succeed", False)))
        return Outcome(self._frame(observation), float(reward), bool(terminated), bool(truncated), success)

    def render(self) -> NDArray[Any]:
        """Picture for a person, uint8 [H, W, 3]."""
        return np.asarray(self.env.render(), dtype=np.uint8)

    def close(self) -> None:
        """Free the simulator."""
        self._vector.close()

    def _frame(self, observation: Any) -> Frame:
        frame: Frame = self._pre(preprocess_observation(observation))
        return frame
