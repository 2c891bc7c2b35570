"""Settings of RLBench, `--env.type=rlbench`. No simulator is imported here."""

from dataclasses import dataclass, field

from lerobot.envs.configs import EnvConfig

from lerobot_cqn.errors import ConfigError

from .env_config import SimEnvConfig, Sizes, register

__all__ = ["CAMERAS", "TASKS", "RLBenchEnv"]

CAMERAS = ("front", "wrist", "left_shoulder", "right_shoulder")

# The paper's 20 tasks and its limits in steps.
TASKS = {
    "take_lid_off_saucepan": 100,
    "open_drawer": 100,
    "stack_wine": 150,
    "toilet_seat_up": 150,
    "open_microwave": 125,
    "open_oven": 225,
    "take_plate_off_colored_dish_rack": 150,
    "turn_tap": 125,
    "put_money_in_safe": 150,
    "phone_on_base": 175,
    "put_books_on_bookshelf": 175,
    "sweep_to_dustpan": 100,
    "pick_up_cup": 100,
    "open_door": 125,
    "meat_on_grill": 150,
    "basketball_in_hoop": 125,
    "lamp_on": 100,
    "press_switch": 100,
    "put_rubbish_in_bin": 150,
    "insert_usb_in_computer": 100,
}


@EnvConfig.register_subclass("rlbench")
@dataclass
class RLBenchEnv(SimEnvConfig):
    """RLBench's tasks as the paper uses them: four cameras, sparse reward, joint goals, also for differences.

    Its demonstrations come from RLBench's dataset generator through `cqn-data convert` and `cqn-data delta`. It runs
    where RLBench, PyRep and CoppeliaSim are installed, one environment a process.

    Attributes:
        task: one of the paper's 20, as take_lid_off_saucepan.
        fps: control steps a second, 20.
        variation: RLBench's variation of the task, 0 in the paper.
        episode_length: control steps before the episode is cut off; None: the paper's, 100 to 225.
        max_delta: rad by which a joint's goal may lie from where it is, above 0 to 1; the authors clip at 0.2.
        obs_type: "pixels" (joints and cameras).
        cameras: which of front, wrist, left_shoulder, right_shoulder.
        The others are those of `SimEnvConfig`.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    gym_name = "cqn_rlbench/{task}-v0"
    tasks = TASKS
    known_cameras = CAMERAS
    action_kind = "goals"
    rates = (20,)
    rates_are = "a step of RLBench's simulation is 0.05 s"

    task: str | None = "take_lid_off_saucepan"  # one of the paper's 20
    fps: int = 20  # RLBench's
    variation: int = 0  # of the task
    max_delta: float = 0.2  # rad by which a joint's goal may lie from where it is
    obs_type: str = "pixels"  # the only one
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))  # front, wrist, shoulders

    def check(self) -> None:
        """Validate what a user may set. Raises ConfigError."""
        if self.obs_type != "pixels":
            raise ConfigError(
                f"obs_type is '{self.obs_type}': expected 'pixels', RLBench's tasks share no state of objects."
            )
        super().check()
        if self.variation < 0:
            raise ConfigError(f"variation is {self.variation}: expected 0 or more.")
        if not 0 < self.max_delta <= 1:
            raise ConfigError(f"max_delta is {self.max_delta}: expected above 0 to 1 rad.")

    @property
    def sizes(self) -> Sizes:
        """Seven joints and the gripper, twice."""
        return Sizes(8, 8, 0)

    @property
    def usual_steps(self) -> int:
        return TASKS[str(self.task)]


register(RLBenchEnv, "rlbench:RLBenchGym")
