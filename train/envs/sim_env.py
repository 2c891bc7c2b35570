"""Base of the simulated environments: what follows from a configuration, seeding, and MuJoCo's pictures."""

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

from .cameras import Cameras
from .env_config import SimEnvConfig

__all__ = ["MujocoEnv", "Observation", "SimEnv", "box_with_gripper", "preserved_numpy_random"]

Observation = dict[str, Any]


class SimEnv(gym.Env[Observation, NDArray[np.float32]]):
    """An environment that takes its settings, its observations' space and its rate from a configuration.

    A subclass says the action space, names of all numbers, `_begin`, and gymnasium's `step`, `render` and `close`. It
    looks at `_with_state` and `_camera_names` to see what is observed beside `agent_pos`.

    Attributes:
        task, fps: of the configuration.
        observation_space: `agent_pos`, `environment_state` and `pixels`, each where the configuration has it.
        action_names: of the action's numbers; the subclass sets it.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}
    action_names: list[str]

    def __init__(self, config: SimEnvConfig) -> None:
        self.task = str(config.task)
        self.fps = config.fps
        self.render_mode = config.render_mode
        self.metadata = {**type(self).metadata, "render_fps": config.fps}  # type: ignore[misc]
        self._image_size = config.image_size
        self._camera_names = tuple(config.shown_cameras)
        sizes = config.sizes
        self._with_state = sizes.environment_state > 0
        spaces: dict[str, gym.Space[Any]] = {}
        for name, size in (("agent_pos", sizes.agent_pos), ("environment_state", sizes.environment_state)):
            if size:
                spaces[name] = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        if self._camera_names:
            image = gym.spaces.Box(0, 255, (config.image_size, config.image_size, 3), np.uint8)
            spaces["pixels"] = gym.spaces.Dict(dict.fromkeys(self._camera_names, image))
        self.observation_space = gym.spaces.Dict(spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the same `seed` gives the same episode, without one the random stream goes on.

        `options` is accepted for callers that pass marks of their own; none changes anything.
        """
        super().reset(seed=seed)
        return self._begin(seed), {"is_success": False}

    def _begin(self, seed: int | None) -> Observation:
        """Lay the scene out by `self.np_random`, which is seeded already, and observe it."""
        raise NotImplementedError

    def _checked(self, action: Any) -> NDArray[np.float64]:
        """An action as float64, (len(action_names),), clipped to the action space.

        Raises:
            DataError: another shape, or a number that is not finite.
        """
        names, values = self.action_names, np.asarray(action, dtype=np.float64)
        if values.shape != (len(names),):
            raise DataError(f"Action has shape {values.shape}: expected ({len(names)},), {', '.join(names)}.")
        if not np.isfinite(values).all():
            bad = names[int(np.flatnonzero(~np.isfinite(values))[0])]
            raise DataError(f"Action is not finite at '{bad}': expected {len(names)} finite numbers.")
        clipped: NDArray[np.float64] = np.clip(values, self.action_space.low, self.action_space.high)
        return clipped


class MujocoEnv(SimEnv):
    """An environment with a MuJoCo model; no graphics context is opened before the first picture."""

    def __init__(self, config: SimEnvConfig, model: Any) -> None:
        super().__init__(config)
        self._cameras = Cameras(model)

    def close(self) -> None:
        """Release graphics contexts; calling it twice is harmless."""
        self._cameras.close()

    def _pictures(self, data: Any, in_model: Mapping[str, str] | None = None) -> dict[str, NDArray[np.uint8]]:
        """Views of the observed cameras, by name; `in_model` has the model's name for a camera where that differs."""
        names, size = in_model or {}, self._image_size
        return {name: self._cameras.picture(data, names.get(name, name), size, size) for name in self._camera_names}


def box_with_gripper(numbers: int, limit: float) -> gym.spaces.Box:
    """Space of so many float32 within -`limit` and `limit`, and of a gripper within 0 and 1 behind them."""
    highest = np.array([limit] * numbers + [1.0], np.float32)
    lowest = np.append(-highest[:numbers], np.float32(0.0))
    return gym.spaces.Box(lowest, highest, dtype=np.float32)


@contextlib.contextmanager
def preserved_numpy_random(seed: int) -> Iterator[None]:
    """Seed numpy's global random state inside, and put the caller's back afterwards."""
    before = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(before)
