"""How LeRobot finds the station: `--env.type=ur5e_station`. Nothing here imports a simulator."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from ..env_config import SimEnvConfig, Sizes
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
class UR5eStationEnv(SimEnvConfig):
    """A simulated UR5e station: four cameras, delta joint actions, sparse reward.

    Attributes:
        task: click_button, flip_cup, open_drawer_put_teddy or take_lid_off_saucepan.
        fps: control steps a second: 5, 10, 20, 25 or 50.
        episode_length: control steps before the episode is cut off; None: the task's own (at 10 Hz: 100 for
            click_button, 250 for flip_cup, 400 for open_drawer_put_teddy, 120 for take_lid_off_saucepan), scaled
            with fps.
        obs_type: "state" (joints and the objects' simulator state), "pixels" (joints and cameras) or "both".
        cameras: which of left_shoulder, right_shoulder, upper_wrist, lower_wrist; unused with "state".
        The others are those of `SimEnvConfig`.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    task: str | None = "click_button"  # or take_lid_off_saucepan, flip_cup, open_drawer_put_teddy
    fps: int = 10  # control steps a second: 5, 10, 20, 25 or 50
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))  # left/right_shoulder, upper/lower_wrist

    def check(self) -> None:
        """Validate what a user may set. Raises ConfigError."""
        check_settings(self.task or "", self.obs_type, self.cameras, self.image_size, self.fps)

    @property
    def sizes(self) -> Sizes:
        """Six joints and the gripper, twice, and the objects of the task."""
        return Sizes(7, 7, 0 if self.obs_type == "pixels" else len(TASKS[str(self.task)].state_names))

    @property
    def gym_id(self) -> str:
        """Name of the environment in gymnasium's registry."""
        return gym_id(str(self.task))

    @property
    def usual_steps(self) -> int:
        """Control steps before an episode of the task is cut off, where the user does not say."""
        return TASKS[str(self.task)].max_episode_steps * self.fps // 10

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make`."""
        return {**super().gym_kwargs, "fps": self.fps}
