"""Settings of an arm (`--arm.*`)."""

from dataclasses import dataclass, field

from lerobot_cqn.errors import ConfigError, one_of

__all__ = ["ArmSettings"]


@dataclass
class ArmSettings:
    """The arm of `--robot.type`: its rate, its limits, what an episode is. Joints are in the robot's own units."""

    fps: int | None = None  # control steps a second; None: the dataset's
    episode_s: float = 30.0  # seconds until an episode is cut off and its label is waited for
    joint_margin: float = 0.05  # goals may go so far beyond the joints of the demonstrations, a share of their range
    joint_limits: dict[str, list[float]] = field(default_factory=dict)  # [low, high] of a joint, instead of that
    step_factor: float = 1.5  # largest distance of a goal from the arm, and speed, over the largest in demonstrations
    workspace: list[float] | None = None  # box of the tip, m: x_low, x_high, y_low, y_high, z_low, z_high
    urdf: str = ""  # of the arm, for the workspace (needs the placo package), where the robot has no `tip_position`
    tip: str = "gripper_frame_link"  # frame of the URDF that stays in the workspace
    go_home: bool = True  # after each episode, to where the demonstrations start
    home: dict[str, float] = field(default_factory=dict)  # joints of home; left out ones as in the demonstrations
    home_speed: float = 0.3  # share of the largest speed, (0, 1]
    on_exit: str = "hold"  # or "release": the motors go off, and the arm may fall
    stale_s: float = 1.0  # seconds after which a picture or joint that never changes is a fault
    watchdog_s: float = 0.5  # seconds without a goal after which the arm is held

    def validate(self) -> None:
        """Raises ConfigError for values out of range."""
        for name, low, high in (
            ("fps", 1, 1000), ("episode_s", 0.1, 3600), ("joint_margin", 0, 1), ("step_factor", 0.1, 100),
            ("home_speed", 0.001, 1), ("stale_s", 0.05, 60), ("watchdog_s", 0.05, 10),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ConfigError(f"`arm.{name}` must be {low:g} to {high:g}, got {value}.")
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
