"""Settings of the scripted leader arm (`--teleop.type=sim_leader`)."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

from lerobot_cqn.errors import ConfigError

__all__ = ["SimLeaderConfig"]


@TeleoperatorConfig.register_subclass("sim_leader")
@dataclass(kw_only=True)
class SimLeaderConfig(TeleoperatorConfig):
    """A leader arm in a scripted person's hands, whose joints the simulated arm mirrors.

    It does the task, holds still when it is done, and goes home, where the scene is laid out anew.

    Attributes:
        world: name of the arm's world in this process (`--robot.world`).
        pause_share: share of the time in which the person hesitates, 0 to 0.9.
        hold_s: simulated seconds for which the arm is held when the task is done, and again at home.
        seed: of the pauses.

    Raises:
        ConfigError: a value out of range.
    """

    world: str = "default"
    pause_share: float = 0.0
    hold_s: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.pause_share <= 0.9:
            raise ConfigError(f"pause_share is {self.pause_share}: expected 0 to 0.9.")
        if not 0.0 <= self.hold_s <= 60.0:
            raise ConfigError(f"hold_s is {self.hold_s}: expected 0 to 60 seconds.")
