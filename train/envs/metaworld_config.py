"""Settings of Meta-World with sparse rewards, `--env.type=metaworld_sparse`. No simulator is imported here."""

from dataclasses import dataclass, field

from lerobot.envs.configs import EnvConfig

from .env_config import SimEnvConfig, Sizes, check_name, register

__all__ = ["CAMERAS", "SIMULATOR_HZ", "TASKS", "MetaworldSparseEnv", "state_size"]

CAMERAS = ("corner", "corner2", "corner3", "topview", "behindGripper", "gripperPOV")
_DEFAULT_CAMERAS = ("corner2", "gripperPOV")
SIMULATOR_HZ = 80  # Meta-World's own control rate
_HORIZON_S = 5  # seconds before an episode is cut off: 100 steps at 20 Hz
_VERSION = "-v3"

# Task without its version, and the sentence that instructs it.
TASKS = {
    "assembly": "Put the ring over the peg",
    "basketball": "Drop the ball through the hoop",
    "bin-picking": "Move the cube into the other bin",
    "box-close": "Put the lid on the box",
    "button-press": "Push the button on the wall",
    "button-press-topdown": "Push the button down from above",
    "button-press-topdown-wall": "Push the button down from above, over the wall",
    "button-press-wall": "Push the button behind the wall",
    "coffee-button": "Push the button of the coffee machine",
    "coffee-pull": "Pull the mug away from the coffee machine",
    "coffee-push": "Push the mug under the coffee machine",
    "dial-turn": "Turn the dial",
    "disassemble": "Take the ring off the peg",
    "door-close": "Close the door",
    "door-lock": "Lock the door",
    "door-open": "Open the door",
    "door-unlock": "Unlock the door",
    "drawer-close": "Close the drawer",
    "drawer-open": "Open the drawer",
    "faucet-close": "Turn the faucet off",
    "faucet-open": "Turn the faucet on",
    "hammer": "Drive the nail in with the hammer",
    "hand-insert": "Put the hand into the hole",
    "handle-press": "Press the handle down",
    "handle-press-side": "Press the handle down from the side",
    "handle-pull": "Pull the handle up",
    "handle-pull-side": "Pull the handle up from the side",
    "lever-pull": "Pull the lever up",
    "peg-insert-side": "Put the peg into the hole in the side of the box",
    "peg-unplug-side": "Pull the peg out of the side of the box",
    "pick-out-of-hole": "Take the puck out of the hole",
    "pick-place": "Carry the puck to the goal",
    "pick-place-wall": "Carry the puck over the wall to the goal",
    "plate-slide": "Slide the plate into the goal",
    "plate-slide-back": "Slide the plate back out of the goal",
    "plate-slide-back-side": "Slide the plate sideways out of the goal",
    "plate-slide-side": "Slide the plate sideways into the goal",
    "push": "Push the puck to the goal",
    "push-back": "Pull the puck back to the goal",
    "push-wall": "Push the puck around the wall to the goal",
    "reach": "Move the hand to the goal",
    "reach-wall": "Move the hand over the wall to the goal",
    "shelf-place": "Put the block on the shelf",
    "soccer": "Push the ball into the net",
    "stick-pull": "Pull the box with the stick",
    "stick-push": "Push the box with the stick",
    "sweep": "Sweep the block off the table",
    "sweep-into": "Sweep the block into the hole",
    "window-close": "Slide the window shut",
    "window-open": "Slide the window open",
}
_TWO_OBJECTS = ("hammer", "stick-pull", "stick-push")


def state_size(task: str) -> int:
    """Numbers in `environment_state`: a pose of seven for each object, and the goal's three."""
    return (14 if task.removesuffix(_VERSION) in _TWO_OBJECTS else 7) + 3


@EnvConfig.register_subclass("metaworld_sparse")
@dataclass
class MetaworldSparseEnv(SimEnvConfig):
    """A task of Meta-World (MT1, objects placed anew in each episode): success gives the only reward and is the end.

    Attributes:
        task: one of Meta-World's 50, with or without "-v3", e.g. drawer-open; kept with it.
        fps: control steps a second: 10, 20, 40 or 80; at 20 an action is held for 4 simulator steps.
        episode_length: control steps before the episode is cut off; None: 5 seconds, 100 steps at 20 Hz.
        obs_type: "state" (hand, objects and goal), "pixels" (hand and cameras) or "both".
        cameras: which of corner, corner2, corner3, topview, behindGripper, gripperPOV; unused with "state".
        The others are those of `SimEnvConfig`.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    gym_name = "cqn_metaworld/{task}"
    tasks = tuple(task + _VERSION for task in TASKS)
    known_cameras = CAMERAS
    rates = (10, 20, 40, 80)
    rates_are = "whole steps of Meta-World's 80 Hz"

    task: str | None = "drawer-open-v3"  # one of Meta-World's 50; docs/environments.md lists 20
    fps: int = 20  # control steps a second: 10, 20, 40 or 80
    cameras: list[str] = field(default_factory=lambda: list(_DEFAULT_CAMERAS))  # or others of Meta-World's six

    def check(self) -> None:
        """Validate what a user may set; completes the task's name."""
        name = (self.task or "").removesuffix(_VERSION)
        check_name("Meta-World task", name, TASKS)
        self.task = name + _VERSION
        super().check()

    @property
    def sizes(self) -> Sizes:
        """Hand and gripper, twice, and objects with the goal."""
        return Sizes(4, 4, 0 if self.obs_type == "pixels" else state_size(str(self.task)))

    @property
    def usual_steps(self) -> int:
        return _HORIZON_S * self.fps


register(MetaworldSparseEnv, "metaworld:MetaworldSparse")
