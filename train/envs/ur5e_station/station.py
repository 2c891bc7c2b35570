"""The station as a gymnasium environment, for all of its tasks."""

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..cameras import RENDER_SIZE
from ..sim_env import MujocoEnv, Observation, box_with_gripper
from .config import UR5eStationEnv
from .expert import ScriptedTeleoperator
from .task import Task
from .tasks import TASKS
from .ur5e import HOME, STATE_NAMES, TIMESTEP, Arm

__all__ = ["MAX_JOINT_SPEED", "UR5eStation"]

MAX_JOINT_SPEED = 1.0  # rad/s
_HOME_SPREAD = 0.03  # rad, of each joint at the start


class UR5eStation(MujocoEnv):
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
        arm: the simulated arm with the scene.
        station_task: the running task.
        action_kind: what the joint deltas are differences of, as `cqn-data delta --help` names it.
    """

    action_kind: ClassVar[str] = "command_steps"

    def __init__(self, **settings: Any) -> None:
        """Build the scene from fields of `UR5eStationEnv`.

        Raises:
            ConfigError: a setting that `UR5eStationEnv` refuses, or mujoco is missing.
        """
        config = UR5eStationEnv(**settings)
        self.station_task: Task = TASKS[str(config.task)]()
        self.arm = Arm(self.station_task.mjcf())
        super().__init__(config, self.arm.model)
        self._substeps = round(1.0 / (self.fps * TIMESTEP))
        self._command = np.array(HOME)
        self.task_description = self.station_task.description
        self.state_names = list(STATE_NAMES)
        self.action_names = list(STATE_NAMES)
        self.environment_state_names = list(self.station_task.state_names)
        self.action_space = box_with_gripper(6, MAX_JOINT_SPEED / self.fps)
        # A joint may touch its stop and give a little.
        self.observation_space.spaces["agent_pos"] = box_with_gripper(6, 2 * np.pi + 0.1)

    def _begin(self, seed: int | None) -> Observation:
        """Place arm and objects; an episode follows from its seed alone."""
        joints = np.array(HOME) + self.np_random.uniform(-_HOME_SPREAD, _HOME_SPREAD, 6)
        self.arm.place(joints, self.station_task.start_closure)
        self.station_task.reset(self.arm, self.np_random)
        self.arm.forward()
        self._command = joints
        return self._observe()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 1 / fps seconds.

        Raises:
            DataError: the action is not seven finite numbers.
        """
        checked = self._checked(action)
        wanted = self.arm.leashed(self._command + checked[:6])
        self.arm.drive(self._command, wanted, float(checked[6]), self._substeps)
        self._command = wanted
        success = self.station_task.success(self.arm)
        return self._observe(), float(success), success, False, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """The whole station, (360, 480, 3) uint8 RGB."""
        return self._cameras.picture(self.arm.data, "overview", *RENDER_SIZE, oversample=2)

    def scripted_teleoperator(
        self, pause_share: float = 0.0, seed: int = 0, tremor_rad: float = 0.0
    ) -> ScriptedTeleoperator:
        """A scripted operator for this environment."""
        return ScriptedTeleoperator(self, pause_share=pause_share, tremor_rad=tremor_rad, seed=seed)

    def _observe(self) -> Observation:
        joints = np.append(self.arm.joints, self.arm.closure).astype(np.float32)
        space = self.observation_space["agent_pos"]
        observation: Observation = {"agent_pos": np.clip(joints, space.low, space.high)}
        if self._with_state:
            observation["environment_state"] = self.station_task.state(self.arm).astype(np.float32)
        if self._camera_names:
            observation["pixels"] = self._pictures(self.arm.data)
        return observation
