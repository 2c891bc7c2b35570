"""Between a policy's action and an arm's goal: pure functions, in the robot's units.

What a delta is, the dataset's history says (`cqn_data.deltas`): the difference of a goal from the measured joints
("command", and "state", which is driven in the same way), or from the goal before ("command_steps").
"""

import numpy as np
from numpy.typing import NDArray

from cqn_data.deltas import Deltas

__all__ = ["action_of", "goal_of"]

Array = NDArray[np.float64]


def goal_of(action: Array, state: Array, last_goal: Array, deltas: Deltas | None) -> Array:
    """Absolute goal [D] of an action.

    Args:
        action: [D], differences in the dimensions that `deltas` names, absolute in the others.
        state: measured state [P], as the dataset orders it.
        last_goal: goal [D] before this one; at the start of an episode the measured joints.
        deltas: which dimensions are differences, and of what; None: none is.
    """
    goal = np.array(action, dtype=np.float64)
    if deltas is not None:
        dims = list(deltas.action_dims)
        goal[dims] += _base(state, last_goal, deltas)
    return goal


def action_of(goal: Array, state: Array, last_goal: Array, deltas: Deltas | None) -> Array:
    """The action [D] that asks for a goal [D]: how a person's goals become actions; the inverse of `goal_of`."""
    action = np.array(goal, dtype=np.float64)
    if deltas is not None:
        dims = list(deltas.action_dims)
        action[dims] -= _base(state, last_goal, deltas)
    return action


def _base(state: Array, last_goal: Array, deltas: Deltas) -> Array:
    if deltas.kind == "command_steps":
        return last_goal[list(deltas.action_dims)]
    return state[list(deltas.state_dims)]
