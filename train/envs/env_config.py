"""Base of the simulated environments' configurations: fields, features, LeRobot's and gymnasium's names for them."""

from collections.abc import Collection
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_cqn.errors import ConfigError, one_of

__all__ = ["REWARDS", "SimEnvConfig", "Sizes", "check_name", "register"]

REWARDS = ("sparse", "dense")
_OBS_TYPES = ("both", "pixels", "state")


class Sizes(NamedTuple):
    """Numbers in the action, in `agent_pos` and in `environment_state`; 0 where there is none."""

    action: int
    agent_pos: int
    environment_state: int


@dataclass
class SimEnvConfig(EnvConfig):
    """Settings of a kind of environment; a subclass says its tasks, cameras, sizes and limits, and is then registered.

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

    gym_name: ClassVar[str]  # name in gymnasium's registry, with {task}
    tasks: ClassVar[Collection[str]]  # names of all there are
    known_cameras: ClassVar[tuple[str, ...]] = ()  # names of all there are; () where pictures have none
    rates: ClassVar[tuple[int, ...]] = ()  # values of fps that there are; () where it follows from other fields
    rates_are: ClassVar[str] = ""  # why there are no others
    action_kind: ClassVar[str] = ""  # "goals", "differences", or "": neither, or said by the recording

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
        """Validate what a user may set; a subclass goes on with settings of its own. Raises ConfigError."""
        check_name("task", self.task or "", self.tasks)
        check_name("obs_type", self.obs_type, _OBS_TYPES)
        if self.known_cameras:
            for name in self.cameras:
                check_name("camera", name, self.known_cameras)
            if len(set(self.cameras)) != len(self.cameras) or (self.obs_type != "state" and not self.cameras):
                raise ConfigError(f"cameras is {list(self.cameras)}: expected at least one name, each once.")
        if not 16 <= self.image_size <= 1024:
            raise ConfigError(f"image_size is {self.image_size}: expected 16 to 1024 pixels.")
        if self.rates and self.fps not in self.rates:
            known = " or ".join(", ".join(map(str, self.rates)).rsplit(", ", 1))
            raise ConfigError(f"fps is {self.fps}: expected {known} ({self.rates_are}).")

    @property
    def sizes(self) -> Sizes:
        """Numbers of action, `agent_pos` and `environment_state` with the present settings."""
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
    def gym_id(self) -> str:
        """Name of the environment in gymnasium's registry."""
        return self.gym_name.format(task=self.task)

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
        """Arguments of `gymnasium.make`: the limit, and the fields that concern the environment."""
        # What LeRobot's own class has is for its commands, but for fps; the length is the limit.
        elsewhere = {item.name for item in fields(EnvConfig)} - {"fps"} | {"episode_length"}
        own = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in elsewhere}
        return {**own, "max_episode_steps": self.max_episode_steps}

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


def check_name(what: str, got: str, valid: Collection[str]) -> None:
    """Refuse a name that is not one of `valid`. Raises ConfigError."""
    if got not in valid:
        raise ConfigError(one_of(what, got, valid))


def register(config: type[SimEnvConfig], environment: str) -> None:
    """Make all tasks known to gymnasium.

    Args:
        config: settings of the environment; its class is registered with LeRobot already.
        environment: the environment's module and class, as "hil:HilSim"; imported when one is made.
    """
    for task in config.tasks:
        default = config(task=task)
        if default.gym_id not in gym.registry:
            gym.register(
                default.gym_id,
                entry_point=f"{__package__}.{environment}",
                kwargs={"task": task},
                max_episode_steps=default.max_episode_steps,
            )
