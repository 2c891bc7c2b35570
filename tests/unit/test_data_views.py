"""What operations make of an episode's numbers: inverses, sums and edges that must hold for any data."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cqn_data.decisions.deltas import absolute_action, delta_action, to_absolute, to_delta
from cqn_data.decisions.episode_rules import parse_rule
from cqn_data.disk.source import open_source
from cqn_data.operations.label import Label
from cqn_data.operations.resample import Resample
from cqn_data.operations.trim import Trim
from cqn_data.views.bounded import quantile_bounds
from cqn_data.views.episode import Bounds, Episode
from cqn_data.views.resampled import Resampled, windows
from cqn_data.views.selected import Selected, select
from cqn_data.views.view import DerivedView, View
from lerobot_cqn.delta_actions import KINDS, DeltaJoints
from lerobot_cqn.errors import ConfigError, DataError

from ..toy_datasets import make_dataset

JOINTS = DeltaJoints("command", (0, 1), (0, 1))
VECTOR = {"dtype": "float32", "shape": (3,), "names": ["a.pos", "b.pos", "gripper.pos"]}
REWARD = {"dtype": "float32", "shape": (1,), "names": None}


@dataclasses.dataclass
class Memory(DerivedView):
    """A source made of arrays."""

    parent: View | None = None
    data: dict = dataclasses.field(default_factory=dict)
    kind: DeltaJoints | None = None
    extra: dict = dataclasses.field(default_factory=dict)

    features = property(lambda self: {"observation.state": VECTOR, "action": VECTOR, **self.extra})
    fps = property(lambda self: 30)
    episodes = property(lambda self: list(self.data))
    deltas = property(lambda self: self.kind)
    bounds = property(lambda self: None)

    def episode(self, index):
        return self.data[index]

    def settle(self, written):
        pass


def make_episode(state, action, index=0, **columns):
    steps = len(state)
    arrays_ = {"observation.state": np.float32(state), "action": np.float32(action), **columns}
    return Episode(index, 0, np.arange(steps), np.arange(steps) / 30, arrays_, ["x"] * steps)


@st.composite
def episodes(draw, kinds=(None, *KINDS), least=1):
    """An episode of any kind of actions, with what it is."""
    steps = draw(st.integers(least, 30))
    values = arrays(np.float32, (steps, 3), elements=st.floats(-10, 10, width=32))
    kind = draw(st.sampled_from(kinds))
    deltas = None if kind is None else DeltaJoints(kind, (0, 1), (0, 1))
    return make_episode(draw(values), draw(values)), deltas


@given(episodes(kinds=KINDS))
def test_absolute_actions_come_back_from_deltas(case):
    episode, deltas = case
    state, action = (episode.columns[k][:, :2] for k in ("observation.state", "action"))
    back = to_absolute(to_delta(action, state, deltas.kind), state, deltas.kind)
    expected = action if deltas.kind != "state" else np.concatenate([state[1:], action[-1:]])
    np.testing.assert_allclose(back, expected, atol=1e-5)
    through = delta_action({**episode.columns, "action": absolute_action(episode.columns, deltas)}, deltas)
    if deltas.kind != "state":
        np.testing.assert_allclose(through, episode.columns["action"], atol=1e-4)
    np.testing.assert_array_equal(through[:, 2], episode.columns["action"][:, 2])  # the gripper stays absolute


@given(episodes(), st.data())
def test_chosen_steps_keep_their_commands_and_connect_their_states(case, data):
    episode, deltas = case
    rows = np.array(sorted(data.draw(st.sets(st.integers(0, len(episode) - 1), min_size=1))))
    chosen = select(episode, rows, deltas)
    state, action = chosen.columns["observation.state"], chosen.columns["action"]
    np.testing.assert_array_equal(state, episode.columns["observation.state"][rows])
    np.testing.assert_array_equal(chosen.frames, rows)
    if deltas is None:
        np.testing.assert_array_equal(action, episode.columns["action"][rows])
    elif deltas.kind == "state":
        np.testing.assert_allclose((state + action)[:-1, :2], state[1:, :2], atol=1e-4)
    else:  # what was commanded at a step is still commanded there
        before = absolute_action(episode.columns, deltas)[rows]
        np.testing.assert_allclose(absolute_action(chosen.columns, deltas), before, atol=1e-3)


@given(st.integers(1, 200), st.integers(2, 60), st.data())
def test_windows_of_a_lower_rate_cover_every_step_once(steps, old, data):
    new = data.draw(st.integers(1, old - 1))
    rows = windows(steps, old, new)
    assert rows[0] == 0
    assert (np.diff(rows) >= 1).all()
    assert rows[-1] < steps
    assert -(-steps * new // old) - len(rows) in (0, 1)
    assert (np.abs(rows / old - np.arange(len(rows)) / new) <= 0.5 / old + 1e-9).all()


@given(episodes(kinds=(None, "command", "command_steps")), st.integers(1, 29), st.data())
def test_resampling_loses_no_reward_and_no_command(case, rate, data):
    episode, deltas = case
    bits = arrays(np.bool_, (len(episode), 1))
    reward = np.float32(data.draw(bits))
    episode = episode.with_columns({"next.reward": reward, "next.done": data.draw(bits)})
    after = Resampled(Memory(data={0: episode}, kind=deltas), rate=rate).episode(0)
    assert after.columns["next.reward"].sum() == reward.sum()
    assert after.columns["next.done"].any() == episode.columns["next.done"].any()
    rows = windows(len(episode), 30, rate)
    ends = np.append(rows[1:], len(episode)) - 1
    wanted = episode.columns["action"] if deltas is None else absolute_action(episode.columns, deltas)
    got = after.columns["action"] if deltas is None else absolute_action(after.columns, deltas)
    np.testing.assert_allclose(got, wanted[ends], atol=1e-3)


def test_resampling_needs_a_lower_rate():
    view = Memory(data={0: make_episode(np.zeros((4, 3)), np.zeros((4, 3)))})
    with pytest.raises(ConfigError, match="frames cannot be invented"):
        Resample(fps=30).on(view)


@given(st.lists(arrays(np.float32, st.tuples(st.integers(1, 40), st.just(3)), elements=st.floats(-5, 5, width=32)),
                min_size=1, max_size=4), st.floats(0, 0.4))  # fmt: skip
def test_bounds_leave_out_the_share_asked_for(parts, quantile):
    view = Memory(data={i: make_episode(np.zeros_like(v), v) for i, v in enumerate(parts)})
    found = quantile_bounds(view, list(view.episodes), quantile, margin=0.0)
    values = np.concatenate(parts).astype(np.float64)
    ordered = np.sort(values, axis=0)
    cut = int(np.floor(quantile * len(values) + 1e-9))
    width = ordered[-1] - ordered[0]
    assert (found.low <= ordered[cut] + 1e-9).all()
    assert (found.high >= ordered[-1 - cut] - 1e-9).all()
    if quantile == 0:
        np.testing.assert_array_equal(found.low, ordered[0])
        np.testing.assert_array_equal(found.high, ordered[-1])
    else:
        np.testing.assert_allclose(
            found.low, ordered[min(cut, len(values) - 1)], atol=float(width.max()) / 30000 + 1e-9
        )
    wide = quantile_bounds(view, list(view.episodes), quantile, margin=0.5)
    np.testing.assert_allclose(wide.high - wide.low, 2 * (found.high - found.low), atol=1e-9)


@given(arrays(np.float32, (20, 3), elements=st.floats(-5, 5, width=32)))
def test_a_margin_widens_differences_and_leaves_absolute_actions(values):
    view = Memory(data={0: make_episode(np.zeros_like(values), values)}, kind=DeltaJoints("state", (0, 2), (0, 2)))
    found = quantile_bounds(view, [0], 0.0, margin=0.25)
    low, high = values.min(axis=0).astype(np.float64), values.max(axis=0).astype(np.float64)
    spread = 0.25 * (high - low) * [1, 0, 1]
    np.testing.assert_allclose(found.low, low - spread)
    np.testing.assert_allclose(found.high, high + spread)


def test_bounds_end_where_steps_or_actions_change():
    @dataclasses.dataclass
    class Bounded(Memory):
        bounds = property(lambda self: Bounds(np.zeros(3), np.ones(3)))

    view = Bounded(data={0: make_episode(np.zeros((4, 3)), np.zeros((4, 3)))})
    assert DerivedView(view).bounds is not None
    assert Selected(view, rows={0: np.arange(4)}).bounds is None
    assert Resampled(view, rate=10).bounds is None


STEPS = {0: 12, 3: 30, 4: 7}


@pytest.fixture
def three():
    data = {}
    for index, steps in STEPS.items():
        state = np.zeros((steps, 3))
        state[:, 0] = np.linspace(0, index, steps)
        success = np.zeros((steps, 1), bool)
        success[steps // 2] = index == 3
        columns = {"next.success": success, "next.reward": np.float32(success)}
        data[index] = make_episode(state, state + 0.1, index, **columns)
    return Memory(data=data, extra={"next.reward": REWARD, "next.success": {**REWARD, "dtype": "bool"}})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("steps < 12", [4]),
        ("steps<=12", [0, 4]),
        ("seconds == 1", [3]),
        ("success == 1", [3]),
        ("return > 0.5", [3]),
        ("success != 1", [0, 4]),
        ("observation.state[a.pos].max >= 3", [3, 4]),
        ("observation.state[0] > 3.5", [4]),
        ("observation.state[a.pos].first == 0", [0, 3, 4]),
        ("observation.state.range > -1e-3", [0, 3, 4]),
        ("action[gripper.pos].mean < .2", [0, 3, 4]),
    ],
)
def test_rules(three, text, expected):
    rule = parse_rule(text, three.features)
    cases = {i: three.episode(i) for i in three.episodes}
    assert [i for i, e in cases.items() if rule.holds(e.columns, len(e), three.fps)] == expected


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("step < 3", "Did you mean 'steps'?"),
        ("steps", "Cannot read the rule"),
        ("steps < many", "Cannot read the rule"),
        ("observation.state[c.pos] > 1", "Unknown dimension"),
        ("steps.max < 3", "one number for an episode"),
        ("__import__('os').system('true') == 0", "Unknown quantity"),
    ],
)
def test_rules_that_cannot_be_read_are_refused_and_never_run(three, text, said):
    with pytest.raises(ConfigError, match=said.replace("?", r"\?")):
        parse_rule(text, three.features)


def test_labels(three):
    for options, won in (
        ({"all": True}, {0, 3, 4}),
        ({"episodes": [0, 4]}, {0, 4}),
        ({"failed": [4]}, {0, 3}),
        ({"column": "next.success"}, {3}),
        ({"rule": "steps < 13"}, {0, 4}),
    ):
        after = Label(**options).on(three)
        for index in three.episodes:
            columns = after.episode(index).columns
            last = np.arange(STEPS[index])[:, None] == STEPS[index] - 1
            np.testing.assert_array_equal(columns["next.done"], last)
            np.testing.assert_array_equal(columns["next.success"], last & (index in won))
            np.testing.assert_array_equal(columns["next.reward"], np.float32(last & (index in won)))
    with pytest.raises(ConfigError, match="No episode 1"):
        Label(episodes=[1]).on(three)
    for bad in (Label(), Label(all=True, failed=[0])):
        with pytest.raises(ConfigError, match="Expected one of --all"):
            bad.validate()


def test_trim_after_success_keeps_the_success_and_never_cuts_a_reward(three):
    after = Trim(after_success=True).on(three)
    assert {i: len(after.episode(i)) for i in after.episodes} == {0: 12, 3: 16, 4: 7}
    assert after.episode(3).columns["next.reward"][-1] == 1
    with pytest.raises(DataError, match="carries a reward"):
        Trim(tail=20).on(Selected(three, rows={3: np.arange(30)}))
    with pytest.raises(DataError, match="Only 0 of 12 steps would be left of episode 0"):
        Trim(tail=20).on(three)
    with pytest.raises(ConfigError, match="Nothing to trim"):
        Trim().validate()


@pytest.mark.parametrize("alone", [{"keep_still": 3}, {"auto": True}, {"threshold": 0.1}, {"cut_rewards": True}])
def test_settings_that_cut_nothing_by_themselves_are_refused(alone):
    with pytest.raises(ConfigError, match="Nothing to trim"):
        Trim(**alone).validate()


@pytest.mark.parametrize(("keep", "expected"), [(0, (5, 13)), (2, (3, 15)), (50, (0, 20))])
def test_trim_by_motion_leaves_the_still_steps_asked_for(keep, expected):
    state = np.zeros((20, 3))
    state[6:, 0] = np.minimum(np.arange(14), 6) + 1.0  # moves from step 5, rests from step 12
    view = Memory(data={0: make_episode(state, state)})
    after = Trim(motion=True, threshold=0.5, keep_still=keep).on(view)
    assert (after.episode(0).frames[0], after.episode(0).frames[-1] + 1) == expected


def test_a_source_and_what_is_made_of_it_can_be_shown(tmp_path):
    source = open_source("local/toy", str(make_dataset(tmp_path / "toy")))
    derived = Selected(source, rows={0: np.arange(3)})
    assert "Source" in repr(source)
    assert "Selected" in repr(derived)
    assert (derived.entry, isinstance(source, View)) == ({}, True)
