"""gym_pusht and gym_aloha behind our interface: declared sizes are delivered, seeds hold, success is the reward."""

import sys

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("gym_pusht")
pytest.importorskip("gym_aloha")

from gym_pusht.envs import PushTEnv

from cqn_train.envs import AlohaSmallEnv, PushtSmallEnv
from cqn_train.envs.aloha import Aloha
from cqn_train.envs.pusht import PushT
from lerobot_cqn.errors import ConfigError, DataError

CONFIGS = [
    PushtSmallEnv(obs_type="state"),
    PushtSmallEnv(),
    PushtSmallEnv(obs_type="both", image_size=40),
    AlohaSmallEnv(obs_type="state"),
    AlohaSmallEnv(image_size=40),
    AlohaSmallEnv(task="insertion", obs_type="both", cameras=["top", "left_wrist"], image_size=40),
]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{c.type}-{c.task}-{c.obs_type}")
def test_observations_fit_spaces_and_config(config):
    env = gym.make(config.gym_id, **config.gym_kwargs)
    try:
        observation, info = env.reset(seed=0, options={"lerobot_new_rollout": True})
        assert env.observation_space.contains(observation)
        assert info == {"is_success": False}
        env.action_space.seed(0)
        observation, reward, terminated, _, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert (reward, terminated, info["is_success"]) == (0.0, False, False)
        flat = {name: value.shape for name, value in observation.items() if name != "pixels"}
        pixels = observation.get("pixels", {})
        if isinstance(pixels, dict):
            flat |= {f"observation.images.{name}": picture.shape for name, picture in pixels.items()}
        else:
            flat["observation.image"] = pixels.shape
        assert {**flat, "action": env.action_space.shape} == {n: tuple(f.shape) for n, f in config.features.items()}
        plain = env.unwrapped
        assert len(plain.state_names) == observation["agent_pos"].shape[0]
        assert len(plain.action_names) == env.action_space.shape[0]
        if "environment_state" in observation:
            assert len(plain.environment_state_names) == observation["environment_state"].shape[0]
        assert env.spec.max_episode_steps == config.max_episode_steps
        assert env.render().ndim == 3
    finally:
        env.close()


@pytest.mark.parametrize("make", [lambda: PushT(obs_type="both"), lambda: Aloha(obs_type="state")])
def test_an_episode_is_a_function_of_its_seed(make):
    def trace(env, seed):
        env.action_space.seed(0)
        states = [env.reset(seed=seed)[0]]
        states += [env.step(env.action_space.sample())[0] for _ in range(3)]
        return np.stack([np.concatenate([np.ravel(v) for v in s.values()]) for s in states])

    one, two = make(), make()
    first = trace(one, 5)
    np.random.seed(0)
    assert np.array_equal(trace(two, 5), first)
    assert np.array_equal(trace(one, 5), first)
    assert not np.array_equal(trace(one, 6), first)
    one.reset(seed=5)
    two.reset(seed=5)
    assert np.array_equal(one.reset()[0]["environment_state"], two.reset()[0]["environment_state"])


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


@pytest.mark.parametrize(("env", "size"), [(PushT(obs_type="state"), 2), (Aloha(obs_type="state"), 14)])
def test_wrong_actions(env, size):
    env.reset(seed=0)
    with pytest.raises(DataError, match=rf"shape \(3,\): expected \({size},\)"):
        env.step(np.zeros(3))
    with pytest.raises(DataError, match="not finite"):
        env.step(np.full(size, np.nan))


@pytest.mark.parametrize(
    ("config", "given", "message"),
    [
        (PushtSmallEnv, {"obs_type": "pixel"}, "Did you mean 'pixels'"),
        (PushtSmallEnv, {"reward": "spars"}, "Did you mean 'sparse'"),
        (PushtSmallEnv, {"image_size": 2000}, "image_size is 2000"),
        (PushtSmallEnv, {"fps": 20}, "fps is 20: expected 10"),
        (PushtSmallEnv, {"task": "PushT-v0"}, "Unknown task"),
        (AlohaSmallEnv, {"task": "transfer"}, "Did you mean 'transfer_cube'"),
        (AlohaSmallEnv, {"cameras": ["wrist"]}, "Unknown camera 'wrist'"),
        (AlohaSmallEnv, {"fps": 20}, "fps is 20: expected 50"),
        (AlohaSmallEnv, {"reward": "shaped"}, "Unknown reward"),
    ],
)
def test_wrong_settings_are_one_line(config, given, message):
    with pytest.raises(ConfigError, match=message) as raised:
        config(**given)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("make", "package", "extra"), [(PushT, "gym_pusht", "pusht"), (Aloha, "gym_aloha", "aloha")])
def test_a_missing_package_names_the_extra(monkeypatch, make, package, extra):
    for name in [package, *(n for n in sys.modules if n.startswith(package + "."))]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=rf"pip install 'lerobot_policy_cqn\[{extra}\]'"):
        make()
