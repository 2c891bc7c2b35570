"""Settings of the station, `--env.type=ur5e_station`. No simulator is imported here."""

from dataclasses import dataclass, field

from lerobot.envs.configs import EnvConfig

from ..env_config import SimEnvConfig, Sizes, register
from .tasks import TASKS

__all__ = ["CAMERAS", "UR5eStationEnv"]

CAMERAS = ("left_shoulder", "right_shoulder", "upper_wrist", "lower_wrist")


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

    gym_name = "cqn_station/{task}-v0"
    tasks = TASKS
    known_cameras = CAMERAS
    action_kind = "differences"
    rates = (5, 10, 20, 25, 50)
    rates_are = "whole physics steps of 4 ms"

    task: str | None = "click_button"  # or take_lid_off_saucepan, flip_cup, open_drawer_put_teddy
    fps: int = 10  # control steps a second: 5, 10, 20, 25 or 50
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))  # left/right_shoulder, upper/lower_wrist

    @property
    def sizes(self) -> Sizes:
        """Six joints and the gripper, twice, and the objects of the task."""
        return Sizes(7, 7, 0 if self.obs_type == "pixels" else len(TASKS[str(self.task)].state_names))

    @property
    def usual_steps(self) -> int:
        return TASKS[str(self.task)].max_episode_steps * self.fps // 10


register(UR5eStationEnv, "ur5e_station.station:UR5eStation")
