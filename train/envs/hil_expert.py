"""A scripted operator for gym_hil's tasks: it steers through the same four values as any policy, and pauses."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from .hil_config import STEP
from .scripted_pauses import Pauses

__all__ = ["HilTeleoperator"]

_MOVES = 18  # steps without pauses to pick up one object, about
_OVER = np.array([0.0, 0.0, 0.09])  # m, from an object to where the tool lines up
_ALIGNED = 0.012  # m, near enough across the floor to go down
_CARRY = 0.1  # m, height at which a box is carried
_HELD = 0.035  # m between tool and object in a closed gripper
_UP = np.array([0.0, 0.0, STEP])  # m, one step


class Goal(NamedTuple):
    """Place that the tool's target shall go to, (3,) m, the gripper's closure, and moments at which a person stops."""

    target: NDArray[np.float64]
    closure: float
    moments: tuple[str, ...] = ()


class Tool(Protocol):
    """Simulated gripper among objects, as the operator sees it.

    Attributes:
        objects: names of the movable objects.
        closure: the gripper's command, 0 (open) to 1 (closed).
        tip: measured position of the tool, (3,) m.
        target: position the tool is sent to, (3,) m.
    """

    objects: tuple[str, ...]

    @property
    def closure(self) -> float: ...
    @property
    def tip(self) -> NDArray[np.float64]: ...
    @property
    def target(self) -> NDArray[np.float64]: ...

    def place(self, name: str) -> NDArray[np.float64]:
        """Position of an object or field, (3,) m."""


class HilTeleoperator:
    """Operator that goes over an object, down, grasps, lifts, and in `arrange_boxes` carries it to its field.

    While moving, the action depends on the present state alone. While pausing it is a zero movement with the gripper
    as it was. Pauses come at the start, before grasping and at random.

    Attributes:
        pausing: whether the last `act` was a pause.
    """

    pausing: bool

    def __init__(self, env: Tool, pause_share: float = 0.0, seed: int = 0) -> None:
        """Steer `env` (unwrapped).

        Args:
            env: the environment, which the caller steps.
            pause_share: expected share of still steps, [0, 0.9].
            seed: of the pauses, until `reset` gives another.

        Raises:
            ConfigError: a value out of range.
        """
        self._env = env
        self._pauses = Pauses(pause_share, 1 + len(env.objects), _MOVES * len(env.objects))
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Begin an episode; call it after the environment's reset. The same seed gives the same pauses."""
        self._pauses.reset(np.random.default_rng(seed))
        self.pausing = False

    def act(self) -> NDArray[np.float32]:
        """Action for the present state, (4,) float32 within the action space."""
        goal = self._goal()
        self.pausing = self._pauses.next(goal.moments)
        if self.pausing:
            goal = Goal(self._env.target, round(self._env.closure))
        move = np.clip((goal.target - self._env.target) / STEP, -1.0, 1.0)
        return np.append(move, goal.closure).astype(np.float32)

    def _goal(self) -> Goal:
        env = self._env
        for name in env.objects:
            field = env.place(name.replace("block", "target")) if len(env.objects) > 1 else None
            held = env.closure > 0.5 and float(np.linalg.norm(env.place(name) - env.tip)) < _HELD
            if held:
                return self._carry(name, field)
            if field is None or float(np.linalg.norm((env.place(name) - field)[:2])) > 0.02:
                return self._reach(name)
        return Goal(env.target + _UP, 0.0)  # all is done: out of the way

    def _reach(self, name: str) -> Goal:
        place, tip = self._env.place(name), self._env.tip
        offset = float(np.linalg.norm((place - tip)[:2]))
        if offset > _ALIGNED and not (offset < 2 * _ALIGNED and tip[2] - place[2] < 0.06):
            return Goal(place + _OVER, 0.0)
        if tip[2] - place[2] > _ALIGNED:
            return Goal(place, 0.0, (f"grasp {name}",) if tip[2] - place[2] < 0.03 else ())
        return Goal(self._env.target, 1.0)

    def _carry(self, name: str, field: NDArray[np.float64] | None) -> Goal:
        place, target = self._env.place(name), self._env.target
        if field is None:
            return Goal(target + _UP, 1.0)
        across = target + (field - place) * [1.0, 1.0, 0.0]
        if float(np.linalg.norm((field - place)[:2])) > _ALIGNED:
            low = place[2] < _CARRY - 0.03
            return Goal(target + _UP if low else np.append(across[:2], _CARRY), 1.0)
        if place[2] > 0.03:
            return Goal(np.append(across[:2], 0.02), 1.0)
        return Goal(target, 0.0)
