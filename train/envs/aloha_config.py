"""Settings of gym_aloha with small pictures, `--env.type=aloha_small`. No simulator is imported here."""

from dataclasses import dataclass, field
from typing import NamedTuple

from lerobot.envs.configs import EnvConfig

from .env_config import REWARDS, SimEnvConfig, Sizes, check_name, register

__all__ = ["JOINTS", "TASKS", "AlohaSmallEnv"]

_LIMIT = 400  # steps, as in the public datasets
_CAMERAS = ("top", "angle", "front_close", "left_wrist", "right_wrist")
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

    gym_name = "cqn_aloha/{task}-v0"
    tasks = TASKS
    known_cameras = _CAMERAS
    rates = (50,)
    rates_are = "gym_aloha's own"

    task: str | None = "transfer_cube"  # transfer_cube or insertion
    fps: int = 50  # gym_aloha's
    obs_type: str = "pixels"  # state, pixels or both
    cameras: list[str] = field(default_factory=lambda: ["top"])  # or angle, front_close, left_wrist, right_wrist
    reward: str = "sparse"  # 1 at success, or "dense": the stages

    def check(self) -> None:
        """Validate what a user may set. Raises ConfigError."""
        super().check()
        check_name("reward", self.reward, REWARDS)

    @property
    def sizes(self) -> Sizes:
        """Six joints and a gripper an arm, twice, and a pose of seven an object."""
        return Sizes(14, 14, 0 if self.obs_type == "pixels" else 7 * len(TASKS[str(self.task)].objects))

    @property
    def usual_steps(self) -> int:
        return _LIMIT


register(AlohaSmallEnv, "aloha:Aloha")
