"""How LeRobot finds the station: `--env.type=ur5e_station`. Nothing here imports a simulator."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_cqn.errors import ConfigError

from .station import CAMERAS, UR5eStation, check_settings
from .tasks import TASKS

__all__ = ["UR5eStationEnv", "gym_id"]


def gym_id(task: str) -> str:
    """Name under which gymnasium knows a task of the station."""
    return f"cqn_station/{task}-v0"


for _name, _task in TASKS.items():
    if gym_id(_name) not in gym.registry:
        gym.register(
            gym_id(_name),
            entry_point=f"{UR5eStation.__module__}:{UR5eStation.__qualname__}",
            kwargs={"task": _name},
            max_episode_steps=_task.max_episode_steps,
        )


@EnvConfig.register_subclass("ur5e_station")
@dataclass
class UR5eStationEnv(EnvConfig):
    """A simulated UR5e station: four cameras, delta joint actions, sparse reward.

    Attributes:
        task: click_button, flip_cup, open_drawer_put_teddy or take_lid_off_saucepan.
        fps: control steps a second: 5, 10, 20, 25 or 50.
        episode_length: control steps before the episode is cut off; None: the task's own (at 10 Hz: 100 for
            click_button, 250 for flip_cup, 400 for open_drawer_put_teddy, 120 for take_lid_off_saucepan), scaled
            with fps.
        obs_type: "state" (joints and the objects' simulator state), "pixels" (joints and cameras) or "both".
        cameras: which of left_shoulder, right_shoulder, upper_wrist, lower_wrist; unused with "state".
        image_size: height and width of each camera's picture, 16 to 1024 pixels.
        render_mode: "rgb_array"; the overview shown in videos.
        features: what the environment gives and takes; filled in from the other fields where not given.
        features_map: the policy's name for each feature; filled in likewise.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    task: str | None = "click_button"
    fps: int = 10
    episode_length: int | None = None
    obs_type: str = "state"
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))
    image_size: int = 84
    render_mode: str = "rgb_array"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_settings(self.task or "", self.obs_type, self.cameras, self.image_size, self.fps)
        if self.episode_length is not None and self.episode_length < 1:
            raise ConfigError(f"episode_length is {self.episode_length}: expected at least 1 step.")
        # Given entries survive; a contradiction is said here and not when the first batch is stacked.
        for name, (feature, policy_name) in self._derived().items():
            given = self.features.setdefault(name, feature)
            if tuple(given.shape) != tuple(feature.shape):
                raise ConfigError(
                    f"features['{name}'] has shape {tuple(given.shape)}, but the environment gives "
                    f"{tuple(feature.shape)}: correct or leave out the entry."
                )
            self.features_map.setdefault(name, policy_name)

    @property
    def package_name(self) -> str:
        """Module whose import registers the environment with gymnasium."""
        return __name__

    @property
    def gym_id(self) -> str:
        """Name of the environment in gymnasium's registry."""
        return gym_id(str(self.task))

    @property
    def max_episode_steps(self) -> int:
        """Control steps before an episode is cut off."""
        if self.episode_length is not None:
            return self.episode_length
        return TASKS[str(self.task)].max_episode_steps * self.fps // 10

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make`."""
        return {
            "obs_type": self.obs_type,
            "cameras": list(self.cameras),
            "image_size": self.image_size,
            "fps": self.fps,
            "render_mode": self.render_mode,
            "max_episode_steps": self.max_episode_steps,
        }

    def _derived(self) -> dict[str, tuple[PolicyFeature, str]]:
        """Each feature by the environment's name, with the policy's name for it."""
        derived = {
            ACTION: (PolicyFeature(FeatureType.ACTION, (7,)), ACTION),
            "agent_pos": (PolicyFeature(FeatureType.STATE, (7,)), OBS_STATE),
        }
        if self.obs_type != "pixels":
            size = len(TASKS[str(self.task)].state_names)
            derived["environment_state"] = (PolicyFeature(FeatureType.ENV, (size,)), OBS_ENV_STATE)
        if self.obs_type != "state":
            for camera in self.cameras:
                shape = (self.image_size, self.image_size, 3)
                # Not "pixels/<camera>": recorded evaluations refuse feature names with a slash.
                name = f"{OBS_IMAGES}.{camera}"
                derived[name] = (PolicyFeature(FeatureType.VISUAL, shape), name)
        return derived
