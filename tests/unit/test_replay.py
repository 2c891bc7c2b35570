"""The replay against a loop that takes one step after the other."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cqn_train.replay.buffer import Replay
from cqn_train.replay.episode import Episode
from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import Batch

P, D, SIDE, GAMMA = 2, 3, 4, 0.9


def make_episode(number: int, length: int, *, terminated: bool = True, views: int = 0) -> Episode:
    """Numbers that tell where they come from: frame t of episode e holds 100 e + t, its action 1 / (100 e + t + 1)."""
    marks = 100 * number + np.arange(length + 1)
    rng = np.random.default_rng(number)
    return Episode(
        low_dim=np.stack([marks, -marks], axis=1).astype(np.float32),
        pixels=tuple(
            np.broadcast_to((view + marks % 251)[:, None, None, None], (length + 1, 3, SIDE, SIDE)).astype(np.uint8)
            for view in range(views)
        ),
        action=np.repeat(1 / (marks[:-1, None] + 1.0), D, axis=1).astype(np.float32),
        reward=rng.normal(size=length).astype(np.float32),
        terminated=terminated,
        success=terminated,
    )


def oracle(episode: Episode, t: int, stack: int, n: int) -> tuple[list[int], float, float, list[int]]:
    """Frames of the observation, n-step reward, discount, and frames of the observation to bootstrap from."""
    now = [max(t - back, 0) for back in reversed(range(stack))]
    reward, discount, at = 0.0, 1.0, t
    for _ in range(n):
        reward += discount * float(episode.reward[at])
        discount *= GAMMA
        at += 1
        if at == len(episode):
            if episode.terminated:
                discount = 0.0
            break
    return now, reward, discount, [max(at - back, 0) for back in reversed(range(stack))]


def locate(batch: Batch, row: int) -> tuple[int, int]:
    """Episode and step of a sample, read off its action."""
    mark = round(1 / float(batch.action[row, 0])) - 1
    return mark // 100, mark % 100


@settings(max_examples=40, deadline=None)
@given(
    lengths=st.lists(st.tuples(st.integers(1, 12), st.booleans()), min_size=1, max_size=5),
    stack=st.integers(1, 5),
    n=st.integers(1, 6),
    views=st.integers(0, 2),
)
def test_samples_are_those_of_a_plain_loop(lengths: list[tuple[int, bool]], stack: int, n: int, views: int) -> None:
    episodes = [make_episode(i, length, terminated=end, views=views) for i, (length, end) in enumerate(lengths)]
    replay = Replay(stack, n, GAMMA)
    for episode in episodes:
        replay.add(episode, demo=episode.success)
    batch = replay.sample(64, 0, np.random.default_rng(0))
    assert batch.reward.shape == batch.discount.shape == batch.demo.shape == (64, 1)
    for row in range(64):
        number, t = locate(batch, row)
        episode = episodes[number]
        now, reward, discount, later = oracle(episode, t, stack, n)
        assert float(batch.reward[row]) == pytest.approx(reward, abs=1e-5)
        assert float(batch.discount[row]) == pytest.approx(discount, abs=1e-6)
        assert float(batch.demo[row]) == episode.success
        for observation, frames in ((batch.observation, now), (batch.next_observation, later)):
            assert observation.low_dim is not None
            assert episode.low_dim is not None
            np.testing.assert_array_equal(observation.low_dim[row].numpy(), episode.low_dim[frames].reshape(-1))
            assert len(observation.pixels) == views
            for view, stored in zip(observation.pixels, episode.pixels, strict=True):
                assert view.dtype == torch.uint8
                np.testing.assert_array_equal(view[row].numpy(), stored[frames].reshape(3 * stack, SIDE, SIDE))


def test_every_step_is_reached() -> None:
    replay = Replay(1, 3, GAMMA)
    for number, length in enumerate((1, 4, 2)):
        replay.add(make_episode(number, length), demo=True)
    batch = replay.sample(400, 0, np.random.default_rng(1))
    assert {locate(batch, row) for row in range(400)} == {(0, 0), *((1, t) for t in range(4)), (2, 0), (2, 1)}


def test_a_time_limit_bootstraps_from_its_own_last_observation() -> None:
    replay = Replay(1, 3, GAMMA)
    replay.add(make_episode(0, 2, terminated=False), demo=False)
    replay.add(make_episode(1, 5), demo=True)
    batch = replay.sample(50, 0, np.random.default_rng(0))
    cut = [row for row in range(50) if locate(batch, row)[0] == 0]
    assert cut
    assert batch.next_observation.low_dim is not None
    for row in cut:
        assert batch.next_observation.low_dim[row, 0] == 2  # frame T, not the first one of the next episode
        assert float(batch.discount[row]) == pytest.approx(GAMMA ** (2 - locate(batch, row)[1]))


def test_uniform_over_episodes_then_over_steps() -> None:
    """Whole episodes weigh the same, however long: chi-square at the 0.1 % level, with a fixed seed."""
    lengths = (2, 40, 9, 1)
    replay = Replay(1, 1, GAMMA)
    for number, length in enumerate(lengths):
        replay.add(make_episode(number, length), demo=number < 2)
    count = 20_000
    batch = replay.sample(count, count, np.random.default_rng(5))
    places = [locate(batch, row) for row in range(2 * count)]
    everything = np.bincount([episode for episode, _ in places[:count]], minlength=4)
    assert ((everything - count / 4) ** 2 / (count / 4)).sum() < 16.27  # 3 degrees of freedom
    demos = np.bincount([episode for episode, _ in places[count:]], minlength=4)
    assert demos[2:].sum() == 0
    assert ((demos[:2] - count / 2) ** 2 / (count / 2)).sum() < 10.83  # 1 degree of freedom
    steps = np.bincount([step for episode, step in places[:count] if episode == 1], minlength=40)
    expected = everything[1] / 40
    assert ((steps - expected) ** 2 / expected).sum() < 73  # 39 degrees of freedom


def test_demonstrations_come_last_and_are_flagged() -> None:
    replay = Replay(1, 1, GAMMA)
    replay.add(make_episode(0, 3), demo=True)
    replay.add(make_episode(1, 3), demo=False)
    replay.add(make_episode(2, 3), demo=True)  # a relabelled success
    assert (replay.episodes, replay.demonstrations, replay.steps) == (3, 2, 9)
    batch = replay.sample(60, 40, np.random.default_rng(0))
    flags = batch.demo[:, 0].bool()
    assert flags[60:].all()
    assert not flags[:60].all()
    assert [locate(batch, row)[0] != 1 for row in range(100)] == flags.tolist()


def test_the_same_generator_draws_the_same_batch() -> None:
    replay = Replay(2, 3, GAMMA)
    replay.add(make_episode(0, 30), demo=True)
    one, other = (replay.sample(16, 16, np.random.default_rng(7)) for _ in range(2))
    assert torch.equal(one.action, other.action)
    assert torch.equal(one.reward, other.reward)


def test_pixels_without_state() -> None:
    filmed = make_episode(0, 4, views=1)
    replay = Replay(2, 1, GAMMA)
    replay.add(
        Episode(
            low_dim=None,
            pixels=filmed.pixels,
            action=filmed.action,
            reward=filmed.reward,
            terminated=True,
            success=True,
        ),
        demo=True,
    )
    batch = replay.sample(4, 0, np.random.default_rng(0))
    assert batch.observation.low_dim is None
    assert batch.observation.pixels[0].shape == (4, 6, SIDE, SIDE)


def test_growing_keeps_what_was_there() -> None:
    replay = Replay(1, 1, GAMMA)
    for number in range(60):
        replay.add(make_episode(number, 50), demo=False)
    batch = replay.sample(500, 0, np.random.default_rng(0))
    assert batch.observation.low_dim is not None
    for row in range(500):
        number, step = locate(batch, row)
        assert batch.observation.low_dim[row, 0] == 100 * number + step


@pytest.mark.parametrize(("count", "demo_count"), [(4, 0), (0, 4)])
def test_empty_stores_are_named(count: int, demo_count: int) -> None:
    replay = Replay(1, 1, GAMMA)
    if demo_count:
        replay.add(make_episode(0, 3), demo=False)
    with pytest.raises(DataError, match=r"Cannot sample .* 0 are demonstrations; give a dataset"):
        replay.sample(count, demo_count, np.random.default_rng(0))


@pytest.mark.parametrize("where", ["low_dim", "action", "reward"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_never_enter(where: str, value: float) -> None:
    replay = Replay(1, 1, GAMMA)
    episode = make_episode(0, 3)
    getattr(episode, where).flat[1] = value
    with pytest.raises(DataError, match="NaN or infinite"):
        replay.add(episode, demo=True)
    assert replay.episodes == 0


def test_shapes_must_fit_and_steps_must_exist() -> None:
    replay = Replay(1, 1, GAMMA)
    empty = make_episode(0, 0)
    with pytest.raises(DataError, match="at least one step"):
        replay.add(empty, demo=True)
    replay.add(make_episode(0, 3, views=1), demo=True)
    other = make_episode(1, 3, views=1)
    wide = Episode(
        low_dim=other.low_dim,
        pixels=other.pixels,
        action=other.action[:, :2],
        reward=other.reward,
        terminated=True,
        success=True,
    )
    with pytest.raises(DataError, match="do not fit"):
        replay.add(wide, demo=True)
    blurred = Episode(
        low_dim=other.low_dim,
        pixels=(other.pixels[0][..., :2],),
        action=other.action,
        reward=other.reward,
        terminated=True,
        success=True,
    )
    with pytest.raises(DataError, match="do not fit"):
        replay.add(blurred, demo=True)


# -- steps that a person drove ---------------------------------------------------------------------------------------

Spans = tuple[tuple[int, int], ...]
taught_episodes = st.lists(
    st.tuples(st.lists(st.booleans(), min_size=1, max_size=9), st.booleans(), st.booleans()), min_size=1, max_size=6
)  # who drove each step, whether it succeeded, whether that makes it a demonstration


def spans_of(flags: list[bool]) -> Spans:
    """Runs of True, one step after the other."""
    spans: list[tuple[int, int]] = []
    for step, flag in enumerate(flags):
        if flag and spans and spans[-1][1] == step:
            spans[-1] = (spans[-1][0], step + 1)
        elif flag:
            spans.append((step, step + 1))
    return tuple(spans)


def add_taught(replay: Replay, number: int, flags: list[bool], *, success: bool = False, demo: bool = False) -> None:
    """An episode of the run, in which a person drove the flagged steps."""
    episode = replace(make_episode(number, len(flags), terminated=success), taught=spans_of(flags))
    replay.add(episode, demo=demo, number=number)


def stores(replay: Replay) -> tuple[set[tuple[int, int]], set[tuple[int, int]]]:
    """Steps (episode, step) in both stores, as sampled; the flag of every row is checked on the way."""
    demos = bool(len(np.flatnonzero(replay._table.rows["demo"])))
    batch = replay.sample(2500, 2500 if demos else 0, np.random.default_rng(0))
    places = [locate(batch, row) for row in range(len(batch.action))]
    everything, shown = set(places[:2500]), set(places[2500:])
    # A step is shown wherever it comes from: the loss on demonstrations must see it in both halves.
    assert [place in shown for place in places] == batch.demo[:, 0].bool().tolist()
    return everything, shown


def expected(episodes: dict[int, tuple[list[bool], bool]]) -> tuple[set[tuple[int, int]], set[tuple[int, int]]]:
    """Episodes are number: (who drove, whether it is a demonstration)."""
    everything = {(number, t) for number, (flags, _) in episodes.items() for t in range(len(flags))}
    return everything, {(n, t) for n, t in everything if episodes[n][1] or episodes[n][0][t]}


@settings(max_examples=40, deadline=None)
@given(taught_episodes, st.booleans())
def test_steps_of_a_person_are_demonstrations_whatever_became_of_the_episode(
    made: list[tuple[list[bool], bool, bool]], by_step: bool
) -> None:
    replay = Replay(2, 3, GAMMA, by_step=by_step)
    held: dict[int, tuple[list[bool], bool]] = {}
    for number, (flags, success, relabel) in enumerate(made):
        add_taught(replay, number, flags, success=success, demo=success and relabel)
        held[number] = flags, success and relabel
    assert stores(replay) == expected(held)
    assert replay.demonstrations == sum(demo for _, demo in held.values())  # whole episodes only


@settings(max_examples=30, deadline=None)
@given(taught_episodes, st.data())
def test_correcting_and_forgetting_leave_what_a_person_drove(
    made: list[tuple[list[bool], bool, bool]], data: st.DataObject
) -> None:
    replay, held = Replay(1, 2, GAMMA), dict[int, tuple[list[bool], bool]]()
    for number, (flags, *_) in enumerate(made):
        add_taught(replay, number, flags)
        held[number] = flags, False
    for _ in range(4):
        number = data.draw(st.sampled_from(range(len(made))))
        change = data.draw(st.sampled_from(["success", "failure", "discard"]))
        there = number in held
        if change == "discard":
            assert replay.forget(number) == there
            held.pop(number, None)
        else:
            assert replay.correct(number, success=change == "success", demo=change == "success") == there
            if there:
                held[number] = held[number][0], change == "success"
    if held:
        assert stores(replay) == expected(held)


def test_what_makes_room_takes_its_taught_steps_along() -> None:
    row = 2 * 4 + D * 4 + 4
    replay = Replay(1, 1, GAMMA, capacity_gib=14 * row / 2**30)
    replay.add_demonstration(make_episode(0, 3))
    flags = [False, True, True, False]
    for number in (1, 2, 3):  # room for two of them: the third lies where the first was
        add_taught(replay, number, flags if number != 2 else [False] * 4)
    assert stores(replay) == expected({0: ([False] * 3, True), 2: ([False] * 4, False), 3: (flags, False)})


def test_taught_steps_are_found_again_by_a_later_process(tmp_path: Path) -> None:
    first = Replay(1, 1, GAMMA, folder=tmp_path)
    flags = {0: [True, False, True, True], 1: [False, True], 2: [True, True, False], 3: [True]}
    for number, driven in flags.items():
        add_taught(first, number, driven)
    first.correct(1, success=True, demo=True)
    first.correct(2, success=True, demo=True)
    first.correct(2, success=False, demo=False)
    first.forget(3)
    second = Replay(1, 1, GAMMA, folder=tmp_path)
    assert [place.taught for place in second.reopen()] == [spans_of(flags[n]) for n in range(3)]
    assert stores(second) == expected({0: (flags[0], False), 1: (flags[1], True), 2: (flags[2], False)})


def test_shown_steps_weigh_the_same_when_steps_are_sampled() -> None:
    replay = Replay(1, 1, GAMMA, by_step=True)
    replay.add(make_episode(0, 20), demo=True)
    add_taught(replay, 1, [True] * 3 + [False] * 50 + [True] * 17)
    count = 20_000
    batch = replay.sample(count, count, np.random.default_rng(5))
    places = [locate(batch, row) for row in range(2 * count)]
    shown = np.bincount([20 * number + (t if t < 20 else t - 50) for number, t in places[count:]], minlength=40)
    assert len(shown) == 40
    assert ((shown - count / 40) ** 2 / (count / 40)).sum() < 73  # 39 degrees of freedom, 0.1 %
    everything = sum(number == 1 for number, _ in places[:count])  # 70 of 90 steps, taught or not
    assert abs(everything / count - 70 / 90) < 0.012  # four standard deviations


@pytest.mark.parametrize("by_step", [False, True])
def test_full_windows_start_nowhere_near_the_end(by_step: bool) -> None:
    """The starts that the authors' replay draws; an episode that is shorter than a window keeps its first."""
    replay = Replay(1, 3, GAMMA, by_step=by_step, full_windows=True)
    lengths = [7, 3, 1, 2]
    for number, length in enumerate(lengths):
        replay.add(make_episode(number, length), demo=True)
    add_taught(replay, 4, [False] * 4 + [True] * 2)
    batch = replay.sample(2000, 2000, np.random.default_rng(0))
    places = [locate(batch, row) for row in range(4000)]
    full = {(n, t) for n, length in enumerate(lengths) for t in range(max(1, length - 2))}
    assert set(places[:2000]) == full | {(4, t) for t in range(4)}
    assert set(places[2000:]) == full | {(4, 4)}  # of what a person drove, the first is kept
