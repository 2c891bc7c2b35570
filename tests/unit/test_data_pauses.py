"""The pause rule against a plain-loop oracle, and the promises its docstring makes."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cqn_data.decisions.pauses import Rule, keep_mask, pause_runs, report_episode
from lerobot_cqn.errors import DataError

THRESHOLD = 0.01


@st.composite
def episodes(draw, gripper=True):
    """Jerky walks with still stretches; (state (T, 3), action (T, 3)); the third dimension is the gripper."""
    steps = draw(st.integers(1, 40))
    size = st.sampled_from([0.0, 0.0, 0.0, 0.003, 0.006, -0.004, 0.0099, 0.02, -0.05])
    deltas = np.array(draw(st.lists(st.tuples(size, size), min_size=steps, max_size=steps)))
    hand = st.sampled_from([0.0, 0.0, 0.0, 0.0, 0.5] if gripper else [0.0])
    command = np.cumsum(draw(st.lists(hand, min_size=steps, max_size=steps)))
    joints = np.concatenate([np.zeros((1, 2)), np.cumsum(deltas, axis=0)[:-1]])
    measured = np.concatenate([command[:1], command[:-1]])
    return np.column_stack([joints, measured]), np.column_stack([deltas, command])


@st.composite
def rules(draw):
    return Rule(
        joints=(0, 1),
        thresholds=(THRESHOLD, draw(st.sampled_from([THRESHOLD, 0.005]))),
        gripper_state=(2,),
        gripper_action=(2,),
        gripper_threshold=0.1,
        keep_first=draw(st.integers(0, 3)),
        keep_last=draw(st.integers(1, 4)),
        min_pause=draw(st.integers(1, 4)),
        compare=draw(st.sampled_from(["after", "before"])),
    )


def differ(a, b, limits):
    return any(abs(x - y) >= limit for x, y, limit in zip(a, b, limits, strict=True))


def oracle_once(state, action, rule, always):
    """The rule once more, in plain Python, as the help text tells it; returns the kept steps."""
    total = len(state)
    after = rule.compare == "after"
    hands = [(state[min(t + 1, total - 1) if after else t, 2], action[t, 2]) for t in range(total)]
    hand, kept = (state[0, 2], action[0, 2]), set()
    for t in range(total):
        if any(abs(x - y) > rule.gripper_threshold for x, y in zip(hands[t], hand, strict=True)):
            hand = hands[t]
            kept.add(t)
    kept |= {t for t in range(total) if t < rule.keep_first or t >= total - rule.keep_last or always[t]}
    for t in reversed(range(total)) if after else range(total):
        others = [k for k in sorted(kept) if (k > t if after else k < t)]
        beside = None if not others else others[0] if after else others[-1]
        if t not in kept and (beside is None or differ(state[t, :2], state[beside, :2], rule.thresholds)):
            kept.add(t)
    t = 0
    while t < total:
        end = t
        while end < total and end not in kept:
            end += 1
        if 0 < end - t < rule.min_pause:
            kept |= set(range(t, end))
        t = end + 1
    return sorted(kept)


def oracle(state, action, rule, always):
    """Until nothing more goes."""
    rows = list(range(len(state)))
    while True:
        kept = oracle_once(state[rows], action[rows], rule, [always[r] for r in rows])
        if len(kept) == len(rows):
            return [t in rows for t in range(len(state))]
        rows = [rows[k] for k in kept]


@settings(max_examples=200, deadline=None)
@given(episodes(), rules(), st.randoms(use_true_random=False))
def test_mask_equals_the_oracle(episode, rule, random):
    state, action = episode
    always = np.array([random.random() < 0.1 for _ in state])
    mask = keep_mask(state, action, rule, always)
    assert mask.tolist() == oracle(state, action, rule, always)
    assert mask[-1]
    assert mask[always].all()
    assert all(length >= rule.min_pause for _, length in pause_runs(mask))
    report = report_episode(0, state, action, mask, rule)
    assert report.dropped == sum(length for _, length in report.runs) == (~mask).sum()


@settings(max_examples=200, deadline=None)
@given(episodes(), rules(), st.randoms(use_true_random=False))
def test_doing_it_again_drops_nothing(episode, rule, random):
    state, action = episode
    always = np.array([random.random() < 0.1 for _ in state])
    mask = keep_mask(state, action, rule, always)
    assert keep_mask(state[mask], action[mask], rule, always[mask]).all()


@settings(max_examples=100, deadline=None)
@given(episodes(gripper=False))
def test_dropped_steps_are_where_the_next_kept_step_is(episode):
    state, action = episode
    mask = keep_mask(state, action, Rule((0, 1), (THRESHOLD, THRESHOLD), (2,), (2,), 0.1))
    kept = np.flatnonzero(mask)
    for step in np.flatnonzero(~mask):
        beside = kept[np.searchsorted(kept, step)]
        assert np.abs(state[step, :2] - state[beside, :2]).max() < THRESHOLD


@settings(max_examples=100, deadline=None)
@given(episodes(gripper=False))
def test_kept_delta_actions_explain_the_motion_to_the_next_kept_step(episode):
    state, action = episode
    mask = keep_mask(state, action, Rule((0, 1), (THRESHOLD, THRESHOLD), (2,), (2,), 0.1))
    kept = np.flatnonzero(mask)
    for here, there in itertools.pairwise(kept):
        assert np.abs(state[here, :2] + action[here, :2] - state[there, :2]).max() < THRESHOLD + 1e-12


@given(st.floats(1e-4, THRESHOLD * 0.99), st.integers(2, 300), st.sampled_from(["after", "before"]))
def test_slow_drift_adds_up_and_is_kept(speed, steps, compare):
    state = np.arange(steps)[:, None] * speed
    mask = keep_mask(state, np.zeros((steps, 0)), Rule((0,), (THRESHOLD,), compare=compare))
    kept = np.flatnonzero(mask)
    # Between kept steps the arm moved by the threshold, and by less than one step more.
    gaps = np.diff(state[kept[:-1], 0])
    assert (gaps >= THRESHOLD - 1e-9).all()
    assert (gaps < THRESHOLD + speed + 1e-9).all()
    assert mask.sum() >= int(steps * speed / (THRESHOLD + speed)) - 1


def test_a_pause_keeps_the_action_that_ends_it():
    state = np.array([[0.0], [0.1], [0.1], [0.1], [0.2]])
    action = np.array([[0.1], [0.0], [0.0], [0.1], [0.0]])
    rule = Rule((0,), (0.05,))
    assert keep_mask(state, action, rule).tolist() == [True, False, False, True, True]


def test_gripper_alone_is_not_a_pause():
    state = np.zeros((8, 2))
    state[4:, 1] = [0.2, 0.4, 0.6, 0.6]
    action = np.zeros((8, 2))
    action[3:, 1] = 1.0
    rule = Rule((0,), (0.01,), (1,), (1,), 0.05)
    mask = keep_mask(state, action, rule)
    assert mask.tolist() == [False, False, False, True, True, True, False, True]
    report = report_episode(3, state, action, mask, rule)
    assert (report.gripper_events, report.dropped_near_gripper) == (3, 4)


def test_all_still_keeps_only_the_last():
    mask = keep_mask(np.zeros((10, 1)), np.zeros((10, 1)), Rule((0,), (0.01,)))
    assert np.flatnonzero(mask).tolist() == [9]


@pytest.mark.parametrize(("states", "actions"), [(0, 0), (3, 2)])
def test_lengths_are_checked(states, actions):
    with pytest.raises(DataError, match="as many actions as states"):
        keep_mask(np.zeros((states, 1)), np.zeros((actions, 1)), Rule((0,), (0.01,)))
