"""Meta-World and the DeepMind Control suite through LeRobot's factory and preprocessing, and through `cqn-data`."""

from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
import pandas as pd
import pytest
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import close_envs, env_to_policy_features, preprocess_observation

from cqn_train.envs import DMCEnv, MetaworldSparseEnv

from .conftest import Command

KINDS = {
    "metaworld_sparse": ("metaworld", {"task": "push", "cameras": ["gripperPOV"]}, "Push the puck to the goal"),
    "dmc": ("dm_control", {"task": "ball_in_cup-catch"}, "ball in cup catch"),
}


@pytest.mark.parametrize("kind", sorted(KINDS))
@pytest.mark.parametrize(("obs_type", "use_async"), [("both", False), ("state", True), ("pixels", False)])
def test_make_env_serves_what_the_features_declare(kind: str, obs_type: str, use_async: bool) -> None:
    module, settings, description = KINDS[kind]
    pytest.importorskip(module)
    config = make_env_config(kind, obs_type=obs_type, image_size=32, episode_length=3, **settings)
    envs = make_env(config, n_envs=2, use_async_envs=use_async)
    try:
        env = envs[kind][0]
        observation, _ = env.reset(seed=[1, 2], options={"lerobot_new_rollout": True})
        features = env_to_policy_features(config)
        assert tuple(features.pop("action").shape) == env.single_action_space.shape
        assert {name: tuple(value.shape[1:]) for name, value in preprocess_observation(observation).items()} == {
            name: tuple(feature.shape) for name, feature in features.items()
        }
        assert list(env.call("_max_episode_steps")) == [3, 3]
        assert list(env.call("task")) == [config.task] * 2
        assert list(env.call("task_description")) == [description] * 2
        env.action_space.seed(0)
        for step in range(3):
            *_, terminated, truncated, info = env.step(env.action_space.sample())
            assert not terminated.any()
            assert truncated.all() == (step == 2)
        assert info["final_info"]["is_success"].tolist() == [False, False]
        assert env.unwrapped.metadata["render_fps"] == config.fps
        assert all(frame.shape == (360, 480, 3) for frame in env.call("render"))
    finally:
        close_envs(envs)


@dataclass
class Given:
    env: EnvConfig


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ["--env.type=metaworld_sparse", "--env.task=door-open", '--env.cameras=["topview"]', "--env.obs_type=both"],
            MetaworldSparseEnv(task="door-open-v3", cameras=["topview"], obs_type="both"),
        ),
        (
            ["--env.type=dmc", "--env.task=walker-walk", "--env.action_repeat=4", "--env.obs_type=pixels"],
            DMCEnv(task="walker-walk", action_repeat=4, obs_type="pixels"),
        ),
    ],
)
def test_command_line_settings_survive(arguments: list[str], expected: EnvConfig) -> None:
    config = draccus.parse(Given, args=arguments).env
    assert config == expected
    # A saved configuration reads back as itself.
    assert draccus.decode(Given, draccus.encode(Given(config))).env == config
    assert not [name for name in config.features if "/" in name]
    assert set(config.features) == set(config.features_map)


def rows(root: Path) -> pd.DataFrame:
    return pd.concat([pd.read_parquet(file) for file in sorted(root.glob("data/**/*.parquet"))])


def test_a_recording_is_filtered_and_labelled_and_keeps_its_actions(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("metaworld")
    whole, filtered, ready = (tmp_path / name for name in ("whole", "filtered", "ready"))
    env = ["--env.type=metaworld_sparse", "--env.task=door-unlock"]
    command("cqn-data", "record", *env, "--repo_id=local/w", f"--root={whole}", "--episodes=4", "--pause_share=0.45")
    # By hand: the hand trails its command on a soft spring, so between still and moving there is no gap to find.
    steps = ["filter", "--threshold=0.002"], ["run", "simulation"]
    for (source, target), step in zip([(whole, filtered), (filtered, ready)], steps, strict=True):
        names = ["--repo_id=local/a", f"--root={source}", "--new_repo_id=local/b", f"--new_root={target}"]
        command("cqn-data", *step, *names)
    before, after = rows(whole), rows(ready)
    paused, still_paused = (
        np.stack(table["complementary_info.is_pause"].to_numpy()).astype(bool).ravel() for table in (before, after)
    )
    assert 0.2 < paused.mean() < 0.7
    assert still_paused.sum() < 0.75 * paused.sum()
    assert (~still_paused).sum() > 0.95 * (~paused).sum()
    # Each displacement stands for itself: what stays is as it was.
    recorded, kept = (np.stack(table["action"].to_numpy()) for table in (before, after))
    nearest = np.abs(kept[:, None] - recorded[None]).max(axis=-1).min(axis=1)
    np.testing.assert_allclose(nearest, 0, atol=1e-6)
    assert after["next.reward"].astype(float).sum() == 4


def test_recording_without_an_operator_is_refused_in_one_line(command: Command, tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    done = command("cqn-data", "record", "--env.type=dmc", "--repo_id=local/d", f"--root={tmp_path / 'd'}", code=2)
    assert "has no scripted teleoperator" in done.stderr
    assert done.stderr.strip().count("\n") == 0


@pytest.mark.parametrize(("preset", "env"), [
    ("paper_dmc_state", ["--env.obs_type=state"]),
    ("paper_dmc_pixels", ["--env.obs_type=pixels", "--env.image_size=32", "--policy.encoder_channels=[4,8]"]),
])  # fmt: skip
def test_shaped_reward_without_demonstrations(preset: str, env: list[str], command: Command, tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    dmc = ["--env.type=dmc", "--env.task=cartpole-balance", "--env.episode_length=12", *env]
    sizes = ["--policy.hidden_dim=16", "--policy.feature_dim=8", "--policy.device=cpu", "--batch_size=8"]
    ends = ["--steps=30", "--eval.freq=0", "--eval.final_n_episodes=2", f"--output_dir={tmp_path / 'run'}"]
    command("cqn-train", "--policy.type=cqn", f"--policy.preset={preset}", *dmc, *sizes, *ends)
    episodes = pd.read_csv(tmp_path / "run" / "episodes.csv")
    assert (episodes["length"] == 12).all()
    assert (episodes["return"] > 5).all()  # at most 1 in each simulator step; the pole begins upright
    final = pd.read_csv(tmp_path / "run" / "evaluations.csv").iloc[-1]
    assert final["success_rate"] == 0
    assert final["mean_return"] > 5
    model = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    evaluate = ["--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path}", "--policy.device=cpu"]
    command("lerobot-eval", f"--policy.path={model}", *dmc[:3], *env[:2], *evaluate)
