"""Walks every registered task of the simulated station."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("mujoco")

from cqn_train.envs.cameras import Cameras
from cqn_train.envs.ur5e_station.config import CAMERAS, UR5eStationEnv
from cqn_train.envs.ur5e_station.station import MAX_JOINT_SPEED
from cqn_train.envs.ur5e_station.tasks import TASKS
from lerobot_cqn.errors import ConfigError

TASK_NAMES = sorted(TASKS)


@pytest.fixture
def make():
    opened = []

    def _make(task="click_button", **kwargs):
        env = gym.make(UR5eStationEnv(task=task).gym_id, **kwargs)
        opened.append(env)
        return env

    yield _make
    for env in opened:
        env.close()


def play(env, operator, seed):
    """One episode by the operator: (steps, still steps, success, truncated)."""
    env.reset(seed=seed)
    operator.reset(seed)
    steps = still = 0
    while True:
        action = operator.act()
        assert env.action_space.contains(action)
        still += not action[:6].any()
        _, reward, terminated, truncated, info = env.step(action)
        assert info["is_success"] is bool(reward)
        steps += 1
        if terminated or truncated:
            return steps, still, info["is_success"], truncated


@pytest.mark.parametrize("task", TASK_NAMES)
@pytest.mark.parametrize("fps", [10, 20])
def test_the_scripted_operator_succeeds(make, task, fps):
    env = make(task, fps=fps, max_episode_steps=TASKS[task].max_episode_steps * fps // 10)
    operator = env.unwrapped.scripted_teleoperator()
    results = [play(env, operator, seed) for seed in range(8)]
    assert all(success for _, _, success, _ in results)
    assert max(steps for steps, *_ in results) < TASKS[task].typical_steps * 2 * fps / 10


@pytest.mark.parametrize("task", TASK_NAMES)
def test_success_comes_by_the_operator_and_stays(make, task):
    env = make(task)
    station, operator = env.unwrapped, env.unwrapped.scripted_teleoperator()
    for seed in range(20):
        env.reset(seed=seed)
        assert not station.station_task.success(station.arm)
    play(env, operator, 19)
    for _ in range(10):  # physics holds it while the arm stands still
        success = station.step(np.append(np.zeros(6), operator.act()[6]))[2]
        assert success


@pytest.mark.parametrize("task", TASK_NAMES)
def test_objects_never_jump(make, task):
    env = make(task)
    operator, data = env.unwrapped.scripted_teleoperator(), env.unwrapped.arm.data
    env.reset(seed=2)
    operator.reset(2)
    ended = False
    while not ended:
        before = data.xpos.copy()
        ended = env.step(operator.act())[2]
        assert np.abs(data.xpos - before).max() < 0.12  # m in a tenth of a second


@pytest.mark.parametrize("task", TASK_NAMES)
def test_pauses_take_the_share_asked_for(make, task):
    env = make(task, max_episode_steps=4 * TASKS[task].max_episode_steps)
    operator = env.unwrapped.scripted_teleoperator(pause_share=0.45)
    results = [play(env, operator, seed) for seed in range(20)]
    assert all(success for _, _, success, _ in results)
    assert np.mean([still / steps for steps, still, *_ in results]) == pytest.approx(0.45, abs=0.08)


@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_operator_repeats_itself_and_bears_tremor(make, task):
    env = make(task, max_episode_steps=4 * TASKS[task].max_episode_steps)
    operator = env.unwrapped.scripted_teleoperator(pause_share=0.3, tremor_rad=0.004)
    assert play(env, operator, 5) == play(env, operator, 5)
    assert play(env, operator, 5)[2]


@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_time_limit_truncates(make, task):
    env = make(task, max_episode_steps=4)
    assert env.get_wrapper_attr("_max_episode_steps") == 4
    env.reset(seed=0)
    still = np.zeros(7, np.float32)
    ends = [env.step(still)[2:4] for _ in range(4)]
    assert ends == [(False, False)] * 3 + [(False, True)]


@pytest.mark.parametrize("task", TASK_NAMES)
def test_a_still_arm_stays(make, task):
    env = make(task)
    start = env.reset(seed=0)[0]["agent_pos"]
    for _ in range(20):
        end = env.step(np.zeros(7, np.float32))[0]["agent_pos"]
    np.testing.assert_allclose(end[:6], start[:6], atol=2e-3)


def test_a_button_pushed_by_anything_else_is_no_success(make):
    station = make().unwrapped
    station.reset(seed=0)
    station.arm.data.joint("plunger").qpos[0] = 0.015
    station.arm.forward()
    assert not station.station_task.success(station.arm)


def test_the_glass_still_stands_when_let_go(make):
    env = make("flip_cup")
    station, operator = env.unwrapped, env.unwrapped.scripted_teleoperator()
    for seed in range(4):
        play(env, operator, seed)
        for lift in [0.0] * 5 + [-0.03] * 10:
            success = station.step(np.array([0, lift, 0, 0, 0, 0, 0]))[2]
        assert success


def test_a_lid_that_is_let_go_falls_back(make):
    env = make("take_lid_off_saucepan")
    play(env, env.unwrapped.scripted_teleoperator(), 0)
    for _ in range(5):
        success = env.unwrapped.step(np.zeros(7))[2]
    assert not success


def test_a_teddy_counts_only_in_the_open_drawer(make):
    station = make("open_drawer_put_teddy").unwrapped
    station.reset(seed=0)
    for opening, x, expected in [(0.18, 0.55, True), (0.10, 0.62, False), (0.18, 0.40, False)]:
        station.arm.data.joint("drawer").qpos[0] = opening
        station.arm.data.joint("teddy").qpos[:3] = x, 0.15, 0.03
        station.arm.forward()
        assert station.station_task.success(station.arm) is expected


def test_deltas_are_clipped_and_tracked(make):
    env = make()
    joints = env.reset(seed=0)[0]["agent_pos"][:6]
    for step in range(1, 6):
        measured = env.step(np.array([50, 0, 0, 0, 0, -50, 0.5], np.float32))[0]["agent_pos"][:6]
        expected = joints + step * MAX_JOINT_SPEED / 10 * np.array([1, 0, 0, 0, 0, -1])
        np.testing.assert_allclose(measured, expected, atol=0.02)


def test_a_blocked_arm_is_not_pushed_harder_and_harder(make):
    env = make()
    env.reset(seed=0)
    down = np.array([0, 0.1, 0, 0, 0, 0, 1], np.float32)
    for _ in range(40):
        observation, *_ = env.step(down)
    blocked = observation["agent_pos"][1]
    # The command is at most 0.25 rad ahead, so a few steps back are enough to come free.
    for _ in range(6):
        observation, *_ = env.step(-down)
    assert observation["agent_pos"][1] < blocked - 0.2


@pytest.mark.parametrize("task", TASK_NAMES)
def test_cameras_show_different_pictures(make, task):
    env = make(task, obs_type="pixels")
    pixels = env.reset(seed=0)[0]["pixels"]
    assert tuple(pixels) == CAMERAS
    for picture in pixels.values():
        assert picture.shape == (84, 84, 3)
        assert picture.mean() > 40
        assert picture.std() > 15
    pictures = list(pixels.values())
    for index, left in enumerate(pictures):
        for right in pictures[index + 1 :]:
            assert np.abs(left.astype(int) - right).mean() > 5
    frame = env.render()
    assert frame.dtype == np.uint8
    assert frame.shape == (360, 480, 3)
    assert frame.mean() > 40


def test_the_button_is_seen_wherever_it_stands(make):
    env = make(obs_type="pixels")
    for seed in range(10):
        for name, picture in env.reset(seed=seed)[0]["pixels"].items():
            red = (picture[..., 0] > 150) & (picture[..., 1] < 80) & (picture[..., 2] < 80)
            assert red.sum() >= 6, (seed, name)


@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_objects_are_seen_wherever_they_stand(make, task):
    env = make(task, obs_type="pixels")
    model = env.unwrapped.arm.model
    fixed = [0, model.body("base").id]  # the world and the arm
    objects = [geom for geom in range(model.ngeom) if model.body_rootid[model.geom_bodyid[geom]] not in fixed]
    for seed in range(8):
        seen = env.reset(seed=seed)[0]["pixels"]
        colours = model.geom_rgba[objects]
        model.geom_rgba[objects, 3] = 0.0
        bare = env.unwrapped._observe()["pixels"]
        model.geom_rgba[objects] = colours
        for name, picture in seen.items():
            changed = np.abs(picture.astype(int) - bare[name]).max(axis=-1) > 30
            assert changed.sum() >= 25, (seed, name)


def test_an_oversampled_picture_is_the_mean_of_its_pixels(make):
    station = make(obs_type="pixels").unwrapped
    station.reset(seed=0)
    cameras = Cameras(station.arm.model)
    fine = cameras.picture(station.arm.data, "overview", 64, 64)
    coarse = cameras.picture(station.arm.data, "overview", 32, 32, oversample=2)
    mean = fine.reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(coarse, mean, atol=1)
    cameras.close()
    cameras.close()
    assert not cameras.opened


@pytest.mark.parametrize("wrong", [{"pause_share": 1.0}, {"tremor_rad": -1.0}])
def test_wrong_operator_settings_are_refused(make, wrong):
    with pytest.raises(ConfigError, match="expected 0 to"):
        make().unwrapped.scripted_teleoperator(**wrong)
