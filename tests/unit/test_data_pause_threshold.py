"""The automatic threshold: histograms with known answers, and the station's recordings, where pauses are known."""

import logging
import os
import time

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from cqn_data.decisions.pause_threshold import BINS, Motion, suggest
from cqn_data.decisions.pauses import Rule, keep_mask
from lerobot_cqn.errors import DataError

JOINTS = 6


def walk(rng, moves, speed=0.03, noise=0.0, still=0.0, tick=0.0):
    """(T, 6) joints that stop and go: 12 to 20 moving steps of about `speed`, then a pause, `moves` times."""
    steps = []
    for _ in range(moves):
        direction = rng.uniform(-1, 1, JOINTS)
        direction /= np.abs(direction).max()
        going = int(rng.integers(12, 21))
        steps += [direction * speed * rng.uniform(0.6, 1.4) for _ in range(going)]
        steps += [np.zeros(JOINTS)] * round(going * still / (1 - still))
    joints = np.cumsum(steps, axis=0) + rng.normal(0, noise, (len(steps), JOINTS))
    return np.round(joints / tick) * tick if tick else joints


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-4, 1e-3])
@pytest.mark.parametrize("still", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("unit", [1.0, 57.3])
def test_the_cut_lies_in_the_gap(noise, still, unit):
    rng = np.random.default_rng(0)
    found = suggest([unit * walk(rng, 8, noise=noise, still=still) for _ in range(10)])
    assert found.clear
    assert 6 * noise * unit < found.threshold < 0.018 * unit
    assert found.share == pytest.approx(still, abs=0.05)
    assert "gap" in found.reason


def test_a_single_encoder_step_is_not_motion():
    rng = np.random.default_rng(1)
    speeds = 10 ** rng.normal(-0.3, 0.5, (3000, 1)) * np.repeat(rng.random(150) < 0.6, 20)[:, None]
    joints = np.cumsum(speeds * rng.choice([-1, 1], (3000, JOINTS)), axis=0)  # all speeds, and pauses of 20 steps
    found = suggest([np.round(joints, 1)])
    assert found.clear
    assert found.threshold == pytest.approx(0.15, rel=0.05)
    assert found.unmoved > 0.25
    assert "encoder" in found.reason


def test_slow_motion_in_noise_is_left_to_a_person():
    rng = np.random.default_rng(2)
    speeds = 10 ** rng.normal(-2, 0.4, (2000, 1))
    joints = np.cumsum(speeds * rng.choice([-1, 1], (2000, JOINTS)), axis=0) + rng.normal(0, 2e-3, (2000, JOINTS))
    found = suggest([joints])
    assert not found.clear
    assert found.share <= 0.13  # a tenth, to a bin


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_without_pauses_next_to_nothing_goes(noise):
    rng = np.random.default_rng(3)
    found = suggest([walk(rng, 8, noise=noise) for _ in range(10)])
    assert not found.clear
    assert found.share < 0.01


@pytest.mark.parametrize("episodes", [[], [np.zeros((1, 2))], [np.zeros((9, 2))], [np.zeros((5, 0))]])
def test_nothing_that_moves_still_gives_an_answer(episodes):
    found = suggest(episodes)
    assert found.threshold > 0
    assert not found.clear
    assert len(found.edges) == len(found.counts) + 1


def test_refuses_what_it_cannot_measure():
    motion = Motion()
    motion.add(np.zeros((3, 2)))
    with pytest.raises(DataError, match="got shape"):
        motion.add(np.zeros((3, 4)))
    with pytest.raises(DataError, match="not finite"):
        motion.add(np.full((3, 2), np.nan))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.lists(st.sampled_from([0.0, 1e-7, 0.001, 0.0011, 0.02, 0.5, 300.0]), min_size=1), max_size=5),
    st.floats(1e-3, 1e3),
)
def test_whatever_moves_the_answer_is_consistent(moves, unit):
    episodes = [np.cumsum(np.array(m) * unit)[:, None] for m in moves]
    found = suggest(episodes)
    motion = np.concatenate([np.zeros(0), *(np.abs(np.diff(e[:, 0])) for e in episodes)])
    assume(not ((motion > 0) & (motion < 1e-9)).any())  # at the histogram's end; below it counts as no motion
    assert found.steps == len(motion)
    assert found.counts.sum() == len(motion)
    assert 0 < found.threshold < np.inf
    thresholds = [a.threshold for a in found.alternatives]
    shares = [a.share for a in found.alternatives]
    assert thresholds == sorted(set(thresholds))
    assert found.threshold in thresholds
    assert shares == sorted(shares)
    if len(motion):
        for alternative in found.alternatives:  # shares are read from bins 6 % wide
            low, high = ((motion < alternative.threshold * f).mean() for f in (0.94, 1.06))
            assert low <= alternative.share <= high


def test_the_order_and_the_size_of_episodes_do_not_matter():
    rng = np.random.default_rng(4)
    episodes = [walk(rng, 6, noise=1e-4, still=0.4) for _ in range(6)]
    one, two = suggest(episodes), suggest(episodes[::-1])
    assert one.threshold == two.threshold
    np.testing.assert_array_equal(one.counts, two.counts)


