"""A scripted operator: steers through the same seven-value actions as any policy, and pauses like a person."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import ConfigError

from .task import Goal

if TYPE_CHECKING:
    from .station import UR5eStation

__all__ = ["ScriptedTeleoperator"]

_PAUSE_STEPS = (3, 15)  # shortest and longest hesitation, control steps
_MEAN_PAUSE = sum(_PAUSE_STEPS) / 2
_GAIN = 5.0  # 1/s, proportional approach once the speed cap no longer binds
_TURN_GAIN = 5.0  # 1/s, for the tool's orientation
_DAMPING = 0.03  # of the least squares: keeps joint rates low near singular poses
# Tool pointing down, fingers opening along the world's y; columns are the tool's axes.
_DOWN = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])


class ScriptedTeleoperator:
    """Proportional steering towards the task's goal by damped least squares, with human-like pauses.

    While moving, the action depends on the present state alone. While pausing it is a zero delta with the
    gripper as it was. Pauses come at the start, at the task's natural moments, and at random.

    Attributes:
        pausing: whether the last `act` was a pause: no steering, only the tremor if there is one.
    """

    pausing: bool

    def __init__(self, env: "UR5eStation", pause_share: float = 0.0, tremor_rad: float = 0.0, seed: int = 0) -> None:
        """Steer `env` (unwrapped).

        Args:
            env: the environment, which the caller steps.
            pause_share: expected share of still steps, [0, 0.9].
            tremor_rad: standard deviation of noise on each joint delta, rad a step; pauses tremble too.
            seed: of pauses and tremor, until `reset` gives another.

        Raises:
            ConfigError: a value out of range.
        """
        if not 0.0 <= pause_share <= 0.9:
            raise ConfigError(f"pause_share is {pause_share}: expected 0 to 0.9.")
        if not 0.0 <= tremor_rad <= 0.05:
            raise ConfigError(f"tremor_rad is {tremor_rad}: expected 0 to 0.05 rad a step.")
        self._env = env
        self._tremor = tremor_rad
        still_per_move = pause_share / (1.0 - pause_share)
        self._natural = min(1.0, still_per_move)  # probability of a pause at each natural moment, the start included
        moves = env.station_task.typical_steps * env.fps / 10
        expected = (1 + env.station_task.natural_pauses) * self._natural * _MEAN_PAUSE / moves
        self._hazard = float(np.clip((still_per_move - expected) / _MEAN_PAUSE, 0.0, 1.0))
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Begin an episode; call it after the environment's reset. The same seed gives the same pauses."""
        self._rng = np.random.default_rng(seed)
        self._closure = self._env.arm.closure
        self._left = self._pause() if self._rng.random() < self._natural else 0
        self._hesitated = 0
        self.pausing = False

    def act(self) -> NDArray[np.float32]:
        """Action for the present state, (7,) float32 within the action space."""
        delta: NDArray[np.float64] = np.zeros(6)
        goal = self._env.station_task.goal(self._env.arm)
        if self._left == 0:
            if goal.hesitate > self._hesitated:
                self._hesitated = goal.hesitate
                self._left = self._pause() if self._rng.random() < self._natural else 0
            elif self._rng.random() < self._hazard:
                self._left = self._pause()
        self.pausing = self._left > 0
        if self.pausing:
            self._left -= 1
        else:
            delta = self._steer(goal)
            self._closure = goal.closure
        if self._tremor > 0.0:
            delta = delta + self._rng.normal(0.0, self._tremor, 6)
        space = self._env.action_space
        return np.clip(np.append(delta, self._closure), space.low, space.high).astype(np.float32)

    def _pause(self) -> int:
        return int(self._rng.integers(_PAUSE_STEPS[0], _PAUSE_STEPS[1] + 1))

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
