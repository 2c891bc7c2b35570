"""How LeRobot finds gym_hil's simulation without its window: `--env.type=hil_sim`. Imports no simulator."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_cqn.errors import ConfigError

from .env_config import SimEnvConfig, Sizes
from .hil import CAMERAS, FPS, STATE_SIZE, TASKS, HilSim, check_settings

__all__ = ["HilSimEnv"]


def _gym_id(task: str) -> str:
    return f"cqn_hil/{task}-v0"


for _name, _task in TASKS.items():
    if _gym_id(_name) not in gym.registry:
        gym.register(
            _gym_id(_name),
            entry_point=f"{HilSim.__module__}:{HilSim.__qualname__}",
            kwargs={"task": _name},
            max_episode_steps=_task.max_episode_steps,
        )


@EnvConfig.register_subclass("hil_sim")
@dataclass
class HilSimEnv(SimEnvConfig):
    """gym_hil's Franka arm, seeded and headless: movements of the tool and a gripper, sparse reward.

    Attributes:
        task: pick_cube or arrange_boxes.
        fps: control steps a second, 10.
        random_position: whether the cube of pick_cube starts anywhere in a field of 20 x 30 cm; else always at one
            place. The boxes of arrange_boxes always change places.
        episode_length: control steps before the episode is cut off; None: 100, and 500 for arrange_boxes.
        obs_type: "state" (arm and the objects' positions), "pixels" (arm and cameras) or "both".
        cameras: which of front, wrist; unused with "state".
        The others are those of `SimEnvConfig`.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    task: str | None = "pick_cube"  # pick_cube or arrange_boxes
    fps: int = FPS  # gym_hil's
    random_position: bool = True  # objects placed anew in each episode
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))  # front, wrist

    def check(self) -> None:
        """Validate what a user may set. Raises ConfigError."""
        check_settings(self.task or "", self.obs_type, self.cameras, self.image_size)
        if self.fps != FPS:
            raise ConfigError(f"fps is {self.fps}: expected {FPS}, the rate of gym_hil's controller.")

    @property
    def sizes(self) -> Sizes:
        """Movement and gripper; gym_hil's state of the arm; a position an object."""
        return Sizes(4, STATE_SIZE, 0 if self.obs_type == "pixels" else 3 * len(TASKS[str(self.task)].objects))

    @property
    def gym_id(self) -> str:
        """Name of the environment in gymnasium's registry."""
        return _gym_id(str(self.task))

    @property
    def usual_steps(self) -> int:
        """Control steps before an episode of the task is cut off, where the user does not say."""
        return TASKS[str(self.task)].max_episode_steps

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make`."""
        return {**super().gym_kwargs, "random_position": self.random_position}
