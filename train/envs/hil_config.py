"""How LeRobot finds gym_hil's simulation without its window: `--env.type=hil_sim`. Imports no simulator."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_cqn.errors import ConfigError, one_of

from .env_config import SimEnvConfig, Sizes, check_cameras

__all__ = ["CAMERAS", "FPS", "STATE_NAMES", "STEP", "TASKS", "HilSimEnv", "check_settings"]

FPS = 10
STEP = 0.025  # m, what 1 in the action moves the tool's target; LeRobot's own setting
CAMERAS = ("front", "wrist")
STATE_NAMES = (
    *(f"joint_{i}.pos" for i in range(1, 8)),
    *(f"joint_{i}.vel" for i in range(1, 8)),
    *("gripper.command", "tcp.x", "tcp.y", "tcp.z"),
)


class HilTask(NamedTuple):
    """One task of gym_hil: its class, the sentence that instructs it, its limit in steps and its movable objects."""

    simulation: str
    description: str
    max_episode_steps: int
    objects: tuple[str, ...]


TASKS = {
    "pick_cube": HilTask("PandaPickCubeGymEnv", "Pick up the cube.", 100, ("block",)),
    "arrange_boxes": HilTask(
        "PandaArrangeBoxesGymEnv",
        "Put each box on the field of its colour.",
        500,
        tuple(f"block{i}" for i in range(1, 6)),
    ),
}


def check_settings(task: str, obs_type: str, cameras: list[str] | tuple[str, ...], image_size: int) -> None:
    """Validate what a user may set.

    Raises:
        ConfigError: an unknown task, obs_type or camera, none or a repeated camera, or a size out of range.
    """
    if task not in TASKS:
        raise ConfigError(one_of("task", task, TASKS))
    check_cameras(obs_type, cameras, CAMERAS, image_size)


def _gym_id(task: str) -> str:
    return f"cqn_hil/{task}-v0"


for _name, _task in TASKS.items():
    if _gym_id(_name) not in gym.registry:
        gym.register(
            _gym_id(_name),
            entry_point=f"{__package__}.hil:HilSim",
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
        return Sizes(4, len(STATE_NAMES), 0 if self.obs_type == "pixels" else 3 * len(TASKS[str(self.task)].objects))

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
