"""Action sequences from the replay against a loop that takes one step after the other."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cqn_train.replay.buffer import Replay
from cqn_train.replay.episode import Episode

from .test_replay import GAMMA, D, make_episode, spans_of

Step = tuple[bool, bool]  # a person drove it; a pause lay before it
made_episodes = st.lists(
    st.lists(st.tuples(st.booleans(), st.sampled_from([False, False, True])), min_size=1, max_size=10),
    min_size=1,
    max_size=5,
)


def episode_of(number: int, steps: list[Step]) -> Episode:
    borders = tuple(i for i, (_, paused) in enumerate(steps) if paused and i)
    return replace(make_episode(number, len(steps)), taught=spans_of([taught for taught, _ in steps]), borders=borders)


def wanted(episode: Episode, steps: list[Step], t: int, sequence: int, fill: str) -> tuple[list[float], list[float]]:
    """Actions of a sequence that begins at t and which of them count, step by step."""
    actions, counts, at, cut = list[float](), list[float](), t, False
    for ahead in range(sequence):
        beyond = t + ahead
        if beyond < len(steps) and not cut and ahead:
            cut = steps[beyond][0] != steps[t][0] or steps[beyond][1]
        if beyond < len(steps) and not cut:
            at = beyond
            counts.append(1.0)
            actions.append(float(episode.action[at, 0]))
        else:
            counts.append(0.0 if cut or fill == "mask" else 1.0)
            actions.append(0.0 if fill == "zeros" else float(episode.action[at, 0]))
    return actions, counts


@settings(max_examples=80, deadline=None)
@given(made=made_episodes, sequence=st.integers(1, 6), fill=st.sampled_from(["zeros", "last", "mask"]))
def test_sequences_are_those_of_a_plain_loop(made: list[list[Step]], sequence: int, fill: str) -> None:
    replay, episodes = Replay(1, 2, GAMMA, sequence=sequence, fill=fill), []
    for number, steps in enumerate(made):
        episodes.append(episode_of(number, steps))
        replay.add(episodes[-1], demo=False, number=number)
    check(replay, made, episodes, sequence, fill)


def check(replay: Replay, made: list[list[Step]], episodes: list[Episode], sequence: int, fill: str) -> None:
    places = [(number, t) for number, steps in enumerate(made) for t in range(len(steps))]
    batch = replay.transitions(*(np.array(column) for column in zip(*places, strict=True)))
    assert batch.action.shape == (len(places), sequence * D)
    for row, (number, t) in enumerate(places):
        actions, counts = wanted(episodes[number], made[number], t, sequence, fill)
        np.testing.assert_allclose(batch.action[row].view(sequence, D)[:, 0].numpy(), actions, rtol=1e-6)
        assert np.ptp(batch.action[row].view(sequence, D).numpy(), axis=1).max() == 0
        flags = np.ones(sequence * D) if batch.real is None else batch.real[row].numpy()
        assert flags.reshape(sequence, D).tolist() == [[c] * D for c in counts]


@pytest.mark.parametrize("relabelled", [False, True])
def test_borders_outlive_the_process_and_a_change_of_mind(relabelled: bool, tmp_path: Path) -> None:
    made = [[(False, False), (False, True), (True, False), (True, False), (False, False), (False, True)]] * 2
    episodes = [episode_of(number, steps) for number, steps in enumerate(made)]
    first = Replay(1, 2, GAMMA, folder=tmp_path, sequence=4, fill="last")
    for number, episode in enumerate(episodes):
        first.add(episode, demo=False, number=number)
    if relabelled:  # an episode that counts as a demonstration as a whole is still not one driver's
        first.correct(1, success=True, demo=True)
    second = Replay(1, 2, GAMMA, folder=tmp_path, sequence=4, fill="last")
    second.reopen()
    check(second, made, episodes, 4, "last")
