"""What the configurations of all our simulated environments share: fields, features and LeRobot's names for them."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_cqn.errors import ConfigError, one_of

__all__ = ["OBS_TYPES", "SimEnvConfig", "Sizes", "check_cameras"]

OBS_TYPES = ("both", "pixels", "state")


class Sizes(NamedTuple):
    """Numbers in the action, in `agent_pos` and in `environment_state`; 0 where there is none."""

    action: int
    agent_pos: int
    environment_state: int


@dataclass
class SimEnvConfig(EnvConfig):
    """Base of our environments' configurations: a subclass names the sizes, the gym id and the limits.

    An environment made from it observes `agent_pos` and `environment_state`, float32, and `pixels`, a dictionary of
    uint8 (image_size, image_size, 3) by camera, each where `sizes` and `shown_cameras` say so; its `info` always has
    `is_success`.

    Attributes:
        task: name of the task.
        fps: control steps a second.
        episode_length: control steps before the episode is cut off; None: the task's own.
        obs_type: "state" (no cameras), "pixels" (cameras, no simulator state) or "both".
        cameras: which cameras; unused with "state".
        image_size: height and width of each camera's picture, 16 to 1024 pixels.
        render_mode: "rgb_array"; the picture shown in videos.
        features: what the environment gives and takes; filled in from the other fields where not given.
        features_map: the policy's name for each feature; filled in likewise.

    Raises:
        ConfigError: a value out of range, or a given feature of another shape.
    """

    obs_type: str = "state"  # state (no cameras), pixels (no simulator state) or both
    cameras: list[str] = field(default_factory=list)
    image_size: int = 84  # height and width of each camera's picture, 16 to 1024 pixels
    episode_length: int | None = None  # control steps before the episode is cut off; none: the task's own
    render_mode: str = "rgb_array"  # of films
    features: dict[str, PolicyFeature] = field(default_factory=dict)  # follow from the rest
    features_map: dict[str, str] = field(default_factory=dict)  # follows from the rest

    def __post_init__(self) -> None:
        self.check()
        if self.episode_length is not None and self.episode_length < 1:
            raise ConfigError(f"episode_length is {self.episode_length}: expected at least 1 step.")
        # Given entries survive; a contradiction is said here and not when the first batch is stacked.
        for name, (feature, policy_name) in self._derived().items():
            given = self.features.setdefault(name, feature)
            if tuple(given.shape) != tuple(feature.shape):
                raise ConfigError(
                    f"features['{name}'] has shape {tuple(given.shape)}, but the environment gives "
                    f"{tuple(feature.shape)}: correct or leave out the entry."
                )
            self.features_map.setdefault(name, policy_name)

    # -- what a subclass says --------------------------------------------------------------------------------

    def check(self) -> None:
        """Validate what a user may set. Raises ConfigError."""
        raise NotImplementedError

    @property
    def sizes(self) -> Sizes:
        """Of action, `agent_pos` and `environment_state` with the present settings."""
        raise NotImplementedError

    @property
    def usual_steps(self) -> int:
        """Control steps before an episode of the task is cut off, where the user does not say."""
        raise NotImplementedError

    # -- what follows ----------------------------------------------------------------------------------------

    @property
    def package_name(self) -> str:
        """Module whose import registers the environment with gymnasium."""
        return type(self).__module__

    @property
    def max_episode_steps(self) -> int:
        """Control steps before an episode is cut off."""
        return self.usual_steps if self.episode_length is None else self.episode_length

    @property
    def shown_cameras(self) -> list[str]:
        """The cameras that are observed."""
        return [] if self.obs_type == "state" else list(self.cameras)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make`."""
        return {
            "obs_type": self.obs_type,
            "cameras": list(self.cameras),
            "image_size": self.image_size,
            "render_mode": self.render_mode,
            "max_episode_steps": self.max_episode_steps,
        }

    def _derived(self) -> dict[str, tuple[PolicyFeature, str]]:
        """Each feature by the environment's name, with the policy's name for it."""
        action, agent_pos, environment_state = self.sizes
        derived = {ACTION: (PolicyFeature(FeatureType.ACTION, (action,)), ACTION)}
        if agent_pos:
            derived["agent_pos"] = (PolicyFeature(FeatureType.STATE, (agent_pos,)), OBS_STATE)
        if environment_state:
            derived["environment_state"] = (PolicyFeature(FeatureType.ENV, (environment_state,)), OBS_ENV_STATE)
        for camera in self.shown_cameras:
            shape = (self.image_size, self.image_size, 3)
            # Not "pixels/<camera>": recorded evaluations refuse feature names with a slash.
            name = f"{OBS_IMAGES}.{camera}"
            derived[name] = (PolicyFeature(FeatureType.VISUAL, shape), name)
        return derived


def check_cameras(obs_type: str, cameras: list[str] | tuple[str, ...], known: tuple[str, ...], image_size: int) -> None:
    """Validate an observation type, camera names and a picture size. Raises ConfigError."""
    if obs_type not in OBS_TYPES:
        raise ConfigError(one_of("obs_type", obs_type, OBS_TYPES))
    for name in cameras:
        if name not in known:
            raise ConfigError(one_of("camera", name, known))
    if len(set(cameras)) != len(cameras) or (obs_type != "state" and not cameras):
        raise ConfigError(f"cameras is {list(cameras)}: expected at least one name, each once.")
    if not 16 <= image_size <= 1024:
        raise ConfigError(f"image_size is {image_size}: expected 16 to 1024 pixels.")
