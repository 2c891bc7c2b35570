"""The hand of a person between a scripted operator and an environment."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from cqn_data.human_hand import Hand, HumanOperator, moving_dims
from lerobot_cqn.errors import ConfigError

CALM = Hand(**{habit.name: 0.0 for habit in fields(Hand)})
MOST = np.array([0.1, 0.2])
FPS = 10


class Script:
    """Steps towards a point in two dimensions, then closes the gripper; pauses where it is told to."""

    def __init__(self, pauses: tuple[int, ...] = ()) -> None:
        self.pauses = pauses

    def reset(self, seed: int) -> None:
        self.at, self.step, self.pausing = np.array([0.0, 0.0]), 0, False

    def act(self) -> np.ndarray[Any, Any]:
        left = np.array([1.0, -1.0]) - self.at
        self.pausing = self.step in self.pauses
        self.step += 1
        move = np.zeros(2) if self.pausing else np.clip(0.4 * left, -MOST, MOST)
        return np.append(move, float(np.abs(left).max() < 0.05)).astype(np.float32)


def drive(hand: Hand, seed: int = 0, steps: int = 60, pauses: tuple[int, ...] = ()) -> np.ndarray[Any, Any]:
    """Actions [steps, 3] of an episode in which every movement is carried out."""
    script = Script(pauses)
    operator = HumanOperator(script, hand, np.array([0, 1]), MOST, FPS)
    operator.reset(seed)
    actions = []
    for _ in range(steps):
        action = operator.act()
        script.at = script.at + action[:2]
        actions.append(action)
    return np.array(actions)


def test_without_habits_it_does_what_the_script_wants() -> None:
    script = Script()
    script.reset(0)
    wanted = []
    for _ in range(60):
        wanted.append(script.act())
        script.at = script.at + wanted[-1][:2]
    np.testing.assert_allclose(drive(CALM), wanted, atol=1e-6)


def test_the_same_seed_moves_the_same_way_and_another_one_another() -> None:
    assert np.array_equal(drive(Hand(), 3), drive(Hand(), 3))
    assert not np.array_equal(drive(Hand(), 3), drive(Hand(), 4))


@pytest.mark.parametrize("seed", range(5))
def test_no_movement_is_larger_than_the_environment_allows_and_the_gripper_is_left_alone(seed: int) -> None:
    wild = Hand(reaction_s=0.2, overshoot=0.6, tremor=0.5, drift=0.5, speed_spread=0.5, hesitation=0.3, detour=1.0)
    actions = drive(wild, seed)
    assert (np.abs(actions[:, :2]) <= MOST + 1e-6).all()
    assert set(np.unique(actions[:, 2])) <= {0.0, 1.0}


def test_each_habit_does_what_it_says() -> None:
    calm = drive(CALM)
    late = drive(replace(CALM, reaction_s=0.3))
    assert not late[:3, :2].any()  # three steps later
    np.testing.assert_allclose(late[3], calm[0], atol=1e-6)
    reached = drive(replace(CALM, reaction_s=0.2, overshoot=0.5))[:, :2].cumsum(0)
    assert reached[:, 0].max() > 1.05  # too far,
    assert abs(reached[-1, 0] - 1) < 0.03  # and back
    shaken = drive(replace(CALM, tremor=0.1), steps=400)[100:, :2] / MOST
    assert 0.05 < shaken.std() < 0.2
    assert abs(np.corrcoef(shaken[:-1, 0], shaken[1:, 0])[0, 1]) < 0.5  # from step to step anew
    spread = [drive(replace(CALM, speed_spread=0.4), seed)[0, 0] for seed in range(40)]
    assert np.std(np.log(spread)) > 0.1
    slow = np.mean([(np.abs(drive(replace(CALM, hesitation=0.4), seed)[:8, :2]).max(1) < 0.03) for seed in range(60)])
    assert 0.2 < slow < 0.5
    ways = {tuple(np.sign(drive(replace(CALM, detour=1.0), seed)[0, :2] - calm[0, :2])) for seed in range(60)}
    assert len(ways) >= 3  # straight on, or to a side; where it moves at its most already, one side is not to be seen


def test_pauses_are_those_of_the_script_and_only_tremble() -> None:
    hand = replace(Hand(), tremor=0.01, reaction_s=0.0)
    script = Script(pauses=(5, 6, 7))
    operator = HumanOperator(script, hand, np.array([0, 1]), MOST, FPS)
    operator.reset(1)
    said = []
    for step in range(12):
        action = operator.act()
        said.append(operator.pausing)
        if step in script.pauses:
            assert np.abs(action[:2] / MOST).max() < 0.05
    assert [i for i, pausing in enumerate(said) if pausing] == [5, 6, 7]


def test_movements_are_told_from_grippers() -> None:
    low, high = np.array([-1.0, -1.0, -1.0, 0.0, -3.0]), np.array([1.0, 1.0, 1.0, 1.0, 2.0])
    assert moving_dims(["x", "gripper.pos", "y", "z", "w"], low, high).tolist() == [0, 2]
    assert moving_dims(["a", "b", "Jaws", "d", "e"], low, high).tolist() == [0, 1]


def test_habits_have_ranges() -> None:
    with pytest.raises(ConfigError, match=r"`overshoot` must be 0 to 0\.9, got 1"):
        Hand(overshoot=1.0)
