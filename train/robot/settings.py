"""Settings of an arm (`--arm.*`)."""

from dataclasses import dataclass, field

from lerobot_cqn.errors import ConfigError, one_of
from lerobot_cqn.ranges import check_ranges, number

__all__ = ["ArmSettings"]


@dataclass
class ArmSettings:
    """The arm of `--robot.type`: its rate, its limits, what an episode is. Joints are in the robot's own units."""

    fps: int | None = number(None, least=1, most=200)  # control steps a second; None: the dataset's
    # seconds until an episode is cut off and its label is waited for
    episode_s: float = number(30.0, least=0.1, most=3600, unit="seconds")
    # goals may go so far beyond the joints of the demonstrations, a share of their range
    joint_margin: float = number(0.05, least=0, most=1)
    joint_limits: dict[str, list[float]] = field(default_factory=dict)  # [low, high] of a joint, instead of that
    # largest distance of a goal from the arm, and speed, over the largest in demonstrations
    step_factor: float = number(1.5, least=0.1, most=100)
    workspace: list[float] | None = None  # box of the tip, m: x_low, x_high, y_low, y_high, z_low, z_high
    urdf: str = ""  # of the arm, for the workspace (needs the placo package), where the robot has no `tip_position`
    tip: str = "gripper_frame_link"  # frame of the URDF that stays in the workspace
    go_home: bool = True  # after each episode, to where the demonstrations start
    home: dict[str, float] = field(default_factory=dict)  # joints of home; left out ones as in the demonstrations
    home_speed: float = number(0.3, least=0.001, most=1)  # share of the largest speed, (0, 1]
    on_exit: str = "hold"  # or "release": the motors go off, and the arm may fall
    # seconds after which a picture or joint that never changes is a fault
    stale_s: float = number(1.0, least=0.05, most=60, unit="seconds")
    watchdog_s: float = number(
        0.5, least=0.05, most=10, unit="seconds"
    )  # seconds without a goal after which the arm is held

    def validate(self) -> None:
        """Raises ConfigError for values out of range."""
        check_ranges(self, "arm.")
        for joint, pair in self.joint_limits.items():
            if len(pair) != 2 or not pair[0] < pair[1]:
                raise ConfigError(f"`arm.joint_limits` of '{joint}' must be [low, high], got {pair}.")
        box = self.workspace
        if box is not None and (len(box) != 6 or not all(box[i] < box[i + 1] for i in (0, 2, 4))):
            raise ConfigError(
                f"`arm.workspace` must be [x_low, x_high, y_low, y_high, z_low, z_high] in m, low < high, got {box}."
            )
        if self.on_exit not in (valid := ("hold", "release")):
            raise ConfigError(one_of("arm.on_exit", self.on_exit, valid))
