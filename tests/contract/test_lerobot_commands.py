"""LeRobot's own commands on the policy: training with and without rewards, exact resume, evaluation."""

import contextlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from safetensors.torch import load_file
from torch import Tensor

from cqn_train.agent import Agent
from cqn_train.arguments import parse
from cqn_train.build import build
from cqn_train.run.progress import ConsoleMonitor
from cqn_train.run.stop import StopRequest
from lerobot_cqn.discretisation import snap

from .conftest import STATION, TINY_POLICY, TINY_RUN, Command

TRAIN = [
    *TINY_POLICY, "--policy.push_to_hub=false", "--batch_size=4", "--num_workers=0", "--log_freq=1",
    "--wandb.enable=false",
]  # fmt: skip


@pytest.fixture(scope="module")
def trained(click: list[str], command: Command, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder and log of six steps of lerobot-train on demonstrations without rewards, saved every three."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    done = command("lerobot-train", *TRAIN, *click, "--steps=6", "--save_freq=3", f"--output_dir={folder}")
    return folder, done.stderr


def weights(folder: Path) -> dict[str, Tensor]:
    return load_file(folder / "pretrained_model" / "model.safetensors")


def logged(text: str, name: str) -> list[float]:
    """Values of a metric in the log of lerobot-train."""
    return [float(part.split(":")[1]) for part in text.split() if part.startswith(f"{name}:")]


def test_without_rewards_the_last_step_is_the_success_and_it_says_so(trained: tuple[Path, str]) -> None:
    _, log = trained
    notice = [line for line in log.splitlines() if "last step of each episode counts as the success" in line]
    assert len(notice) == 1
    assert "next.reward" in notice[0]
    losses = logged(log, "rl_loss")
    assert len(losses) == 6
    assert losses[0] == pytest.approx(np.log(51), abs=2e-3)  # a new critic is uniform over 51 atoms
    assert all(np.isfinite(logged(log, "loss")))


def test_target_critic_moves_and_is_saved(trained: tuple[Path, str]) -> None:
    early, late = (weights(trained[0] / "checkpoints" / step) for step in ("000003", "000006"))
    moved = [key for key in late if key.startswith("model.target_critic.") and not torch.equal(early[key], late[key])]
    assert moved
    online = "model.critic.advantage.head.weight"
    assert not torch.equal(late[online], late[online.replace("critic", "target_critic")])


def test_resume_is_exact(trained: tuple[Path, str], command: Command, tmp_path: Path) -> None:
    folder = trained[0] / "checkpoints"
    complete = tmp_path / "complete"
    shutil.copytree(folder / "000006", complete)
    shutil.rmtree(folder / "000006")
    (folder / "last").unlink()
    (folder / "last").symlink_to("000003")  # as if it had died after step 5
    config = folder / "last" / "pretrained_model" / "train_config.json"
    done = command("lerobot-train", f"--config_path={config}", "--resume=true")
    assert len(logged(done.stderr, "rl_loss")) == 3
    assert json.loads((folder / "last" / "training_state" / "training_step.json").read_text())["step"] == 6
    expected, resumed = weights(complete), weights(folder / "last")
    assert expected.keys() == resumed.keys()
    assert [key for key in expected if not torch.equal(expected[key], resumed[key])] == []


def test_reward_columns_are_read(rewarded: list[str], command: Command, tmp_path: Path) -> None:
    done = command("lerobot-train", *TRAIN, *rewarded, "--steps=2", f"--output_dir={tmp_path / 'run'}")
    assert "counts as the success" not in done.stderr
    assert len(logged(done.stderr, "rl_loss")) == 2


def test_camera_with_history(filmed: list[str], command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    camera = ["--policy.frame_stack=2", "--policy.encoder_channels=[4,8]", "--policy.shift_pixels=2"]
    done = command("lerobot-train", *TRAIN, *camera, *filmed, "--steps=2", f"--output_dir={folder}")
    assert len(logged(done.stderr, "rl_loss")) == 2
    model = folder / "checkpoints" / "last" / "pretrained_model"
    convolution = weights(model.parent)["model.encoders.0.convolutions.0.weight"]
    assert convolution.shape == (4, 3 * 2, 4, 4)
    # Pixels reach the network as they are: LeRobot's ImageNet statistics must not touch them.
    config = PreTrainedConfig.from_pretrained(str(model), cli_overrides=["--device=cpu"])
    preprocessor, _ = make_pre_post_processors(config, pretrained_path=str(model))
    pixels = torch.rand(3, 24, 24)
    assert torch.equal(
        preprocessor({"observation.images.wrist": pixels, "observation.state": torch.zeros(3)})[
            "observation.images.wrist"
        ][0],
        pixels,
    )


def test_imitation_only(rewarded: list[str], command: Command, tmp_path: Path) -> None:
    flags = ["--policy.rl_loss_scale=0", "--steps=2", f"--output_dir={tmp_path / 'run'}"]
    done = command("lerobot-train", *TRAIN, *rewarded, *flags)
    assert logged(done.stderr, "rl_loss") == []
    assert len(logged(done.stderr, "bc_dominance_loss")) == 2
    settings = json.loads((tmp_path / "run/checkpoints/last/pretrained_model/config.json").read_text())
    assert settings["rl_loss_scale"] == 0


@pytest.mark.parametrize("source", ["trained", "straight"])
def test_lerobot_eval_runs(source: str, request: pytest.FixtureRequest, command: Command, tmp_path: Path) -> None:
    made = request.getfixturevalue(source)
    folder = made if isinstance(made, Path) else made[0]
    model = folder / "checkpoints" / "last" / "pretrained_model"
    evaluate = ["--eval.n_episodes=2", "--eval.batch_size=1", f"--output_dir={tmp_path}", "--policy.device=cpu"]
    command("lerobot-eval", f"--policy.path={model}", *STATION, *evaluate)
    result = json.loads((tmp_path / "eval_info.json").read_text())
    assert result["overall"]["n_episodes"] == 2


def load_as_lerobot_eval(model: Path, env: EnvConfig) -> Agent:
    config = PreTrainedConfig.from_pretrained(str(model))
    config.pretrained_path = model
    policy: PreTrainedPolicy = make_policy(config, env_cfg=env)
    policy.eval()
    overrides = {"device_processor": {"device": "cpu"}, "rename_observations_processor": {"rename_map": {}}}
    pre, post = make_pre_post_processors(config, pretrained_path=str(model), preprocessor_overrides=overrides)
    return Agent(policy, pre, post)


@pytest.mark.parametrize("act_with", ["target", "online"])
def test_a_loaded_policy_acts_as_the_trained_one(act_with: str, click: list[str], tmp_path: Path) -> None:
    """Through LeRobot's factory, with the pipelines, over a history: the same commands to the robot, exactly."""
    flags = ["--policy.frame_stack=2", f"--policy.act_with={act_with}", "--policy.tau=0.3", "--policy.lr=0.01"]
    with ConsoleMonitor() as monitor, StopRequest() as stop, contextlib.ExitStack() as stack:
        config = parse([*TINY_RUN, *click, *flags, f"--output_dir={tmp_path / 'run'}"])
        trainer = build(config.validate(), monitor, stop, stack)
        for _ in range(20):
            trainer.updates(1)
        trainer.save()
    loaded = load_as_lerobot_eval(
        tmp_path / "run/checkpoints/last/pretrained_model", make_env_config("ur5e_station", obs_type="state")
    )
    trained = trainer.agent
    model = trained.policy.model
    assert not torch.equal(model.critic.advantage.head.weight, model.target_critic.advantage.head.weight)
    generator = torch.Generator().manual_seed(0)
    frames = [
        {name: torch.randn(1, feature.shape[0], generator=generator) for name, feature in features.items()}
        for features in [trained.policy.config.low_dim_features] * 12
    ]
    commands = []
    for agent in (trained, loaded, loaded):  # twice: deterministic, and reset forgets the history
        agent.policy.reset()
        actions = [agent.act(agent.prepare(frame), explore=False)[0] for frame in frames]
        assert all(torch.equal(snap(action, 3, 5), action) for action in actions)
        commands.append(torch.cat([agent.postprocessor(action) for action in actions]))
    assert torch.equal(commands[0], commands[1])
    assert torch.equal(commands[1], commands[2])
    assert len(commands[0].unique(dim=0)) > 1
    # The critic that `act_with` names is the one that acts.
    model.critic, model.target_critic = model.target_critic, model.critic
    trained.policy.reset()
    swapped = torch.cat([trained.postprocessor(trained.act(trained.prepare(f), explore=False)[0]) for f in frames])
    assert not torch.equal(swapped, commands[0])
