"""`cqn-data inspect`: which history a recording needs, on recordings in which that is known."""

import numpy as np
import pytest

from cqn_data.inspection.history import FRAMES, STRIDES, History, history_finding, stacked
from cqn_data.inspection.regression import unexplained

EPISODES, STEPS = 8, 60


def states(seed, dims=2):
    """Episodes of independent values, so that no state tells of another."""
    rng = np.random.default_rng(seed)
    return [rng.uniform(-1, 1, (STEPS, dims)) for _ in range(EPISODES)]


def compare(recorded, actions):
    """A History of episodes of states and actions."""
    shares = {
        (f, s): unexplained([stacked(x, f, s) for x in recorded], actions)
        for f in FRAMES
        for s in (STRIDES if f > 1 else (1,))
    }
    return History(shares, [f"joint_{i}" for i in range(actions[0].shape[1])], ["observation.state"])


@pytest.mark.parametrize(("ago", "frames"), [(0, 1), (1, 2), (3, 4), (7, 8)])
def test_an_action_that_follows_from_an_earlier_state_needs_the_frames_back_to_it(ago, frames):
    recorded = states(ago)
    actions = [np.sin(2 * x[np.maximum(np.arange(STEPS) - ago, 0)]) for x in recorded]
    history = compare(recorded, actions)
    assert history.advised() == frames
    assert history.mean(frames) < 0.3
    if ago:
        assert history.mean(frames // 2) > 0.7
        (finding,) = history_finding(history)
        assert f"--policy.frame_stack={frames}" in finding.advice


def test_frames_apart_reach_as_far_back_as_more_of_them():
    recorded = states(1)
    actions = [x[np.maximum(np.arange(STEPS) - 4, 0)] for x in recorded]
    history = compare(recorded, actions)
    assert history.mean(2, 4) < 0.2
    assert history.mean(8) < 0.4
    assert history.mean(2, 1) > 0.7
    assert history.mean(2, 2) > 0.7


def test_actions_without_a_cause_need_no_history():
    rng = np.random.default_rng(3)
    history = compare(states(2), [rng.normal(size=(STEPS, 3)) for _ in range(EPISODES)])
    assert history.advised() == 1
    assert not list(history_finding(history))
    assert history.mean(1) == pytest.approx(1.0, abs=0.15)


def test_one_dimension_that_needs_it_is_named_among_others():
    recorded = states(4)
    actions = [np.column_stack([x[:, 0], x[:, 1], np.roll(x[:, 0], 1)]) for x in recorded]
    history = compare(recorded, actions)
    (finding,) = history_finding(history)
    assert "'joint_2'" in finding.text
    assert "frame_stack=2" in finding.advice


def test_the_same_recording_gives_the_same_figures():
    recorded = states(5)
    first, again = (compare(recorded, [x**2 for x in recorded]) for _ in range(2))
    assert all(np.array_equal(first.shares[key], again.shares[key]) for key in first.shares)


def test_the_first_state_stands_for_those_before_it():
    values = np.arange(6.0).reshape(3, 2)
    assert stacked(values, 2, 2).tolist() == [[0, 1, 0, 1], [2, 3, 0, 1], [4, 5, 0, 1]]
