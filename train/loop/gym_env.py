"""Any LeRobot environment (`--env.type=...`) behind the interfaces of training and evaluation."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env, make_env_pre_post_processors
from lerobot.envs.utils import env_to_policy_features, preprocess_observation
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_IMAGES
from numpy.typing import NDArray

from lerobot_cqn.base_policy import RLPolicy
from lerobot_cqn.errors import ConfigError, DataError
from lerobot_cqn.schema import BASE_ACTION

from ..interfaces import Environment, Frame, Outcome, Outcomes

__all__ = ["GymEnvironment", "GymScenes", "OneScene", "check_fits"]

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
        # Where there are steps, they expect the pictures as LeRobot makes them, floats.
        pictures = Frame() if self._pre.steps else _pictures(observation)
        rest = {name: value for name, value in observation.items() if name != "pixels"} if pictures else observation
        frame: Frame = self._pre(preprocess_observation(rest) | pictures)
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
        """Nothing: it is ready."""

    def reset(self, seed: int) -> Frame:
        """Start an episode that `seed` determines."""
        observation, _ = self.env.reset(seed=seed, options=dict(NEW_EPISODE))
        return self.frame(observation)

    def step(self, action: torch.Tensor) -> Outcome:
        """Apply an action [1, D] in the environment's own units."""
        observation, reward, terminated, truncated, info = self.env.step(self.command(action)[0])
        success = bool(info.get("is_success", info.get("succeed", False)))
        return Outcome(
            frame=self.frame(observation),
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
            success=success,
        )

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
        return Outcomes(
            frame=self.frame(observation), reward=np.asarray(reward, np.float64), ended=ended, success=success
        )

    def render(self) -> Sequence[NDArray[Any]]:
        """K pictures for a person, uint8 [H, W, 3]."""
        return [np.asarray(picture, dtype=np.uint8) for picture in self.vector.call("render")]


def _pictures(observation: Mapping[str, Any]) -> Frame:
    """Pictures as the environment gave them, uint8 [K, 3, H, W], under LeRobot's names.

    None at all where one is not uint8 with its channels last: LeRobot says what is wrong with it.
    """
    pixels, frame = observation.get("pixels", {}), Frame()
    several = isinstance(pixels, Mapping)
    named = {f"{OBS_IMAGES}.{name}": picture for name, picture in pixels.items()} if several else {OBS_IMAGE: pixels}
    for key, picture in named.items():
        if picture.dtype != np.uint8 or picture.shape[-1] >= min(picture.shape[-3:-1]):
            return Frame()
        channels_first = np.moveaxis(picture, -1, -3)
        # A copy: an environment may draw its next picture into the same memory.
        frame[key] = torch.from_numpy(np.array(channels_first, order="C").reshape(-1, *channels_first.shape[-3:]))
    return frame


def _successes(info: Mapping[str, Any], count: int) -> NDArray[Any]:
    """Success as `count` environments report it, [K] bool."""
    return np.asarray(info.get("is_success", info.get("succeed", np.zeros(count))), dtype=bool)


def check_fits(env: EnvConfig, policy: RLPolicy, source: str) -> None:
    """Environment and policy must speak of the same things. Raises ConfigError, in one line, where they do not.

    source: where the policy's features come from, for the message.
    """
    given, needed = env_to_policy_features(env), policy.config.input_features or {}
    for key, feature in needed.items():
        if key == BASE_ACTION:  # the base's own, beside what the environment gives
            continue
        if key not in given:
            raise ConfigError(
                f"The {source} has '{key}', which the environment does not give (it gives {sorted(given)}): "
                "change --env.obs_type / --env.cameras, or train on a dataset with these features."
            )
        if tuple(given[key].shape) != tuple(feature.shape):
            raise ConfigError(
                f"'{key}' has shape {tuple(given[key].shape)} in the environment, but {tuple(feature.shape)} in the "
                f"{source}: "
                + (
                    "set --env.image_size or resize the dataset (cqn-data resize)."
                    if feature.type is FeatureType.VISUAL
                    else "use the environment of the demonstrations."
                )
            )
    unseen = [key for key, f in given.items() if f.type is FeatureType.VISUAL and key not in needed]
    if unseen:
        raise ConfigError(
            f"The {source} has not the environment's camera '{unseen[0]}': leave it out (--env.cameras, or "
            "--env.obs_type=state for none), or use a dataset with it."
        )
    action = next(f for f in given.values() if f.type is FeatureType.ACTION)
    if action.shape[0] != policy.action_dims:
        raise ConfigError(
            f"The environment's action has {action.shape[0]} dimensions, the {source}'s "
            f"{policy.action_dims}: use the environment the demonstrations were recorded in."
        )


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
            frame=outcome.frame,
            reward=np.array([outcome.reward]),
            ended=np.array([ended]),
            success=np.array([outcome.success], dtype=bool),
            skipped=outcome.skipped,
        )

    def render(self) -> Sequence[NDArray[Any]]:
        """One picture."""
        return [self.env.render()]

    def close(self) -> None:
        """The environment is closed by who made it."""
