"""A scripted operator: it steers through the same seven-value actions as any policy, and pauses like a person."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError

from ..scripted_pauses import Pauses
from .task import Goal, Task
from .ur5e import Arm

__all__ = ["ScriptedTeleoperator", "Station"]

_GAIN = 5.0  # 1/s, proportional approach once the speed cap no longer binds
_TURN_GAIN = 5.0  # 1/s, for the tool's orientation
_DAMPING = 0.03  # of the least squares: keeps joint rates low near singular poses
# Tool pointing down, fingers opening along the world's y; columns are the tool's axes.
_DOWN = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])


class Station(Protocol):
    """An arm at a task, as the operator sees it.

    Attributes:
        arm: the arm with everything around it.
        station_task: the running task.
        fps: control steps a second.
        action_space: `gymnasium.spaces.Box`, (7,), the bounds of joint deltas, rad a step, and of the gripper.
    """

    arm: Arm
    station_task: Task
    fps: int
    action_space: Any


class ScriptedTeleoperator:
    """Proportional steering towards the task's goal by damped least squares, with human-like pauses.

    While moving, the action depends on the present state alone. While pausing it is a zero delta with the
    gripper as it was. Pauses come at the start, at the task's natural moments, and at random.

    Attributes:
        pausing: whether the last `act` was a pause: no steering, only the tremor if there is one.
    """

    pausing: bool

    def __init__(self, env: Station, pause_share: float = 0.0, tremor_rad: float = 0.0, seed: int = 0) -> None:
        """Steer an arm.

        Args:
            env: the environment (unwrapped) or another station, which the caller steps.
            pause_share: expected share of still steps, [0, 0.9].
            tremor_rad: standard deviation of noise on each joint delta, rad a step; pauses tremble too.
            seed: of pauses and tremor, until `reset` gives another.

        Raises:
            ConfigError: a value out of range.
        """
        if not 0.0 <= tremor_rad <= 0.05:
            raise ConfigError(f"tremor_rad is {tremor_rad}: expected 0 to 0.05 rad a step.")
        self._env = env
        self._tremor = tremor_rad
        task = env.station_task
        self._pauses = Pauses(pause_share, 1 + task.natural_pauses, task.typical_steps * env.fps / 10)
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Begin an episode; call it after the environment's reset. The same seed gives the same pauses."""
        self._rng = np.random.default_rng(seed)
        self._closure = self._env.arm.closure
        self._pauses.reset(self._rng)
        self.pausing = False

    def act(self) -> NDArray[np.float32]:
        """Action for the present state, (7,) float32 within the action space."""
        delta: NDArray[np.float64] = np.zeros(6)
        goal = self._env.station_task.goal(self._env.arm)
        self.pausing = self._pauses.next(range(1, goal.hesitate + 1))
        if not self.pausing:
            delta = self._steer(goal)
            self._closure = goal.closure
        if self._tremor > 0.0:
            delta = delta + self._rng.normal(0.0, self._tremor, 6)
        space = self._env.action_space
        return np.clip(np.append(delta, self._closure), space.low, space.high).astype(np.float32)

    def _steer(self, goal: Goal) -> NDArray[np.float64]:
        """Joint deltas, (6,) rad, for one step towards the goal at no more than its speed."""
        arm = self._env.arm
        move = (goal.tip - arm.tip) * min(_GAIN / self._env.fps, 1.0)
        cap = goal.speed / self._env.fps
        move *= min(1.0, cap / (float(np.linalg.norm(move)) + 1e-9))
        cos, sin = np.cos(goal.yaw), np.sin(goal.yaw)
        wanted = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        cos, sin = np.cos(goal.pitch), np.sin(goal.pitch)
        wanted = wanted @ np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]) @ _DOWN
        # Half the sum of the axes' cross products is the rotation vector for small angles.
        turn = 0.5 * np.cross(arm.tip_rotation.T, wanted.T).sum(axis=0) * min(_TURN_GAIN / self._env.fps, 1.0)
        jacobian = arm.jacobian()
        damped = jacobian @ jacobian.T + _DAMPING**2 * np.eye(6)
        delta = jacobian.T @ np.linalg.solve(damped, np.concatenate([move, turn]))
        limit = float(self._env.action_space.high[0])
        # Scaled as a whole: clipping one joint would bend the path.
        scaled: NDArray[np.float64] = delta * min(1.0, limit / (float(np.abs(delta).max()) + 1e-9))
        return scaled
