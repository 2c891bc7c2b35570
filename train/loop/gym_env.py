"""Any LeRobot environment (`--env.type=...`) behind the interfaces of training and evaluation."""

from collections.abc import Mapping, Sequence
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

from ..interfaces import Environment, Frame, Outcome, Outcomes

__all__ = ["GymEnvironment", "GymScenes", "OneScene"]

NEW_EPISODE = {"lerobot_new_rollout": True}  # as lerobot-eval marks a reset


class _Gym:
    """Environments made by LeRobot's factory, with LeRobot's observation names and processors.

    max_steps: control steps before an episode is cut off.
    """

    def __init__(
        self, config: EnvConfig, policy_config: PreTrainedConfig, count: int = 1, *, apart: bool = False
    ) -> None:
        try:
            suites = make_env(config, n_envs=count, use_async_envs=apart)
        except ImportError as error:
            raise ConfigError(f"The environment '{config.type}' is not installed: {error}") from error
        vectors = [vector for tasks in suites.values() for vector in tasks.values()]
        if len(vectors) != 1:
            raise DataError(f"Expected one task, '{config.type}' made {len(vectors)}: name one with `--env.task=`.")
        self.vector = vectors[0]
        try:
            self.max_steps = int(self.vector.get_attr("_max_episode_steps")[0])
        except (AttributeError, TypeError) as error:
            raise ConfigError(
                f"The environment '{config.type}' says not when an episode is cut off: register it with "
                "max_episode_steps (gymnasium.register)."
            ) from error
        self._pre, self._post = make_env_pre_post_processors(config, policy_config)

    def close(self) -> None:
        """Free the simulator."""
        self.vector.close()

    def command(self, action: torch.Tensor) -> NDArray[Any]:
        """Actions [K, D] as the environment takes them."""
        values: NDArray[Any] = self._post({ACTION: action})[ACTION].cpu().numpy()
        return values

    def frame(self, observation: Any) -> Frame:
        """An observation under LeRobot's names."""
        frame: Frame = self._pre(preprocess_observation(observation))
        return frame


class GymEnvironment(_Gym):
    """One environment, stepped by itself. Raises ConfigError where it is not installed, DataError for several tasks."""

    waited_s = 0.0

    def __init__(self, config: EnvConfig, policy_config: PreTrainedConfig) -> None:
        super().__init__(config, policy_config, 1, apart=False)
        self.env: gym.Env[Any, Any] = self.vector.envs[0]
        self._fps = int(config.fps)

    @property
    def fps(self) -> int:
        """Control steps a second, as LeRobot's environment config says."""
        return self._fps

    def open(self) -> None:
        """It is ready."""

    def reset(self, seed: int) -> Frame:
        """Start an episode that `seed` determines."""
        observation, _ = self.env.reset(seed=seed, options=dict(NEW_EPISODE))
        return self.frame(observation)

    def step(self, action: torch.Tensor) -> Outcome:
        """Apply an action [1, D] in the environment's own units."""
        observation, reward, terminated, truncated, info = self.env.step(self.command(action)[0])
        success = bool(info.get("is_success", info.get("succeed", False)))
        return Outcome(self.frame(observation), float(reward), bool(terminated), bool(truncated), success)

    def action_bounds(self) -> dict[str, NDArray[Any]] | None:
        """`min` and `max` of the action, [D] each; None where the environment does not bound it."""
        space = self.env.action_space
        if not isinstance(space, gym.spaces.Box) or not space.is_bounded():
            return None
        return {"min": np.asarray(space.low, np.float32), "max": np.asarray(space.high, np.float32)}

    def render(self) -> NDArray[Any]:
        """Picture for a person, uint8 [H, W, 3]."""
        return np.asarray(self.env.render(), dtype=np.uint8)


class GymScenes(_Gym):
    """K environments of one kind; apart: each in a process of its own. Raises what `GymEnvironment` does."""

    def __init__(self, config: EnvConfig, policy_config: PreTrainedConfig, count: int, *, apart: bool = False) -> None:
        super().__init__(config, policy_config, count, apart=apart)
        self.count = count

    def reset(self, seeds: Sequence[int]) -> Frame:
        """Start an episode in each; rows [K, ...]."""
        observation, _ = self.vector.reset(seed=[int(seed) for seed in seeds], options=dict(NEW_EPISODE))
        return self.frame(observation)

    def step(self, action: torch.Tensor) -> Outcomes:
        """Apply actions [K, D]. An episode that ends is followed by another one, which the caller does not look at."""
        observation, reward, terminated, truncated, info = self.vector.step(self.command(action))
        # What an episode ended with is set aside when the next one begins within the same step.
        success = _successes(info, self.count) | _successes(info.get("final_info", {}), self.count)
        ended = np.asarray(terminated) | np.asarray(truncated) | success
        return Outcomes(self.frame(observation), np.asarray(reward, np.float64), ended, success)

    def render(self) -> Sequence[NDArray[Any]]:
        """K pictures for a person, uint8 [H, W, 3]."""
        return [np.asarray(picture, dtype=np.uint8) for picture in self.vector.call("render")]


def _successes(info: Mapping[str, Any], count: int) -> NDArray[Any]:
    """Which of `count` environments report success, [K] bool."""
    return np.asarray(info.get("is_success", info.get("succeed", np.zeros(count))), dtype=bool)


class OneScene:
    """The training environment as the only scene of an evaluation."""

    count = 1

    def __init__(self, env: Environment) -> None:
        self.env = env

    @property
    def max_steps(self) -> int:
        """Control steps before an episode is cut off."""
        return self.env.max_steps

    def reset(self, seeds: Sequence[int]) -> Frame:
        """Start an episode."""
        return self.env.reset(seeds[0])

    def step(self, action: torch.Tensor) -> Outcomes:
        """Apply an action [1, D]."""
        outcome = self.env.step(action)
        ended = outcome.success or outcome.ended
        return Outcomes(
            outcome.frame, np.array([outcome.reward]), np.array([ended]), np.array([outcome.success], dtype=bool),
            outcome.skipped,
        )  # fmt: skip

    def render(self) -> Sequence[NDArray[Any]]:
        """One picture."""
        return [self.env.render()]

    def close(self) -> None:
        """The environment is closed by who made it."""
