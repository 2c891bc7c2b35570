"""CQN-AS through cqn-train and LeRobot's commands."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cqn_train.cli import main

from .conftest import STATION, TINY_RUN, Command

TINY = ["--policy.type=cqn_as", "--policy.preset=laptop_state", "--policy.device=cpu", "--policy.hidden_dim=16",
        "--policy.feature_dim=8", "--policy.action_sequence=3"]  # fmt: skip
RUN = [option for option in TINY_RUN if not option.startswith("--policy.")]


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    "options",
    [[], ["--policy.temporal_ensemble=false", "--policy.target_interval=7", "--policy.sequence_fill=last"]],
    ids=["ensemble", "open loop"],
)
def test_resume_continues_exactly(options: list[str], click: list[str], tmp_path: Path) -> None:
    straight, run = tmp_path / "straight", tmp_path / "run"
    assert main([*TINY, *options, *RUN, *click, f"--output_dir={straight}"]) == 0
    assert main([*TINY, *options, *RUN, *click, f"--output_dir={run}", "--steps=30"]) == 0
    assert main(["--resume=true", f"--output_dir={run}", "--steps=60"]) == 0
    expected, resumed = (rows(folder / "updates.csv") for folder in (straight, run))
    assert [row["loss"] for row in resumed] == [row["loss"] for row in expected]
    assert all(np.isfinite(float(row[name])) for row in resumed for name in ("rl_loss", "bc_dominance_loss"))


def test_uniform_steps_and_updates_after_every_other(tmp_path: Path) -> None:
    """The schedule of HumanoidBench in small; what a kill interrupts is owed as if it had not been."""
    run = tmp_path / "run"
    given = [option for option in RUN if option.partition("=")[0] not in ("--offline_updates", "--demo_batch_size")]
    schedule = ["--policy.type=cqn_as", "--policy.preset=cqn_as_humanoid", "--policy.device=cpu",
                "--policy.hidden_dim=16", "--random_steps=25", "--steps=60", "--save_freq=1000"]  # fmt: skip
    assert main([*schedule, *[o for o in given if not o.startswith(("--steps", "--save_freq"))],
                 f"--output_dir={run}"]) == 0  # fmt: skip
    episodes = rows(run / "episodes.csv")
    updates = {int(row["env_steps"]): int(row["updates"]) for row in episodes}
    assert all(made == max(0, steps // 2 - 12) for steps, made in updates.items())
    assert updates[60] == 18
    # Continued from the checkpoint before the first step, as after a kill.
    last = run / "checkpoints" / "last"
    newest = last.resolve()
    last.unlink()
    last.symlink_to("000000")
    shutil.rmtree(newest)
    assert main(["--resume=true", f"--output_dir={run}", "--steps=60"]) == 0
    assert [row["updates"] for row in rows(run / "evaluations.csv") if row["phase"] == "final"][-1] == "18"


def test_lerobots_commands(click: list[str], command: Command, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train = ["--policy.push_to_hub=false", "--batch_size=4", "--num_workers=0", "--log_freq=1", "--wandb.enable=false"]
    done = command("lerobot-train", *TINY, *train, *click, "--steps=2", f"--output_dir={run}")
    assert "bc_dominance_loss" in done.stderr
    saved = json.loads((run / "checkpoints/last/pretrained_model/config.json").read_text())
    assert (saved["action_sequence"], saved["sequence_fill"], saved["temporal_ensemble"]) == (3, "mask", True)
    evaluate_with = ["--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={tmp_path}", "--policy.device=cpu"]
    command("lerobot-eval", f"--policy.path={run}/checkpoints/last/pretrained_model", *STATION, *evaluate_with)
    assert json.loads((tmp_path / "eval_info.json").read_text())["overall"]["n_episodes"] == 2
