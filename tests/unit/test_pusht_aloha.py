"""gym_pusht and gym_aloha behind our interface: their scenes, and success as the reward."""

import numpy as np
import pytest

pytest.importorskip("gym_pusht")
pytest.importorskip("gym_aloha")

from gym_pusht.envs import PushTEnv

from cqn_train.envs.aloha import Aloha
from cqn_train.envs.pusht import PushT


def test_pusht_starts_where_gym_pusht_does():
    ours, theirs = PushT(obs_type="both"), PushTEnv(obs_type="pixels_agent_pos")
    one, other = ours.reset(seed=7)[0], theirs.reset(seed=7)[0]
    assert np.array_equal(one["pixels"], other["pixels"])
    assert one["agent_pos"] == pytest.approx(other["agent_pos"])


def solve_pusht(env):
    """Put the T where it belongs and let the disc stay away."""
    env.reset(seed=0)
    block = env._simulator.block
    block.angle = np.pi / 4  # before the position: it turns about the centre of gravity
    block.position = 256, 256
    env._simulator.agent.position = 50, 50
    return env.step(np.array([50.0, 50.0]))


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_pusht_success(reward):
    env = PushT(obs_type="state", reward=reward)
    env.reset(seed=0)
    _, value, terminated, _, info = env.step(np.array([50.0, 50.0]))
    assert (value > 0) == (reward == "dense")
    assert not terminated
    assert 0 < info["coverage"] < 0.95
    _, value, terminated, _, info = solve_pusht(env)
    assert (value, terminated, info["is_success"]) == (1.0, True, True)


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_aloha_success_is_the_last_stage(monkeypatch, reward):
    env = Aloha(obs_type="state", reward=reward)
    env.reset(seed=0)
    for stage in (2, 4):
        monkeypatch.setattr(env._native_task, "get_reward", lambda _, stage=stage: stage)
        _, value, terminated, _, info = env.step(np.zeros(14))
        assert (terminated, info["is_success"], info["stage"]) == (stage == 4, stage == 4, stage)
        assert value == (stage / 4 if reward == "dense" else float(stage == 4))


def test_aloha_follows_absolute_joint_positions():
    env = Aloha(obs_type="state")
    start = env.reset(seed=0)[0]["agent_pos"]
    wanted = start.copy()
    wanted[0] += 0.1
    wanted[6] = 1.0
    for _ in range(25):
        observation = env.step(wanted)[0]
    assert observation["agent_pos"][0] == pytest.approx(wanted[0], abs=0.03)
    assert observation["agent_pos"][6] > 0.8


def test_aloha_that_diverges_ends_the_episode(monkeypatch):
    env = Aloha(obs_type="state")
    before, _ = env.reset(seed=0)
    monkeypatch.setattr(env._simulator, "step", lambda _: (_ for _ in ()).throw(env._diverged("NaN")))
    observation, reward, terminated, _, info = env.step(np.zeros(14))
    assert (reward, terminated, info["is_success"]) == (0.0, True, False)
    assert np.array_equal(observation["agent_pos"], before["agent_pos"])
