"""The station through LeRobot's own factory, preprocessing and command line."""

from dataclasses import dataclass

import draccus
import numpy as np
import pytest

pytest.importorskip("mujoco")

from lerobot.configs import FeatureType
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import close_envs, env_to_policy_features, preprocess_observation

from cqn_train.envs import UR5eStationEnv
from cqn_train.envs.ur5e_station.tasks import TASKS
from lerobot_cqn.errors import ConfigError


@pytest.mark.parametrize("use_async", [False, True])
def test_make_env_serves_what_the_features_declare(use_async):
    config = make_env_config("ur5e_station", obs_type="both", image_size=32, cameras=["upper_wrist"])
    config.episode_length = 3
    envs = make_env(config, n_envs=2, use_async_envs=use_async)
    try:
        env = envs["ur5e_station"][0]
        observation, _ = env.reset(seed=[1, 2], options={"lerobot_new_rollout": True})
        batch = preprocess_observation(observation)
        features = env_to_policy_features(config)
        del features["action"]
        assert {name: tuple(value.shape[1:]) for name, value in batch.items()} == {
            name: tuple(feature.shape) for name, feature in features.items()
        }
        assert list(env.call("_max_episode_steps")) == [3, 3]
        assert list(env.call("task")) == ["click_button"] * 2
        assert list(env.call("task_description")) == [TASKS["click_button"].description] * 2
        env.action_space.seed(0)
        for step in range(3):
            _, reward, terminated, truncated, info = env.step(env.action_space.sample())
            assert reward.sum() == terminated.sum() == 0
            assert truncated.all() == (step == 2)
        assert info["final_info"]["is_success"].tolist() == [False, False]
        assert env.unwrapped.metadata["render_fps"] == 10
        assert all(frame.shape == (360, 480, 3) for frame in env.call("render"))
    finally:
        close_envs(envs)


@pytest.mark.parametrize("task", sorted(TASKS))
def test_every_task_is_made_at_its_own_length(task):
    envs = make_env(UR5eStationEnv(task=task))
    try:
        env = envs["ur5e_station"][0]
        env.reset(seed=[0])
        assert env.call("_max_episode_steps")[0] == TASKS[task].max_episode_steps
    finally:
        close_envs(envs)


def test_success_reaches_the_vector_info():
    envs = make_env(UR5eStationEnv(), n_envs=1)
    try:
        env = envs["ur5e_station"][0]
        env.reset(seed=[0])
        operator = env.envs[0].unwrapped.scripted_teleoperator()
        terminated = np.array([False])
        while not terminated[0]:
            _, reward, terminated, truncated, info = env.step(operator.act()[None])
            assert not truncated[0]
        assert reward[0] == 1.0
        assert info["final_info"]["is_success"].tolist() == [True]
    finally:
        close_envs(envs)


@dataclass
class Command:
    env: EnvConfig


def test_command_line_settings_survive():
    given = '{"agent_pos": {"type": "STATE", "shape": [7]}, "extra": {"type": "ENV", "shape": [2]}}'
    arguments = [
        "--env.type=ur5e_station",
        "--env.obs_type=pixels",
        '--env.cameras=["upper_wrist"]',
        "--env.fps=20",
        f"--env.features={given}",
        '--env.features_map={"extra": "observation.extra"}',
    ]
    config = draccus.parse(Command, args=arguments).env
    assert isinstance(config, UR5eStationEnv)
    assert set(config.features) == {"action", "agent_pos", "extra", "observation.images.upper_wrist"}
    assert config.features["extra"].type is FeatureType.ENV
    assert config.features_map["extra"] == "observation.extra"
    assert config.max_episode_steps == 200
    # A saved configuration reads back as itself.
    assert draccus.decode(Command, draccus.encode(Command(config))).env == config


def test_recorded_evaluations_accept_the_feature_names():
    config = UR5eStationEnv(obs_type="both")
    assert not [name for name in config.features if "/" in name]
    assert set(config.features) == set(config.features_map)


def test_a_feature_that_contradicts_the_environment_is_refused():
    features = UR5eStationEnv(obs_type="pixels").features
    with pytest.raises(ConfigError, match=r"shape \(84, 84, 3\), but the environment gives \(64, 64, 3\)"):
        UR5eStationEnv(obs_type="pixels", image_size=64, features=features)
