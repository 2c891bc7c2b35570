"""How LeRobot finds gym_aloha with small pictures: `--env.type=aloha_small`. Imports no simulator."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_cqn.errors import ConfigError, one_of

from .env_config import SimEnvConfig, Sizes, check_cameras

__all__ = ["CAMERAS", "FPS", "JOINTS", "REWARDS", "TASKS", "AlohaSmallEnv", "check_settings"]

FPS = 50
LIMIT = 400  # steps, as in the public datasets
CAMERAS = ("top", "angle", "front_close", "left_wrist", "right_wrist")
REWARDS = ("sparse", "dense")
_ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
JOINTS = tuple(f"{side}_{joint}" for side in ("left", "right") for joint in _ARM)


class AlohaTask(NamedTuple):
    """The sentence that instructs a task, and the objects in its state."""

    description: str
    objects: tuple[str, ...]


TASKS = {
    "transfer_cube": AlohaTask("Pick up the cube with the right arm and transfer it to the left arm.", ("cube",)),
    "insertion": AlohaTask("Insert the peg into the socket.", ("peg", "socket")),
}


def _gym_id(task: str) -> str:
    return f"cqn_aloha/{task}-v0"


for _name in TASKS:
    if _gym_id(_name) not in gym.registry:
        gym.register(
            _gym_id(_name),
            # As text: the module is imported when an environment is made.
            entry_point=f"{__package__}.aloha:Aloha",
            kwargs={"task": _name},
            max_episode_steps=LIMIT,
        )


def check_settings(
    task: str, obs_type: str, cameras: list[str] | tuple[str, ...], image_size: int, reward: str
) -> None:
    """Validate what a user may set. Raises ConfigError."""
    if task not in TASKS:
        raise ConfigError(one_of("task", task, TASKS))
    check_cameras(obs_type, cameras, CAMERAS, image_size)
    if reward not in REWARDS:
        raise ConfigError(one_of("reward", reward, REWARDS))


@EnvConfig.register_subclass("aloha_small")
@dataclass
class AlohaSmallEnv(SimEnvConfig):
    """gym_aloha: two arms, absolute joint positions. Features as in `lerobot/aloha_sim_transfer_cube_human`, smaller.

    A policy trained on that dataset after `cqn-data resize --size='[84, 84]'` runs here: the picture shows the same
    4:3 view, squeezed to a square.

    Attributes:
        task: transfer_cube or insertion.
        fps: control steps a second, 50.
        episode_length: control steps before the episode is cut off; None: 400.
        obs_type: "pixels" (arms and cameras), "state" (arms and the objects' poses) or "both".
        cameras: which of top (the datasets' only one), angle, front_close, left_wrist, right_wrist; unused with
            "state".
        reward: "sparse" (1 on success) or "dense" (a quarter for each stage reached, 0 to 1).
        The others are those of `SimEnvConfig`.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    task: str | None = "transfer_cube"  # transfer_cube or insertion
    fps: int = FPS  # gym_aloha's
    obs_type: str = "pixels"  # state, pixels or both
    cameras: list[str] = field(default_factory=lambda: ["top"])  # or angle, front_close, left_wrist, right_wrist
    reward: str = "sparse"  # 1 at success, or "dense": the stages

    def check(self) -> None:
        """Validate what a user may set. Raises ConfigError."""
        check_settings(self.task or "", self.obs_type, self.cameras, self.image_size, self.reward)
        if self.fps != FPS:
            raise ConfigError(f"fps is {self.fps}: expected {FPS}, gym_aloha's own.")

    @property
    def sizes(self) -> Sizes:
        """Six joints and a gripper an arm, twice, and a pose of seven an object."""
        return Sizes(14, 14, 0 if self.obs_type == "pixels" else 7 * len(TASKS[str(self.task)].objects))

    @property
    def gym_id(self) -> str:
        """Name of the environment in gymnasium's registry."""
        return _gym_id(str(self.task))

    @property
    def usual_steps(self) -> int:
        """Control steps before an episode of the task is cut off, where the user does not say."""
        return LIMIT

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make`."""
        return {**super().gym_kwargs, "reward": self.reward}
