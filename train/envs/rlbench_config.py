"""How LeRobot finds RLBench: `--env.type=rlbench`. Imports no simulator."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from lerobot.envs.configs import EnvConfig

from lerobot_cqn.errors import ConfigError

from .env_config import SimEnvConfig, Sizes
from .rlbench import CAMERAS, FPS, TASKS, RLBenchGym, check_settings

__all__ = ["RLBenchEnv"]


def _gym_id(task: str) -> str:
    return f"cqn_rlbench/{task}-v0"


for _name, _limit in TASKS.items():
    if _gym_id(_name) not in gym.registry:
        gym.register(
            _gym_id(_name),
            entry_point=f"{RLBenchGym.__module__}:{RLBenchGym.__qualname__}",
            kwargs={"task": _name},
            max_episode_steps=_limit,
        )


@EnvConfig.register_subclass("rlbench")
@dataclass
class RLBenchEnv(SimEnvConfig):
    """RLBench's tasks as the paper uses them: four cameras, delta joint actions, sparse reward.

    Its demonstrations come from RLBench's dataset generator through `cqn-data convert` and `cqn-data delta`. It runs
    where RLBench, PyRep and CoppeliaSim are installed, one environment a process.

    Attributes:
        task: one of the paper's 20, as take_lid_off_saucepan.
        fps: control steps a second, 20.
        variation: RLBench's variation of the task, 0 in the paper.
        episode_length: control steps before the episode is cut off; None: the paper's, 100 to 225.
        obs_type: "pixels" (joints and cameras).
        cameras: which of front, wrist, left_shoulder, right_shoulder.
        The others are those of `SimEnvConfig`.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    task: str | None = "take_lid_off_saucepan"  # one of the paper's 20
    fps: int = FPS  # RLBench's
    variation: int = 0  # of the task
    obs_type: str = "pixels"  # the only one
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))  # front, wrist, shoulders

    def check(self) -> None:
        """Validate what a user may set. Raises ConfigError."""
        check_settings(self.task or "", self.obs_type, self.cameras, self.image_size, self.variation)
        if self.fps != FPS:
            raise ConfigError(f"fps is {self.fps}: expected {FPS}, a step of RLBench's simulation is 0.05 s.")

    @property
    def sizes(self) -> Sizes:
        """Seven joints and the gripper, twice."""
        return Sizes(8, 8, 0)

    @property
    def gym_id(self) -> str:
        """Name of the environment in gymnasium's registry."""
        return _gym_id(str(self.task))

    @property
    def usual_steps(self) -> int:
        """Control steps before an episode of the task is cut off, where the user does not say."""
        return TASKS[str(self.task)]

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make`."""
        return {**super().gym_kwargs, "variation": self.variation}
