"""Presets, overrides, and a config that survives being saved."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import draccus
import pytest
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature

import cqn_train.envs  # registers the station
import cqn_train.sim_arm  # noqa: F401  # registers the arm
import lerobot_cqn
from cqn_train.arguments import parse
from cqn_train.config import Recipe, RunConfig
from lerobot_cqn import settings as settings_module
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.errors import ConfigError
from lerobot_cqn.settings import PRESETS, CQNSettings

STATE = {"observation.state": PolicyFeature(FeatureType.STATE, (3,))}
ACTION = {"action": PolicyFeature(FeatureType.ACTION, (2,))}


def config(**settings: Any) -> CQNConfig:
    return CQNConfig(device="cpu", **settings)


def test_the_package_offers_its_names_and_no_others() -> None:
    assert all(getattr(lerobot_cqn, name).__name__ == name for name in lerobot_cqn.__all__ if not name.isupper())
    assert lerobot_cqn.CQNConfig is CQNConfig
    with pytest.raises(AttributeError, match="no attribute 'CQNPolicyy'"):
        _ = lerobot_cqn.CQNPolicyy


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_the_defaults_with_their_column_on_top(preset: str) -> None:
    expected = {**asdict(CQNSettings()), **PRESETS[preset]}
    assert asdict(config(preset=preset).settings) == expected


@pytest.mark.parametrize(
    ("preset", "expected"),
    [
        ("paper_rlbench", {"frame_stack": 8, "levels": 3, "bins": 5, "n_step": 3, "v_min": -1, "v_max": 1}),
        ("paper_rlbench", {"atoms": 51, "rl_loss_scale": 0.1, "bc_loss_scale": 1, "lr": 5e-5, "weight_decay": 0.1}),
        ("paper_rlbench", {"tau": 0.02, "exploration_noise": 0.01, "hidden_dim": 512, "feature_dim": 64}),
        ("paper_real_world", {"frame_stack": 4, "levels": 4, "bins": 3, "rl_loss_scale": 0.1, "shift_pixels": 4}),
        ("paper_dmc_state", {"frame_stack": 1, "v_min": 0, "v_max": 200, "exploration_noise": 0.1}),
        ("paper_dmc_pixels", {"frame_stack": 3, "bc_loss_scale": 0, "rl_loss_scale": 1}),
        ("reference_dmc_pixels", {"frame_stack": 3, "lr": 1e-4, "weight_decay": 0, "act_with": "online", "atoms": 51}),
        ("reference_dmc_pixels", {"encoder_kernel": 3, "encoder_norm": "picture", "v_max": 200, "n_step": 3}),
        ("reference_dmc_state", {"distributional": False, "exploration_noise": 0.1, "tau": 0.02, "lr": 1e-4}),
        (
            "reference_rlbench",
            {"n_step": 1, "v_min": -2, "v_max": 2, "bound_margin": 0.2, "action_margin": 0, "frame_stack": 8},
        ),
    ],
)
def test_published_numbers(preset: str, expected: dict[str, float]) -> None:
    found = asdict(config(preset=preset).settings)
    assert {name: found[name] for name in expected} == expected


def test_what_is_given_replaces_the_preset() -> None:
    settings = config(preset="paper_real_world", levels=2, rl_loss_scale=0.0, encoder_channels=[4, 8]).settings
    assert (settings.levels, settings.bins, settings.rl_loss_scale) == (2, 3, 0.0)
    assert settings.encoder_channels == (4, 8)


def test_unknown_presets_suggest_a_known_one() -> None:
    with pytest.raises(ConfigError, match=r"Unknown preset 'paper_rlbnch'.*Did you mean 'paper_rlbench'\?"):
        config(preset="paper_rlbnch")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("levels", 0, "`levels` must be 1 to 16, got 0"),
        ("bins", 1, "`bins` must be at least 2, got 1"),
        ("atoms", 1, "`atoms` must be at least 2"),
        ("n_step", 0, "`n_step` must be 1 to 1000"),
        ("n_step", 1_000_000, "`n_step` must be 1 to 1000"),
        ("frame_stack", 0, "`frame_stack` must be 1 to 32"),
        ("frame_stack", 99, "`frame_stack` must be 1 to 32"),
        ("tau", 0.0, r"`tau` must be in \(0, 1\], got 0"),
        ("discount", 1.1, r"`discount` must be in \(0, 1\], got 1.1"),
        ("discount", float("nan"), "`discount`"),
        ("lr", 0.0, "`lr` must be positive"),
        ("state_bound", 0.5, "`state_bound` must be at least 1"),
        ("v_max", -1.0, "`v_min` must be below `v_max`"),
        ("encoder_channels", (), "`encoder_channels` must be positive"),
        ("encoder_channels", (8, 0), "`encoder_channels` must be positive"),
        ("act_with", "targt", r"Did you mean 'target'\?"),
        ("next_action_from", "both", "online, target"),
        ("bc_margin", -0.1, "`bc_margin` must be at least 0"),
        ("exploration_noise", -1.0, "`exploration_noise` must be at least 0"),
    ],
)
def test_values_out_of_range_are_named(name: str, value: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        config(**{name: value})


def test_something_must_be_learned() -> None:
    with pytest.raises(ConfigError, match="Nothing to learn"):
        config(rl_loss_scale=0, bc_loss_scale=0)


def test_offsets_that_are_loaded() -> None:
    paper = config()  # S = 8, n = 3
    assert paper.observation_delta_indices == list(range(-7, 4))
    assert len(paper.observation_delta_indices) == 11
    assert paper.action_delta_indices == [0]
    assert paper.reward_delta_indices == [0, 1, 2]
    assert config(frame_stack=1, n_step=3).observation_delta_indices == [0, 3]
    assert config(frame_stack=2, n_step=1).observation_delta_indices == [-1, 0, 1]
    assert config(rl_loss_scale=0.0).observation_delta_indices == list(range(-7, 1))


def test_a_saved_config_holds_every_number_and_reads_back(tmp_path: Path) -> None:
    original = config(preset="laptop_pixels", input_features=STATE, output_features=ACTION, levels=2, n_step=2)
    original.save_pretrained(tmp_path)
    written = json.loads((tmp_path / "config.json").read_text())
    assert written["type"] == "cqn"
    for name, value in asdict(original.settings).items():
        assert written[name] == (list(value) if isinstance(value, tuple) else value)
    loaded = PreTrainedConfig.from_pretrained(str(tmp_path))
    assert isinstance(loaded, CQNConfig)
    assert loaded.settings == original.settings
    assert loaded.input_features == original.input_features
    assert loaded.normalization_mapping == original.normalization_mapping
    again = PreTrainedConfig.from_pretrained(str(tmp_path), cli_overrides=["--levels=4"])
    assert isinstance(again, CQNConfig)
    assert (again.settings.levels, again.settings.n_step) == (4, 2)


def test_a_later_change_of_a_preset_leaves_checkpoints_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = config(preset="laptop_state")
    original.save_pretrained(tmp_path)
    monkeypatch.setitem(settings_module.PRESETS, "laptop_state", {"frame_stack": 5, "hidden_dim": 7})
    loaded = PreTrainedConfig.from_pretrained(str(tmp_path))
    assert isinstance(loaded, CQNConfig)
    assert loaded.settings == original.settings


def test_features_are_checked() -> None:
    with pytest.raises(ConfigError, match=r"Nothing to observe.*found \[\]"):
        config(output_features=ACTION).validate_features()
    with pytest.raises(ConfigError, match="Expected one action vector under 'action', found None"):
        config(input_features=STATE).validate_features()
    picture = {"observation.images.top": PolicyFeature(FeatureType.VISUAL, (64, 64, 3))}
    with pytest.raises(ConfigError, match=r"shape \(3, height, width\), found \(64, 64, 3\)"):
        config(input_features=picture, output_features=ACTION).validate_features()
    config(input_features=STATE, output_features=ACTION).validate_features()


def test_lerobots_optimiser_is_the_papers() -> None:
    settings = config()
    optimiser = settings.get_optimizer_preset()
    assert (optimiser.lr, optimiser.weight_decay, optimiser.grad_clip_norm) == (5e-5, 0.1, 0.0)
    assert settings.get_scheduler_preset() is None


def test_the_recipe_follows_the_policys_preset() -> None:
    def recipe(*arguments: str, policy: str = "cqn") -> Recipe:
        start = [f"--policy.type={policy}", "--policy.device=cpu"]
        return draccus.parse(RunConfig, args=[*start, *arguments]).recipe

    assert recipe() == Recipe(
        updates_per_step=1, updates_per_episode=0, batch_size=256, demo_batch_size=256, relabel=True,
        action_bounds="data",
    )  # fmt: skip
    assert recipe("--policy.preset=paper_real_world").updates_per_episode == 50
    assert recipe("--policy.preset=paper_dmc_state").demo_batch_size == 0
    mixed = recipe("--policy.preset=paper_real_world", "--batch_size=8", "--updates_per_step=2", "--relabel=false")
    assert mixed == Recipe(
        updates_per_step=2, updates_per_episode=50, batch_size=8, demo_batch_size=256, relabel=False
    )  # fmt: skip
    for kind in ("state", "pixels"):
        dmc = recipe(f"--policy.preset=reference_dmc_{kind}")
        assert (dmc.update_interval, dmc.random_steps, dmc.batch_size, dmc.demo_batch_size) == (2, 2000, 256, 0)
    # The paper's last table: DrQ-v2+ has the recipes of CQN, DrQ-v2 has not.
    assert recipe(policy="drqv2") == Recipe()
    plain = recipe("--policy.preset=drqv2", policy="drqv2")
    assert plain == Recipe(batch_size=512, demo_batch_size=0, relabel=False, action_bounds="environment")
    humanoid = recipe("--policy.preset=cqn_as_humanoid", policy="cqn_as")
    assert (humanoid.update_interval, humanoid.batch_size, humanoid.random_steps) == (2, 128, 10_000)


def test_runs_are_checked() -> None:
    def validate(*arguments: str) -> None:
        policy = ["--policy.type=cqn", "--policy.device=cpu"]
        rest = ["--env.type=ur5e_station", "--output_dir=x", "--dataset.repo_id=a/b"]
        draccus.parse(RunConfig, args=[*policy, *rest, *arguments]).validate()

    validate()
    for option in ("steps", "offline_updates", "batch_size", "updates_per_step"):
        with pytest.raises(ConfigError, match=rf"`{option}` must be (at least 0|0 to \d+), got -1"):
            validate(f"--{option}=-1")
    for option, most, values in (("seed", 20_000, (-1, 20_001, 10**20)), ("threads", 256, (-1, 257, 100_000))):
        for value in values:
            with pytest.raises(ConfigError, match=f"`{option}` must be 0 to {most}, got {value}"):
                validate(f"--{option}={value}")
    with pytest.raises(ConfigError, match="A batch of nothing"):
        validate("--batch_size=0", "--demo_batch_size=0")
    for episodes in ("[0,0]", "[-1]", "[3,1,3]"):
        with pytest.raises(ConfigError, match=r"`dataset\.episodes` must be different numbers from 0 on"):
            validate(f"--dataset.episodes={episodes}")
    for option in ("save_freq", "log_freq"):
        with pytest.raises(ConfigError, match=f"`{option}` must be at least 1, got 0"):
            validate(f"--{option}=0")


ARM = ["--robot.type=sim_ur5e", "--output_dir=x", "--dataset.repo_id=a/b"]


def arm_run(*arguments: str) -> RunConfig:
    return parse(["--policy.type=cqn", "--policy.device=cpu", *ARM, *arguments])


def test_runs_on_an_arm_have_defaults_of_their_own() -> None:
    run = arm_run("--teleop.type=sim_leader")
    run.validate()
    assert (run.recipe.updates_per_step, run.recipe.updates_per_episode) == (0, 50)  # the paper's on a real arm
    assert (run.eval_freq, run.final_episodes) == (0, 0)
    asked = arm_run("--updates_per_episode=7", "--eval.freq=100", "--eval.final_n_episodes=5", "--async_updates=9")
    asked.validate()
    assert (asked.recipe.updates_per_episode, asked.eval_freq, asked.final_episodes) == (7, 100, 5)
    assert arm_run("--policy.preset=laptop_pixels").recipe.updates_per_episode == 25


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--env.type=ur5e_station"], "got both"),
        (["--updates_per_step=1"], "would make the arm jerk"),
        (["--eval.batch_size=2"], "There is one arm"),
        (["--eval.use_async_envs=true"], "There is one arm"),
        (["--online_minutes=0"], "`online_minutes` must be positive, got 0"),
        (["--async_updates=-1"], "`async_updates` must be at least 0, got -1"),
        (["--eval.freq=-1"], r"`eval\.freq` must be at least 0, got -1"),
        (["--page.port=65536"], r"`page\.port` must be 0 to 65535"),
        (["--page.absent_s=0.5"], r"`page\.absent_s` must be 1 to 3600 seconds, got 0\.5"),
        (["--arm.fps=0"], r"`arm\.fps` must be 1 to 200, got 0"),
        (["--arm.episode_s=0"], r"`arm\.episode_s` must be 0\.1 to 3600"),
        (["--arm.joint_margin=-0.1"], r"`arm\.joint_margin` must be 0 to 1"),
        (["--arm.step_factor=0"], r"`arm\.step_factor` must be 0\.1 to 100"),
        (["--arm.home_speed=0"], r"`arm\.home_speed` must be 0\.001 to 1"),
        (["--arm.home_speed=1.5"], r"`arm\.home_speed` must be"),
        (["--arm.fps=1000"], r"`arm\.fps` must be 1 to 200, got 1000"),
        (["--arm.stale_s=0"], r"`arm\.stale_s` must be"),
        (["--arm.watchdog_s=60"], r"`arm\.watchdog_s` must be 0\.05 to 10"),
        (["--arm.watchdog_s=nan"], r"`arm\.watchdog_s` must be"),
        (['--arm.joint_limits={"elbow.pos": [3, 1]}'], r"`arm\.joint_limits` of 'elbow\.pos' must be \[low, high\]"),
        (['--arm.joint_limits={"elbow.pos": [3]}'], "must be \\[low, high\\]"),
        (["--arm.workspace=[0,1,0,1,0]"], r"`arm\.workspace` must be \[x_low"),
        (["--arm.workspace=[0,1,0,1,1,0]"], r"`arm\.workspace` must be \[x_low"),
        (["--arm.on_exit=relase"], r"Unknown arm\.on_exit 'relase'.*Did you mean 'release'"),
    ],
)
def test_what_an_arm_cannot_be_told(arguments: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        arm_run(*arguments).validate()


def test_a_leader_needs_an_arm() -> None:
    config = ["--policy.type=cqn", "--policy.device=cpu", "--env.type=ur5e_station", "--teleop.type=sim_leader"]
    with pytest.raises(ConfigError, match=r"leader of an arm: give --robot\.type"):
        parse([*config, "--output_dir=x", "--dataset.repo_id=a/b"]).validate()


def test_help_names_every_preset() -> None:
    from cqn_train.arguments import introduction
    from lerobot_cqn.settings import CQN_AS_PRESETS, DRQV2_PRESETS

    lines = introduction().splitlines()
    for policy, presets in (("cqn", PRESETS), ("cqn_as", CQN_AS_PRESETS), ("drqv2", DRQV2_PRESETS)):
        shown = [line.split()[1] for line in lines if line.strip().startswith(f"--policy.type={policy} ")]
        assert sorted(shown) == sorted(presets)
