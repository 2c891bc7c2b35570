"""Settings of the simulated arm (`--robot.type=sim_ur5e`)."""

from dataclasses import dataclass, field

from lerobot.robots.config import RobotConfig

from lerobot_cqn.errors import ConfigError, one_of

from ..envs.ur5e_station.config import CAMERAS
from ..envs.ur5e_station.tasks import TASKS

__all__ = ["FAULTS", "Fault", "SimUR5eConfig"]

FAULTS = {
    "disconnect": "reading and sending raise a connection error",
    "send_error": "sending raises a connection error",
    "delay": "reading takes `amount` seconds",
    "frozen_camera": "pictures stay as they are",
    "frozen_joints": "joint readings stay as they are",
    "stuck_joint": "joint number `amount` does not follow",
    "nan": "one joint reads NaN",
    "error": "reading raises an error that no driver documents",
}


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong, from `at_s` on for `for_s` seconds of the simulated clock.

    kind: one of FAULTS. Raises ConfigError for another one.
    """

    kind: str
    at_s: float
    for_s: float = float("inf")
    amount: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise ConfigError(one_of("fault", self.kind, FAULTS))

    def active(self, now: float) -> bool:
        """Whether it is on at `now`, in seconds."""
        return self.at_s <= now < self.at_s + self.for_s


@RobotConfig.register_subclass("sim_ur5e")
@dataclass(kw_only=True)
class SimUR5eConfig(RobotConfig):
    """The station's UR5e as a robot that runs by itself: time passes whether it is asked or not.

    Joints are in degrees, the gripper from 0 (open) to 100 (closed); actions are absolute goals.

    Raises:
        ConfigError: a value that is not one of those named above.
    """

    task: str = "click_button"  # or flip_cup, open_drawer_put_teddy, take_lid_off_saucepan
    speed: float = 1.0  # simulated seconds in a real one; at 4, forty control steps a second are ten of the arm's own
    ramp_s: float = 0.1  # simulated seconds in which the joints are led to a new goal
    # of left_shoulder, right_shoulder, upper_wrist, lower_wrist
    camera_names: list[str] = field(default_factory=lambda: list(CAMERAS))
    image_height: int = 84  # pixels of each camera, 16 to 1024
    image_width: int = 84  # pixels, 16 to 1024
    state: bool = False  # also the objects' state, as joints of their own (object.*.pos): learns without cameras
    seed: int = 0  # of the scenes
    world: str = "default"  # name under which a leader in the same process finds this arm
    faults: list[Fault] = field(default_factory=list)  # what goes wrong, and when
    person: str = ""  # address of an operator's page where a simulated person answers (token: CQN_PAGE_TOKEN)
    person_takes_over_s: float = 0.0  # simulated seconds of an episode until this person takes the leader; 0: never
    person_helps_episodes: int = 0  # episodes of a run in which this person takes the leader at all; 0: all

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.task not in TASKS:
            raise ConfigError(one_of("task", self.task, TASKS))
        for name in self.camera_names:
            if name not in CAMERAS:
                raise ConfigError(one_of("camera", name, CAMERAS))
        if self.person and not self.person.startswith(("http://", "https://")):
            raise ConfigError(f"person is '{self.person}': expected the page's address, http://127.0.0.1:8765.")
        for name, value, low, high in (
            ("person_takes_over_s", self.person_takes_over_s, 0.0, 3600.0),
            ("person_helps_episodes", self.person_helps_episodes, 0, 10**6),
            ("speed", self.speed, 0.01, 100.0),
            ("ramp_s", self.ramp_s, 0.004, 1.0),
            ("image_height", self.image_height, 16, 1024),
            ("image_width", self.image_width, 16, 1024),
        ):
            if not low <= value <= high:
                raise ConfigError(f"{name} is {value}: expected {low} to {high}.")
