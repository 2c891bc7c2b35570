"""Pauses of scripted operators: shares, lengths, moments."""

from itertools import groupby

import numpy as np
import pytest

from cqn_train.envs.scripted_pauses import Pauses
from lerobot_cqn.errors import ConfigError


def episode(pauses, seed, moves, moments=lambda moved: ()):
    """Whether each step was a pause, until `moves` others are done."""
    pauses.reset(np.random.default_rng(seed))
    steps = []
    while steps.count(False) < moves:
        steps.append(pauses.next(moments(steps.count(False))))
    return steps


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("moments", [0, 3])
def test_pauses_take_their_share(share, moments):
    pauses = Pauses(share, moments, moves=40)
    passed = (lambda moved: range(1, 1 + moved // 15)) if moments else (lambda moved: ())
    steps = [step for seed in range(200) for step in episode(pauses, seed, 40, passed)]
    assert np.mean(steps) == pytest.approx(share, abs=0.04)


def test_a_pause_lasts_3_to_15_steps_and_none_follows_at_once():
    steps = episode(Pauses(0.8), 0, 500)
    lengths = [len(list(run)) for pausing, run in groupby(steps) if pausing]
    assert (min(lengths), max(lengths)) == (3, 15)


def test_a_natural_moment_pauses_once_however_often_the_task_comes_to_it():
    pauses = Pauses(0.5, moments=2, moves=100)  # at 0.5 each natural moment is a pause
    steps = episode(pauses, 0, 30, lambda moved: ("grasp",) if moved >= 10 else ())
    assert steps[0]
    tenth = [i for i, step in enumerate(steps) if not step][9]
    assert steps[tenth + 1]
    assert episode(pauses, 0, 30) != steps
    assert episode(pauses, 0, 30, lambda moved: ("grasp",) if moved >= 10 else ()) == steps


@pytest.mark.parametrize("share", [-0.1, 0.95])
def test_wrong_shares_are_refused(share):
    with pytest.raises(ConfigError, match=r"expected 0 to 0\.9"):
        Pauses(share)
