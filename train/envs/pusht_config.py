"""Settings of gym_pusht at the declared picture size, `--env.type=pusht_small`. No simulator is imported here."""

from dataclasses import dataclass

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import OBS_IMAGE

from .env_config import REWARDS, SimEnvConfig, Sizes, check_name, register

__all__ = ["KEYPOINTS", "PushtSmallEnv"]

KEYPOINTS = 16  # numbers: x and y of eight corners
_LIMIT = 300  # steps, gym_pusht's own


@EnvConfig.register_subclass("pusht_small")
@dataclass
class PushtSmallEnv(SimEnvConfig):
    """gym_pusht: push a T onto a drawn one. Its features are those of the public dataset `lerobot/pusht`.

    LeRobot's own type `pusht` declares pictures of 384 pixels and delivers 96; this one delivers what it declares.

    Attributes:
        task: "pusht".
        fps: control steps a second, 10.
        episode_length: control steps before the episode is cut off; None: 300.
        obs_type: "pixels" (disc and picture, as in `lerobot/pusht`), "state" (disc and the T's corners) or "both".
        cameras: unused; the one picture is `observation.image`.
        image_size: height and width of the picture, 96 in `lerobot/pusht`.
        reward: "sparse" (1 on success) or "dense" (covered share, 0 to 1).
        The others are those of `SimEnvConfig`.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    gym_name = "cqn_pusht/PushT-v0"
    tasks = ("pusht",)
    rates = (10,)
    rates_are = "gym_pusht's own"

    task: str | None = "pusht"  # the only one
    fps: int = 10  # gym_pusht's
    obs_type: str = "pixels"  # state, pixels or both
    image_size: int = 96  # pixels a side; 96 in the public dataset
    reward: str = "sparse"  # 1 at success, or "dense": the covered share

    def check(self) -> None:
        """Validate what a user may set. Raises ConfigError."""
        super().check()
        check_name("reward", self.reward, REWARDS)

    @property
    def sizes(self) -> Sizes:
        """Place of the disc, twice, and the T's corners."""
        return Sizes(2, 2, 0 if self.obs_type == "pixels" else KEYPOINTS)

    @property
    def usual_steps(self) -> int:
        return _LIMIT

    @property
    def shown_cameras(self) -> list[str]:
        """None with a name."""
        return []

    def _derived(self) -> dict[str, tuple[PolicyFeature, str]]:
        derived = super()._derived()
        if self.obs_type != "state":
            shape = (self.image_size, self.image_size, 3)
            derived[OBS_IMAGE] = (PolicyFeature(FeatureType.VISUAL, shape), OBS_IMAGE)
        return derived


register(PushtSmallEnv, "pusht:PushT")
