"""The DeepMind Control suite behind our interface."""

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("dm_control")

from cqn_train.envs.dmc_config import TASKS, DMCEnv


@pytest.fixture
def make():
    opened = []

    def _make(task="cartpole-swingup", **kwargs):
        env = gym.make(DMCEnv(task=task).gym_id, **kwargs)
        opened.append(env)
        return env

    yield _make
    for env in opened:
        env.close()


def test_the_table_of_tasks_is_the_suites():
    from dm_control import suite

    names = {f"{domain}-{task}" for domain, task in suite.ALL_TASKS}
    assert names - set(TASKS) == {"lqr-lqr_2_1", "lqr-lqr_6_2"}  # unbounded actions, and no end
    assert set(TASKS) <= names


@pytest.mark.parametrize("task", sorted(TASKS))
def test_the_table_of_sizes_is_the_suites(task):
    from dm_control import suite

    env = suite.load(*task.split("-", 1))
    state = sum(int(np.prod(spec.shape)) for spec in env.observation_spec().values())
    step_ms = round(1000 * env.control_timestep(), 6)
    assert TASKS[task] == (state, env.action_spec().shape[0], step_ms)
    assert env._step_limit == 1000


def test_names_fit_the_vectors(make):
    plain = make("walker-walk").unwrapped
    assert len(plain.state_names) == 24
    assert plain.state_names[-1] == "velocity_8"
    assert plain.action_names[0] == "right_hip"
    assert plain.task_description == "walker walk"


def test_repeated_steps_add_their_rewards(make):
    once, thrice = make("walker-stand"), make("walker-stand", action_repeat=3)
    once.reset(seed=0)
    thrice.reset(seed=0)
    action = np.linspace(-1, 1, 6).astype(np.float32)
    moments = [once.step(action) for _ in range(3)]
    observation, reward, *_ = thrice.step(action)
    assert reward == pytest.approx(sum(moment[1] for moment in moments))
    np.testing.assert_array_equal(observation["agent_pos"], moments[-1][0]["agent_pos"])


def test_actions_are_stretched_to_the_tasks_bounds(make):
    env = make("quadruped-walk")
    suite = env.unwrapped.suite
    spec = suite.action_spec()
    assert spec.maximum.max() > 1.0
    env.reset(seed=0)
    for sign, bound in ((5.0, spec.maximum), (-1.0, spec.minimum)):
        env.step(np.full(12, sign, np.float32))
        np.testing.assert_allclose(suite.physics.control(), bound, atol=1e-6)


@pytest.mark.parametrize(("repeat", "steps"), [(1, 1000), (2, 500), (3, 334)])
def test_time_truncates(make, repeat, steps):
    env = make("cartpole-swingup", action_repeat=repeat)  # the suite's own limit, below that of gymnasium
    env.reset(seed=0)
    still = np.zeros(1, np.float32)
    ends = [env.step(still)[2:4] for _ in range(steps)]
    assert ends[-1] == (False, True)
    assert not any(any(end) for end in ends[:-1])
    with pytest.raises(gym.error.ResetNeeded):
        env.step(still)


def test_a_discount_of_zero_terminates(make, monkeypatch):
    env = make()
    env.reset(seed=0)
    monkeypatch.setattr(env.unwrapped.suite.task, "get_termination", lambda _: 0.0)
    assert env.step(np.zeros(1, np.float32))[2:4] == (True, False)


@pytest.mark.parametrize("task", ["cartpole-swingup", "quadruped-walk", "dog-fetch"])
def test_the_camera_sees_what_moves(make, task):
    env = make(task, obs_type="pixels")
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert set(observation) == {"pixels"}
    before = observation["pixels"]["camera0"]
    env.action_space.seed(0)
    for _ in range(10):
        after = env.step(env.action_space.sample())[0]["pixels"]["camera0"]
    assert before.std() > 10
    assert (np.abs(after.astype(int) - before).max(axis=-1) > 30).sum() > 3
    frame = env.render()
    assert frame.dtype == np.uint8
    assert frame.shape == (360, 480, 3)


def test_repeat_length_and_rate_follow_from_one_another():
    state, pixels = DMCEnv(task="walker-walk"), DMCEnv(task="walker-walk", obs_type="pixels")
    assert (state.fps, state.max_episode_steps, state.repeat) == (40, 1000, 1)
    assert (pixels.fps, pixels.max_episode_steps, pixels.repeat) == (20, 500, 2)
    assert DMCEnv(action_repeat=4).max_episode_steps == 250
    assert DMCEnv(episode_length=7).max_episode_steps == 7
    assert [tuple(feature.shape) for feature in state.features.values()] == [(6,), (24,)]
    assert [tuple(feature.shape) for feature in pixels.features.values()] == [(6,), (84, 84, 3)]
