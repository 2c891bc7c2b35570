"""Settings of the DeepMind Control suite, `--env.type=dmc`. No simulator is imported here."""

from dataclasses import dataclass, field
from typing import NamedTuple

from lerobot.envs.configs import EnvConfig

from lerobot_cqn.errors import ConfigError

from .env_config import SimEnvConfig, Sizes, register

__all__ = ["TASKS", "DMCEnv"]

_CAMERAS = ("camera0",)
_SUITE_STEPS = 1000  # of the suite's own, in an episode of any task
_MAX_REPEAT = 20


class _Task(NamedTuple):
    """Numbers in the state and in the action, and milliseconds of one of the suite's own control steps."""

    state: int
    action: int
    step_ms: int


# All of the suite's tasks that end by time; written down so that no simulator has to be imported to know them.
TASKS = {
    "acrobot-swingup": _Task(6, 1, 10),
    "acrobot-swingup_sparse": _Task(6, 1, 10),
    "ball_in_cup-catch": _Task(8, 2, 20),
    "cartpole-balance": _Task(5, 1, 10),
    "cartpole-balance_sparse": _Task(5, 1, 10),
    "cartpole-swingup": _Task(5, 1, 10),
    "cartpole-swingup_sparse": _Task(5, 1, 10),
    "cartpole-three_poles": _Task(11, 1, 10),
    "cartpole-two_poles": _Task(8, 1, 10),
    "cheetah-run": _Task(17, 6, 10),
    "dog-fetch": _Task(232, 38, 15),
    "dog-run": _Task(223, 38, 15),
    "dog-stand": _Task(223, 38, 15),
    "dog-trot": _Task(223, 38, 15),
    "dog-walk": _Task(223, 38, 15),
    "finger-spin": _Task(9, 2, 20),
    "finger-turn_easy": _Task(12, 2, 20),
    "finger-turn_hard": _Task(12, 2, 20),
    "fish-swim": _Task(24, 5, 40),
    "fish-upright": _Task(21, 5, 40),
    "hopper-hop": _Task(15, 4, 20),
    "hopper-stand": _Task(15, 4, 20),
    "humanoid-run": _Task(67, 21, 25),
    "humanoid-run_pure_state": _Task(55, 21, 25),
    "humanoid-stand": _Task(67, 21, 25),
    "humanoid-walk": _Task(67, 21, 25),
    "humanoid_CMU-run": _Task(137, 56, 20),
    "humanoid_CMU-stand": _Task(137, 56, 20),
    "humanoid_CMU-walk": _Task(137, 56, 20),
    "manipulator-bring_ball": _Task(44, 5, 10),
    "manipulator-bring_peg": _Task(44, 5, 10),
    "manipulator-insert_ball": _Task(44, 5, 10),
    "manipulator-insert_peg": _Task(44, 5, 10),
    "pendulum-swingup": _Task(3, 1, 20),
    "point_mass-easy": _Task(4, 2, 20),
    "point_mass-hard": _Task(4, 2, 20),
    "quadruped-escape": _Task(101, 12, 20),
    "quadruped-fetch": _Task(90, 12, 20),
    "quadruped-run": _Task(78, 12, 20),
    "quadruped-walk": _Task(78, 12, 20),
    "reacher-easy": _Task(6, 2, 20),
    "reacher-hard": _Task(6, 2, 20),
    "stacker-stack_2": _Task(49, 5, 10),
    "stacker-stack_4": _Task(63, 5, 10),
    "swimmer-swimmer15": _Task(61, 14, 30),
    "swimmer-swimmer6": _Task(25, 5, 30),
    "walker-run": _Task(24, 6, 25),
    "walker-stand": _Task(24, 6, 25),
    "walker-walk": _Task(24, 6, 25),
}


@EnvConfig.register_subclass("dmc")
@dataclass
class DMCEnv(SimEnvConfig):
    """A task of the DeepMind Control suite: dense reward, no success, episodes of 1000 suite steps.

    Attributes:
        task: domain and task as dm_control names them, e.g. cartpole-swingup, walker-walk, ball_in_cup-catch.
        action_repeat: suite steps for which an action is held, 1 to 20; None: 1 with "state", else 2.
        fps: control steps a second; follows from task and action_repeat, whatever was given.
        episode_length: control steps before the episode is cut off; None: 1000 suite steps.
        obs_type: "state" (the task's own observations), "pixels" (one camera and nothing else) or "both".
        cameras: camera0, the suite's first one, of quadruped and dog-fetch the third; unused with "state".
        The others are those of `SimEnvConfig`.

    Raises:
        ConfigError: a value that is not one of those named above, or a given feature of another shape.
    """

    gym_name = "cqn_dmc/{task}-v0"
    tasks = TASKS
    known_cameras = _CAMERAS

    task: str | None = "cartpole-swingup"  # domain-task, e.g. walker-walk or ball_in_cup-catch
    fps: int = 100  # follows from task and action_repeat
    cameras: list[str] = field(default_factory=lambda: list(_CAMERAS))  # the suite's own
    action_repeat: int | None = None  # simulator steps an action is held; none: 1 with states, 2 with pictures

    def check(self) -> None:
        """Validate what a user may set; fills in fps."""
        super().check()
        if self.action_repeat is not None and not 1 <= self.action_repeat <= _MAX_REPEAT:
            raise ConfigError(f"action_repeat is {self.action_repeat}: expected 1 to {_MAX_REPEAT}, or nothing.")
        self.fps = max(1, round(1000 / (TASKS[str(self.task)].step_ms * self.repeat)))

    @property
    def repeat(self) -> int:
        """Suite steps for which an action is held; where not given the paper's, 1 with state alone, 2 with pictures."""
        return self.action_repeat or (1 if self.obs_type == "state" else 2)

    @property
    def sizes(self) -> Sizes:
        """Those of the task; no `agent_pos` with "pixels", never an `environment_state`."""
        task = TASKS[str(self.task)]
        return Sizes(task.action, 0 if self.obs_type == "pixels" else task.state, 0)

    @property
    def usual_steps(self) -> int:
        return _SUITE_STEPS // self.repeat


register(DMCEnv, "dmc:ControlSuite")
