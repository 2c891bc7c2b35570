"""`cqn-data inspect --value_probe`: whether action sequences help, on recordings in which that is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from cqn_data.inspection.regression import Courses
from cqn_data.inspection.sequences import LENGTHS, noise_share, sequence_finding, sequences_of

EPISODES = 12


def course(make, seed=0):
    """Courses of episodes that `make(rng)` gives as states (M, S) and actions (M, A)."""
    rng = np.random.default_rng(seed)
    made = [make(rng) for _ in range(EPISODES)]
    actions = [a for _, a in made]
    return Courses(
        episodes=[SimpleNamespace(success=True) for _ in made], states=[s for s, _ in made], actions=actions,
        names=[f"joint_{i}" for i in range(actions[0].shape[1])], columns=["observation.state"],
    )  # fmt: skip


def towards(rng, told_by_state):
    """A way of some length at a constant speed; the state says how far it is, or the actions' slow swing does."""
    length = int(rng.integers(40, 90))
    left = (length - 1 - np.arange(length)) / 90
    state = np.column_stack([left if told_by_state else rng.normal(size=length), rng.normal(size=length)])
    # The speed falls with the distance, under noise as large as itself: one action tells little of it, many tell more.
    action = (left + rng.normal(0, 0.3, length))[:, None] if not told_by_state else rng.normal(size=(length, 1))
    return state, action


def test_a_state_that_tells_the_return_needs_no_sequence():
    found = sequences_of(course(lambda rng: towards(rng, True)))
    assert found.unexplained[1] < 0.05
    assert found.advised == 1
    assert not list(sequence_finding(found))
    assert "--policy.type=cqn." in found.sentence()


def test_what_only_many_noisy_actions_tell_speaks_for_sequences():
    found = sequences_of(course(lambda rng: towards(rng, False)))
    assert found.unexplained[16] < found.unexplained[4] < found.unexplained[1]
    assert found.advised > 1
    (finding,) = sequence_finding(found)
    assert f"--policy.action_sequence={found.advised}" in finding.advice


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_claimed_where_nothing_is_told(seed):
    def noise(rng):
        length = int(rng.integers(40, 90))
        return rng.normal(size=(length, 2)), rng.normal(size=(length, 2))

    found = sequences_of(course(noise, seed))
    assert not found.told
    assert found.advised == 1
    assert "Nobody can tell" in found.sentence()


def test_the_end_is_not_given_away_by_how_many_actions_are_left():
    """Constant actions: whatever is told would be told by the filling of sequences at the end."""

    def still(rng):
        length = int(rng.integers(40, 90))
        return rng.normal(size=(length, 2)), np.tile(rng.normal(size=2), (length, 1))

    found = sequences_of(course(still))
    assert min(found.unexplained.values()) > 0.85
    assert set(found.unexplained) == set(LENGTHS)


def test_short_or_equal_episodes_cannot_be_compared():
    assert sequences_of(course(lambda rng: (rng.normal(size=(16, 2)), rng.normal(size=(16, 1))))) is None


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_the_noise_of_smooth_movements(share):
    rng = np.random.default_rng(0)
    steps = np.arange(4000)
    smooth = np.sin(steps / 25)[:, None] * np.sqrt(2) * np.sqrt(1 - share)
    noisy = smooth + rng.normal(0, np.sqrt(share), (4000, 1))
    found = noise_share([noisy[:2000], noisy[2000:]], ["joint"])
    assert found["joint"] == pytest.approx(share, abs=0.05)


def test_a_gripper_is_not_noise():
    opened = np.repeat([0.0, 1.0, 0.0, 1.0], 10)[:, None]
    assert noise_share([opened], ["gripper"]) == {}
