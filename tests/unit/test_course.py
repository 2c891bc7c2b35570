"""What an episode's states, actions and values say about how it went."""

import numpy as np
import pytest

from cqn_train.replay.course import Course, Shown, describe, how_it_failed

NOTHING = {"standing": None, "at_bounds": None, "distance": None, "q_begin": None, "q_middle": None, "q_end": None}


def course(states=None, actions=None, values=()):
    return Course(
        states=states, actions=np.zeros((0, 2)) if actions is None else np.asarray(actions, float),
        values=np.asarray(values, float),
    )  # fmt: skip


def test_standing_is_the_share_of_steps_in_which_nothing_moves():
    states = np.zeros((6, 3))
    states[3:, 1] = 0.5  # one step of five moves one value
    assert describe(course(states), Shown())["standing"] == pytest.approx(0.8)
    assert describe(course(), Shown()) == NOTHING
    assert describe(course(np.zeros((4, 0))), Shown()) == NOTHING


def test_values_are_told_by_thirds():
    said = describe(course(values=[0, 1, 2, 3, 4, 5, 6]), Shown())
    assert (said["q_begin"], said["q_middle"], said["q_end"]) == (1.0, 3.5, 5.5)
    assert describe(course(values=[1, 2]), Shown())["q_begin"] is None


def test_a_switch_is_no_action_at_its_bound():
    shown = Shown.of(np.zeros((4, 1)), np.array([[0.1, 1.0], [0.2, -1.0], [1.0, 1.0], [0.0, 1.0]]))
    said = describe(course(actions=[[1.0, 1.0], [0.5, -1.0], [-0.99, 1.0], [0.0, 1.0]]), shown)
    assert said["at_bounds"] == pytest.approx(0.5)  # the first dimension alone, in two of four steps
    only_switches = Shown.of(np.zeros((4, 1)), np.ones((4, 2)))
    assert describe(course(actions=[[1.0, 1.0]]), only_switches)["at_bounds"] is None


def test_distance_is_that_of_the_nearest_demonstrated_state():
    rng = np.random.default_rng(0)
    shown, states = rng.normal(size=(300, 5)), rng.normal(size=(7, 5))
    nearest = np.sqrt(((states[:, None] - shown[None]) ** 2).mean(-1)).min(1)  # one by one
    said = describe(course(states), Shown.of(shown, np.zeros((300, 2))))
    assert said["distance"] == pytest.approx(nearest.mean())
    assert describe(course(shown[:9]), Shown.of(shown, np.zeros((300, 2))))["distance"] == pytest.approx(0.0, abs=1e-6)


def test_many_demonstrated_states_are_thinned_out_evenly_with_both_ends():
    states = np.arange(10_000.0)[:, None]
    thin = Shown.of(states, np.zeros((10_000, 1))).states[:, 0]
    assert len(thin) == 2000
    assert (thin[0], thin[-1]) == (0, 9999)
    assert np.diff(thin).max() <= 6


@pytest.mark.parametrize(
    ("columns", "cut_off", "how"),
    [
        ({"standing": 0.6, "distance": 0.9}, True, "stood still"),
        ({"distance": 0.5, "at_bounds": 0.9}, True, "went elsewhere"),
        ({"at_bounds": 0.6}, True, "pushed at bounds"), ({}, True, "ran out of time"), ({}, False, "ended early"),
    ],
)  # fmt: skip
def test_a_failure_is_named_by_the_first_kind_that_applies(columns, cut_off, how):
    assert how_it_failed(NOTHING | columns, cut_off=cut_off) == how
