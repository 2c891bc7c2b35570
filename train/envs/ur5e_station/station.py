"""The gym environment all tasks of the station share."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError, one_of

from ..cameras import Cameras
from ..common import RENDER_SIZE, checked_action
from ..env_config import check_cameras
from .expert import ScriptedTeleoperator
from .task import Task
from .tasks import TASKS
from .ur5e import HOME, STATE_NAMES, TIMESTEP, Arm

__all__ = ["CAMERAS", "LEASH", "MAX_JOINT_SPEED", "UR5eStation"]

CAMERAS = ("left_shoulder", "right_shoulder", "upper_wrist", "lower_wrist")
MAX_JOINT_SPEED = 1.0  # rad/s
LEASH = 0.25  # rad, how far the command may run ahead of the measured joint
_HOME_SPREAD = 0.03  # rad, of each joint at the start

Observation = dict[str, Any]


class UR5eStation(gym.Env[Observation, NDArray[np.float32]]):
    """A UR5e with a gripper on a table, in MuJoCo; sparse reward.

    Action, (7,) float32: six joint deltas in rad a step, at most `MAX_JOINT_SPEED / fps` each, and the gripper,
    0 (open) to 1 (closed). Values out of range are clipped. Deltas accumulate on the last command, which stays
    within 0.25 rad of the measured joint.

    Observation:
        agent_pos: (7,) float32, six joint angles in rad and the measured gripper, 0 (open) to 1 (closed).
        environment_state: float32, state of the objects (`environment_state_names`); not with "pixels".
        pixels: one (image_size, image_size, 3) uint8 a camera; not with "state".

    Reward 1 on success, which ends the episode; else 0. `info["is_success"]` is always present.

    Attributes:
        task, task_description: name of the task, and the sentence that instructs it.
        state_names, action_names: of `agent_pos` and the action, as LeRobot names motors.
        environment_state_names: of the objects' state.
        action_kind: what the joint deltas are differences of, as `cqn-data delta --help` names it.
    """

    action_kind: ClassVar[str] = "command_steps"

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        task: str = "click_button",
        obs_type: str = "state",
        cameras: list[str] | tuple[str, ...] = CAMERAS,
        image_size: int = 84,
        fps: int = 10,
        render_mode: str | None = "rgb_array",
    ) -> None:
        """Build the scene; no graphics context is opened before the first picture.

        Raises:
            ConfigError: an unknown task, obs_type or camera; a size or rate out of range; mujoco is missing.
        """
        check_settings(task, obs_type, cameras, image_size, fps)
        self._task = TASKS[task]()
        self._arm = Arm(self._task.mjcf())
        self._cameras = Cameras(self._arm.model)
        self._camera_names = tuple(cameras) if obs_type != "state" else ()
        self._with_state = obs_type != "pixels"
        self._image_size = image_size
        self._substeps = round(1.0 / (fps * TIMESTEP))
        self._command = np.array(HOME)
        self._success = False
        self.fps = fps
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": fps}  # type: ignore[misc]
        self.task = task
        self.task_description = self._task.description
        self.state_names = list(STATE_NAMES)
        self.action_names = list(STATE_NAMES)
        self.environment_state_names = list(self._task.state_names)
        limits = np.array([MAX_JOINT_SPEED / fps] * 6 + [1.0], np.float32)
        lowest = np.append(-limits[:6], np.float32(0.0))
        self.action_space = gym.spaces.Box(lowest, limits, dtype=np.float32)
        self.observation_space = self._space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the same `seed` gives the same episode, without one the random stream goes on.

        `options` is accepted for callers that pass marks of their own; none changes anything.
        """
        super().reset(seed=seed)
        joints = np.array(HOME) + self.np_random.uniform(-_HOME_SPREAD, _HOME_SPREAD, 6)
        self._arm.place(joints, self._task.start_closure)
        self._task.reset(self._arm, self.np_random)
        self._arm.forward()
        self._command = joints
        self._success = False
        return self._observe(), {"is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 1 / fps seconds.

        Raises:
            DataError: the action is not seven finite numbers.
        """
        checked = checked_action(action, self.action_space, self.action_names)
        measured = self._arm.joints
        wanted: NDArray[np.float64] = np.clip(self._command + checked[:6], measured - LEASH, measured + LEASH)
        wanted = self._arm.clip(wanted)
        self._arm.drive(self._command, wanted, float(checked[6]), self._substeps)
        self._command = wanted
        success = self._task.success(self._arm)
        return self._observe(), float(success), success, False, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """The whole station, (360, 480, 3) uint8 RGB."""
        return self._cameras.picture(self._arm.data, "overview", *RENDER_SIZE, oversample=2)

    def close(self) -> None:
        """Release graphics contexts; calling it twice is harmless."""
        self._cameras.close()

    def scripted_teleoperator(
        self, pause_share: float = 0.0, seed: int = 0, tremor_rad: float = 0.0
    ) -> ScriptedTeleoperator:
        """A scripted operator for this environment."""
        return ScriptedTeleoperator(self, pause_share=pause_share, tremor_rad=tremor_rad, seed=seed)

    @property
    def arm(self) -> Arm:
        """The simulated arm and scene."""
        return self._arm

    @property
    def station_task(self) -> Task:
        """The running task."""
        return self._task

    def _observe(self) -> Observation:
        joints = np.append(self._arm.joints, self._arm.closure).astype(np.float32)
        space = self.observation_space["agent_pos"]
        observation: Observation = {"agent_pos": np.clip(joints, space.low, space.high)}
        if self._with_state:
            observation["environment_state"] = self._task.state(self._arm).astype(np.float32)
        if self._camera_names:
            size = self._image_size
            observation["pixels"] = {
                name: self._cameras.picture(self._arm.data, name, size, size) for name in self._camera_names
            }
        return observation

    def _space(self) -> gym.spaces.Dict:
        # A joint may touch its stop and give a little.
        highest = np.array([2 * np.pi + 0.1] * 6 + [1.0], np.float32)
        lowest = np.append(-highest[:6], np.float32(0.0))
        spaces: dict[str, gym.Space[Any]] = {"agent_pos": gym.spaces.Box(lowest, highest, dtype=np.float32)}
        if self._with_state:
            shape = (len(self.environment_state_names),)
            spaces["environment_state"] = gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
        if self._camera_names:
            image = gym.spaces.Box(0, 255, (self._image_size, self._image_size, 3), np.uint8)
            spaces["pixels"] = gym.spaces.Dict(dict.fromkeys(self._camera_names, image))
        return gym.spaces.Dict(spaces)


def check_settings(task: str, obs_type: str, cameras: list[str] | tuple[str, ...], image_size: int, fps: int) -> None:
    """Validate what a user may set.

    Raises:
        ConfigError: an unknown task, obs_type or camera, none or a repeated camera, or a number out of range.
    """
    if task not in TASKS:
        raise ConfigError(one_of("task", task, TASKS))
    check_cameras(obs_type, cameras, CAMERAS, image_size)
    if fps not in (5, 10, 20, 25, 50):
        raise ConfigError(f"fps is {fps}: expected 5, 10, 20, 25 or 50 (whole physics steps of 4 ms).")
