"""Settings of gym_hil's simulation, `--env.type=hil_sim`. No simulator is imported here."""

from dataclasses import dataclass, field
from typing import NamedTuple

from lerobot.envs.configs import EnvConfig

from .env_config import SimEnvConfig, Sizes, register

__all__ = ["STATE_NAMES", "STEP", "TASKS", "HilSimEnv"]

STEP = 0.025  # m, what 1 in the action moves the tool's target; LeRobot's own setting
_CAMERAS = ("front", "wrist")
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

    gym_name = "cqn_hil/{task}-v0"
    tasks = TASKS
    known_cameras = _CAMERAS
    rates = (10,)
    rates_are = "the rate of gym_hil's controller"

    task: str | None = "pick_cube"  # pick_cube or arrange_boxes
    fps: int = 10  # gym_hil's
    random_position: bool = True  # objects placed anew in each episode
    cameras: list[str] = field(default_factory=lambda: list(_CAMERAS))  # front, wrist

    @property
    def sizes(self) -> Sizes:
        """Movement and gripper; gym_hil's state of the arm; a position an object."""
        return Sizes(4, len(STATE_NAMES), 0 if self.obs_type == "pixels" else 3 * len(TASKS[str(self.task)].objects))

    @property
    def usual_steps(self) -> int:
        return TASKS[str(self.task)].max_episode_steps


register(HilSimEnv, "hil:HilSim")