def test_a_million_steps_are_cheap():
    joints = np.cumsum(np.random.default_rng(5).normal(size=(100_000, JOINTS)), axis=0)
    motion = Motion()
    start = time.process_time()
    for _ in range(10):
        motion.add(joints)
    assert motion.suggest().steps == 999_990
    assert time.process_time() - start < 5
    assert motion._joints.nbytes + motion._noise.nbytes + motion._steps.nbytes == 8 * (BINS + 1) * (2 * JOINTS + 1)


# --- The station, whose operator knows when it pauses.


def station_episodes(task, share, tremor, seed):
    """(state (T, 7), action (T, 7), pause (T,)) of each successful episode, as `cqn-data record` would keep them."""
    pytest.importorskip("mujoco")
    from cqn_train.envs.ur5e_station.station import UR5eStation

    env = UR5eStation(task=task)
    count = max(4, 240 // env.station_task.typical_steps)  # long episodes tell as much in smaller numbers
    operator = env.scripted_teleoperator(pause_share=share, seed=seed, tremor_rad=tremor)
    done = []
    for attempt in range(seed, seed + 4 * count):
        observation, _ = env.reset(seed=attempt)
        operator.reset(attempt)
        states, actions, pauses, success = [], [], [], False
        while not success and len(states) < 400:
            states.append(observation["agent_pos"])
            actions.append(operator.act())
            pauses.append(operator.pausing)
            observation, _, success, _, _ = env.step(actions[-1])
        if success:
            done.append((np.array(states), np.array(actions), np.array(pauses)))
        if len(done) == count:
            return done
    raise AssertionError(f"{task}: the operator fails too often")


def judge(episodes):
    """Suggestion, share of the pause steps removed, share of the others removed."""
    found = suggest([state[:, :6] for state, _, _ in episodes])
    rule = Rule(
        joints=tuple(range(6)),
        thresholds=(found.threshold,) * 6,
        gripper_state=(6,),
        gripper_action=(6,),
        gripper_threshold=found.threshold,
    )
    gone = np.concatenate([~keep_mask(state, action, rule) for state, action, _ in episodes])
    pause = np.concatenate([p for _, _, p in episodes])
    return found, gone[pause].mean(), gone[~pause].mean()


def station_tasks():
    from cqn_train.envs.ur5e_station.tasks import TASKS

    return sorted(TASKS)


@pytest.mark.parametrize("tremor", [0.0, 0.0003, 0.001, 0.002])
@pytest.mark.parametrize("share", [0.4, 0.5, 0.6])
@pytest.mark.parametrize("task", station_tasks())
def test_finds_the_pauses_of_the_station(task, share, tremor):
    for seed in (0, 5000):
        found, removed, lost = judge(station_episodes(task, share, tremor, seed))
        assert found.clear
        assert removed >= 0.9, (found, removed)
        assert lost <= 0.02, (found, lost)


def test_the_recorder_says_where_the_pauses_are(tmp_path):
    pytest.importorskip("mujoco")
    from cqn_data.cli import main
    from cqn_data.disk.source import open_source

    environment = dict(os.environ)
    try:
        arguments = ["record", "--env.type=ur5e_station", "--env.obs_type=state", "--repo_id=local/click"]
        options = [f"--root={tmp_path / 'click'}", "--episodes=6", "--pause_share=0.5", "--tremor_rad=0.001"]
        assert main([*arguments, *options]) == 0
    finally:  # the command silences its own process for good; this one goes on
        logging.disable(logging.NOTSET)
        os.environ.clear()
        os.environ.update(environment)
    source = open_source("local/click", str(tmp_path / "click"))
    assert source.features["complementary_info.is_pause"]["dtype"] == "bool"
    columns = [source.episode(i).columns for i in range(6)]
    names = ("observation.state", "action", "complementary_info.is_pause")
    episodes = [(c[names[0]], c[names[1]], c[names[2]][:, 0]) for c in columns]
    pause = np.concatenate([p for _, _, p in episodes])
    asked = np.concatenate([np.abs(a[:, :6]).max(axis=1) for _, a, _ in episodes])
    assert 0.3 < pause.mean() < 0.7
    assert 1e-4 < np.median(asked[pause]) < 3e-3 < np.median(asked[~pause])
    _, removed, lost = judge(episodes)
    assert removed >= 0.9
    assert lost <= 0.02


@pytest.mark.parametrize(("option", "said"), [("--tremor_rad=-1", "--tremor_rad >= 0"), ("--tremor_rad=inf", "finite")])
def test_tremor_is_checked(capsys, option, said):
    from cqn_data.cli import main

    assert main(["record", "--repo_id=a/b", option]) == 2
    assert said in capsys.readouterr().err
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("episodes", [1, 3, 20])
def test_motion_at_one_speed_is_no_encoder_step(episodes):
    """As scripted arms move: steps of one size, and pauses in which nothing moves at all."""
    speed = np.where((np.arange(40) % 20 < 8), 0.0, 0.1)
    joints = np.cumsum(speed)[:, None] * np.ones((1, 3))
    found = suggest([joints] * episodes)
    assert found.clear
    assert 0 < found.threshold < 0.09
