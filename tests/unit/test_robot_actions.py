"""Actions and goals: the way back, and agreement with what the dataset tools write."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cqn_data.deltas import KINDS, Deltas, to_delta
from cqn_train.robot.actions import action_of, goal_of

J, P, T = 3, 5, 12
ACTION_DIMS, STATE_DIMS = (0, 1, 3), (0, 2, 4)  # the gripper in between stays absolute
vectors = arrays(np.float64, 4, elements=st.floats(-200, 200))
states = arrays(np.float64, P, elements=st.floats(-200, 200))


def deltas(kind: Any) -> Deltas | None:
    return None if kind is None else Deltas(kind, ACTION_DIMS, STATE_DIMS)


@pytest.mark.parametrize("kind", [None, *KINDS])
@given(goal=vectors, last=vectors, state=states)
def test_there_and_back(kind: Any, goal: Any, last: Any, state: Any) -> None:
    action = action_of(goal, state, last, deltas(kind))
    assert goal_of(action, state, last, deltas(kind)) == pytest.approx(goal, abs=1e-9)
    assert action[2] == goal[2]
    if kind is None:
        assert np.array_equal(action, goal)


@pytest.mark.parametrize("kind", ["command", "command_steps"])
def test_a_recording_is_driven_as_it_was(kind: Any) -> None:
    """Deltas as `cqn-data delta` forms them lead the arm through the recorded goals."""
    rng = np.random.default_rng(0)
    state = np.cumsum(rng.normal(0, 1, (T, P)), axis=0)
    goals = np.insert(state[:, STATE_DIMS] + rng.normal(0, 2, (T, J)), 2, rng.uniform(0, 100, T), axis=1)
    recorded = goals.copy()
    recorded[:, ACTION_DIMS] = to_delta(goals[:, ACTION_DIMS], state[:, STATE_DIMS], kind)
    last = np.insert(state[0, list(STATE_DIMS)], 2, 0.0)  # at the start: the measured joints
    for t in range(T):
        last = goal_of(recorded[t], state[t], last, deltas(kind))
        assert last == pytest.approx(goals[t])


def test_inputs_are_left_alone() -> None:
    action, state, last = np.ones(4), np.ones(P), np.ones(4)
    goal_of(action, state, last, deltas("command"))
    action_of(action, state, last, deltas("command"))
    assert action.tolist() == [1, 1, 1, 1]
