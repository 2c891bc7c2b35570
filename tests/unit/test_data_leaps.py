"""Leaps at the start of episodes: found where the arm stood elsewhere than the leader, and nowhere else."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cqn_data.decisions.leaps import Leaps


def driving(rng: np.random.Generator, steps: int, joints: int) -> tuple[np.ndarray, np.ndarray]:
    """Commands on a smooth path, and an arm that goes a third of the way to its command in each step."""
    phase, pace = rng.uniform(0, 6, joints), rng.uniform(0.02, 0.1, joints)
    action = 40 * np.sin(phase + pace * np.arange(steps)[:, None])
    state = np.empty_like(action)
    state[0] = action[0]
    for t in range(1, steps):
        state[t] = state[t - 1] + (action[t - 1] - state[t - 1]) / 3
    return action, state


@given(
    st.integers(0, 2**31), st.integers(1, 6), st.integers(1, 8), st.integers(40, 120), st.integers(1, 9),
    st.sampled_from((-1.0, 1.0)),
)  # fmt: skip
def test_it_finds_where_the_arm_stood_elsewhere(
    seed: int, joints: int, episodes: int, steps: int, leap: int, side: float
) -> None:
    rng, leaps, made = np.random.default_rng(seed), Leaps(), {}
    for number in range(0, 3 * episodes, 3):
        action, state = driving(rng, steps, joints)
        if rng.random() < 0.4:
            joint = int(rng.integers(joints))
            state[:leap, joint] = action[:leap, joint] + side * rng.uniform(200, 400, leap)
            made[number] = (leap, joint)
        leaps.add(number, action, state)
    found = leaps.found()
    assert {n: (steps, joint) for n, (steps, joint, _) in found.items()} == made
    assert all(times > 2 for *_, times in found.values())


def test_what_comes_later_or_is_usual_is_no_leap() -> None:
    rng = np.random.default_rng(0)
    leaps = Leaps()
    for number in range(5):
        action, state = driving(rng, 60, 3)
        state[30:34] += 150  # a push in the middle
        leaps.add(number, action, state)
    assert leaps.found() == {}
    still = Leaps()
    for number in range(3):
        place = np.tile([10.0, -20.0], (50, 1))
        still.add(number, place, place + np.array([0.2, -0.1]))  # holds, and hangs a little
    still.add(3, np.zeros((0, 2)), np.zeros((0, 2)))
    assert still.found() == {}
    assert Leaps().found() == {}


def test_an_arm_that_never_comes_does_not_leap() -> None:
    """It is far from its commands all along, which inspect says by another name."""
    rng, leaps = np.random.default_rng(1), Leaps()
    for number in range(4):
        action, state = driving(rng, 60, 2)
        leaps.add(number, action, state if number else state + 500)
    assert leaps.found() == {}
