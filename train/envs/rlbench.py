"""RLBench's tasks, the paper's first benchmark, behind the interface of our other environments.

RLBench and CoppeliaSim are on no package registry: this adapter is written against RLBench's public interface (1.2)
and tested with a stand-in, not with the simulator.
"""

import weakref
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError, DataError

from .rlbench_config import CAMERAS, RLBenchEnv
from .sim_env import Observation, SimEnv, preserved_numpy_random

__all__ = ["LIMITS", "RLBenchGym"]

# Joint limits of the Franka Panda in rad, by its maker's data sheet.
LIMITS = np.array(
    [[-2.8973, 2.8973], [-1.7628, 1.7628], [-2.8973, 2.8973], [-3.0718, -0.0698], [-2.8973, 2.8973], [-0.0175, 3.7525],
     [-2.8973, 2.8973]], np.float32,
)  # fmt: skip
_ALL_CAMERAS = (*CAMERAS, "overhead")
_JOINTS = 7
# As `cqn-data convert` names them in RLBench's own recordings.
_NAMES = [*(f"joint_positions.{i}" for i in range(_JOINTS)), "gripper_open"]


class _Modules(NamedTuple):
    """Parts of RLBench that are used."""

    tasks: Any
    environment: Any
    observation_config: Any
    action_mode: Any
    arm: Any
    gripper: Any
    invalid_action: type[Exception]


class RLBenchGym(SimEnv):
    """A Franka Panda in CoppeliaSim, headless at 20 Hz; sparse reward. One of these a process.

    Action, (8,) float32: goals of seven joints in rad, as RLBench's own recordings hold them, and the gripper, 0
    (closed) to 1 (open), RLBench's convention; it opens above 0.5. Values out of range are clipped, and goals to within
    `max_delta` of the measured joints. A policy of differences comes here with its differences added to the joints.

    Observation:
        agent_pos: (8,) float32, seven joint angles in rad and whether the gripper is open, 0 or 1.
        pixels: one (image_size, image_size, 3) uint8 a camera.

    Reward 1 on success, which ends the episode; else 0. An action RLBench refuses ends it as a failure.
    `info["is_success"]` is always present.

    Attributes:
        task, task_description: name of the task, and RLBench's first sentence for it, once an episode has begun.
        state_names, action_names: of `agent_pos` and the action.
    """

    def __init__(self, **settings: Any) -> None:
        """Start CoppeliaSim with the scene that fields of `RLBenchEnv` name.

        Raises:
            ConfigError: a setting that `RLBenchEnv` refuses, or RLBench, PyRep or CoppeliaSim is missing.
        """
        config = RLBenchEnv(**settings)
        modules = _load()
        super().__init__(config)
        self._invalid_action = modules.invalid_action
        self.task_description = self.task.replace("_", " ")
        self.state_names = list(_NAMES)
        self.action_names = list(_NAMES)
        low, high = (np.append(LIMITS[:, end], gripper) for end, gripper in ((0, 0), (1, 1)))
        self.action_space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self._max_delta = config.max_delta
        self._last: Observation = {}
        self._simulator = modules.environment.Environment(
            action_mode=modules.action_mode.MoveArmThenGripper(
                arm_action_mode=modules.arm.JointPosition(absolute_mode=True),
                gripper_action_mode=modules.gripper.Discrete(),
            ),
            obs_config=_wanted(modules, self._camera_names, config.image_size),
            headless=True,
        )
        try:
            self._simulator.launch()
        except Exception as error:  # PyRep has errors of its own
            raise _missing(error) from error
        # CoppeliaSim crashes when the process ends before it does.
        self._closer = weakref.finalize(self, self._simulator.shutdown)
        self._task = self._simulator.get_task(getattr(modules.tasks, _class_name(self.task)))
        variation, variations = config.variation, int(self._task.variation_count())
        if variation >= variations:
            self.close()
            raise ConfigError(f"variation is {variation}: expected 0 to {variations - 1} for the task '{self.task}'.")
        self._task.set_variation(variation)

    def _begin(self, seed: int | None) -> Observation:
        """Place the objects. Raises DataError where RLBench finds no place for them."""
        try:
            # RLBench places objects with numpy's global state.
            with preserved_numpy_random(int(self.np_random.integers(2**32))):
                descriptions, observation = self._task.reset()
        except Exception as error:  # RLBench has many kinds
            raise DataError(
                f"RLBench cannot start an episode of '{self.task}' ({error}): expected a free place for its objects; "
                "try another seed."
            ) from error
        self.task_description = str(descriptions[0])
        self._last = self._observe(observation)
        return self._last

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 0.05 s, and longer where the gripper opens or closes.

        Raises:
            DataError: the action is not eight finite numbers.
        """
        checked, joints = self._checked(action), self._last["agent_pos"][:_JOINTS]
        checked[:_JOINTS] = np.clip(checked[:_JOINTS], joints - self._max_delta, joints + self._max_delta)
        try:
            observation, reward, terminated = self._task.step(checked)
        except self._invalid_action:
            return self._last, 0.0, True, False, {"is_success": False, "invalid_action": True}
        success = float(reward) > 0.0
        self._last = self._observe(observation)
        return self._last, float(success), bool(terminated) or success, False, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """Picture that the first camera saw last, (image_size, image_size, 3) uint8 RGB.

        Raises:
            DataError: no episode has begun.
        """
        if not self._last:
            raise DataError("There is no picture yet: expected reset() before render().")
        picture: NDArray[np.uint8] = self._last["pixels"][self._camera_names[0]]
        return picture

    def close(self) -> None:
        """Stop CoppeliaSim; calling it twice is harmless."""
        self._closer()

    def _observe(self, observation: Any) -> Observation:
        state = np.append(observation.joint_positions, observation.gripper_open).astype(np.float32)
        pixels = {name: np.asarray(getattr(observation, f"{name}_rgb"), np.uint8) for name in self._camera_names}
        return {"agent_pos": state, "pixels": pixels}


def _class_name(task: str) -> str:
    """RLBench's class of a task: TakeLidOffSaucepan."""
    return "".join(word.capitalize() for word in task.split("_"))


def _wanted(modules: _Modules, cameras: tuple[str, ...], image_size: int) -> Any:
    """RLBench's observation config: joints, gripper and the colours of some cameras, nothing else."""
    config = modules.observation_config.ObservationConfig()
    config.set_all(False)
    config.joint_positions = config.gripper_open = True
    for name in _ALL_CAMERAS:
        camera = getattr(config, f"{name}_camera")
        camera.rgb = name in cameras
        camera.image_size = (image_size, image_size)
    return config


def _load() -> _Modules:
    """RLBench, imported on first use. Raises ConfigError when it or what it needs is missing."""
    try:
        from rlbench import environment, observation_config, tasks
        from rlbench.action_modes import action_mode, arm_action_modes, gripper_action_modes
        from rlbench.backend.exceptions import InvalidActionError
    except ImportError as error:
        raise _missing(error) from error
    return _Modules(
        tasks, environment, observation_config, action_mode, arm_action_modes, gripper_action_modes, InvalidActionError
    )


def _missing(error: Exception) -> ConfigError:
    return ConfigError(
        f"The environment 'rlbench' does not start ({error}): expected RLBench, PyRep and CoppeliaSim 4.1; unpack "
        "CoppeliaSim, set COPPELIASIM_ROOT to its folder and add that to LD_LIBRARY_PATH, then run "
        "`pip install git+https://github.com/stepjam/RLBench.git`."
    )
