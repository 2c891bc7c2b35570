"""The baselines through cqn-train and LeRobot's commands, runs without demonstrations, several episodes at a time."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env_config
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from cqn_train.agent import Agent
from cqn_train.cli import main
from cqn_train.loop.evaluate import evaluate
from cqn_train.loop.gym_env import GymEnvironment, GymScenes, OneScene

from .conftest import STATION, TINY_RUN, Command

TINY = ["--policy.device=cpu", "--policy.frame_stack=1", "--policy.hidden_dim=16", "--policy.feature_dim=8"]
RUN = [option for option in TINY_RUN if not option.startswith("--policy.")]


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def load(model: Path) -> Agent:
    config = PreTrainedConfig.from_pretrained(str(model), cli_overrides=["--device=cpu"])
    policy = get_policy_class(config.type).from_pretrained(str(model), config=config)
    return Agent(policy, *make_pre_post_processors(config, pretrained_path=str(model)))


@pytest.fixture(scope="module")
def plus(click: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a short run of DrQ-v2+."""
    folder = tmp_path_factory.mktemp("plus") / "run"
    assert main(["--policy.type=drqv2", *TINY, *RUN, *click, "--tensorboard=true", f"--output_dir={folder}"]) == 0
    return folder


def test_metrics_of_a_run(plus: Path) -> None:
    updates = rows(plus / "updates.csv")
    assert all(np.isfinite(float(row[name])) for row in updates for name in ("rl_loss", "actor_loss", "bc_action_loss"))
    assert {row["bc_margin_loss"] for row in updates} == {""}
    evaluation = rows(plus / "evaluations.csv")[-1]
    assert evaluation["phase"] == "final"
    assert float(evaluation["mean_return"]) == float(evaluation["success_rate"])  # reward 1 on success, else 0


def test_tensorboard_has_the_tables(plus: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(plus / "tensorboard"))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    assert {"updates/loss", "episodes/success", "evaluations/success_rate"} <= tags
    table = rows(plus / "updates.csv")
    logged = events.Scalars("updates/loss")
    assert [event.step for event in logged] == [int(row["updates"]) for row in table]
    assert [event.value for event in logged] == pytest.approx([float(row["loss"]) for row in table], rel=1e-4)


def test_resume_continues_exactly(plus: Path, click: list[str], tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert main(["--policy.type=drqv2", *TINY, *RUN, *click, f"--output_dir={run}", "--steps=30"]) == 0
    assert main(["--resume=true", f"--output_dir={run}", "--steps=60"]) == 0
    expected, resumed = (rows(folder / "updates.csv") for folder in (plus, run))
    assert [r["loss"] for r in resumed] == [r["loss"] for r in expected]


def test_drqv2_has_no_recipe_for_demonstrations(click: list[str], tmp_path: Path) -> None:
    run = tmp_path / "run"
    sizes = [option for option in RUN if "demo_batch_size" not in option]
    arguments = ["--policy.type=drqv2", "--policy.preset=drqv2", *TINY, *sizes, *click, "--steps=20"]
    assert main([*arguments, f"--output_dir={run}"]) == 0
    saved = json.loads((run / "checkpoints/last/pretrained_model/config.json").read_text())
    assert saved["distributional"] is False
    assert saved["exploration_noise"] == 0.2
    # Action bounds are the environment's: -1..1 is one radian a second for each joint at 10 Hz.
    commanded = load(run / "checkpoints/last/pretrained_model").postprocessor(torch.ones(1, 7))
    assert commanded[0].tolist() == pytest.approx([0.1] * 6 + [1.0])


def test_the_data_set_the_bounds_otherwise(plus: Path) -> None:
    commanded = load(plus / "checkpoints/last/pretrained_model").postprocessor(torch.ones(1, 7))[0]
    assert (commanded[:6] < 0.0999).any()


@pytest.mark.parametrize("policy", ["cqn", "drqv2"])
def test_without_demonstrations(policy: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    alone = ["--demo_batch_size=0", "--action_bounds=environment", "--offline_updates=0", "--steps=25"]
    given = [option for option in RUN if option.partition("=")[0] not in {a.partition("=")[0] for a in alone}]
    assert main([f"--policy.type={policy}", *TINY, *given, *alone, f"--output_dir={run}"]) == 0
    episodes = rows(run / "episodes.csv")
    assert len(episodes) >= 2
    assert episodes[0]["updates"] == "0"  # nothing to learn from before the first episode has ended
    assert int(rows(run / "evaluations.csv")[-1]["updates"]) > 0


def test_lerobots_commands(click: list[str], command: Command, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train = ["--policy.push_to_hub=false", "--batch_size=4", "--num_workers=0", "--log_freq=1", "--wandb.enable=false"]
    done = command("lerobot-train", "--policy.type=drqv2", *TINY, *train, *click, "--steps=2", f"--output_dir={run}")
    assert "actor_loss" in done.stderr
    evaluate_with = ["--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={tmp_path}", "--policy.device=cpu"]
    command("lerobot-eval", f"--policy.path={run}/checkpoints/last/pretrained_model", *STATION, *evaluate_with)
    assert json.loads((tmp_path / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def station() -> EnvConfig:
    return make_env_config("ur5e_station", obs_type="state", episode_length=12)


@pytest.mark.parametrize("apart", [False, True], ids=["one process", "processes"])
def test_episodes_evaluated_together_are_those_evaluated_one_by_one(plus: Path, apart: bool) -> None:
    agent = load(plus / "checkpoints/last/pretrained_model")
    env = GymEnvironment(station(), agent.policy.config)
    together = GymScenes(station(), agent.policy.config, 3, apart=apart)
    try:
        one = evaluate(agent, OneScene(env), 5, film=2)
        several = evaluate(agent, together, 5, film=2)
    finally:
        env.close()
        together.close()
    assert (one.outcomes, one.steps, one.returns) == (several.outcomes, several.steps, several.returns)
    assert [len(film) for film in one.frames] == [13, 13]
    assert [len(film) for film in several.frames] == [12, 12]  # the last picture belongs to the next episode already
    pairs = zip(one.frames, several.frames, strict=True)
    # Rows of a batch are rounded otherwise than one row, so the arm may be off by less than a pixel.
    assert all(np.abs(a.astype(float) - b).mean() < 1 for x, y in pairs for a, b in zip(x, y, strict=False))


def test_a_run_with_several_evaluation_episodes_at_a_time(plus: Path, click: list[str], tmp_path: Path) -> None:
    run = tmp_path / "run"
    more = ["--eval.batch_size=2", "--eval.final_n_episodes=3"]
    given = [option for option in RUN if "final_n_episodes" not in option]
    assert main(["--policy.type=drqv2", *TINY, *given, *click, *more, f"--output_dir={run}"]) == 0
    assert [row["loss"] for row in rows(run / "updates.csv")] == [row["loss"] for row in rows(plus / "updates.csv")]
    assert rows(run / "evaluations.csv")[-1]["n"] == "3"
