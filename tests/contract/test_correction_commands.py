"""A policy of LeRobot's own, corrected by practice: every command on the way."""

import json
from pathlib import Path

import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from cqn_train.cli import main
from cqn_train.push.cli import main as push

from .conftest import STATION, TINY_RUN, Command
from .test_cqn_as import rows

ACT = ["--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.chunk_size=4",
       "--policy.n_action_steps=2", "--policy.dim_model=16", "--policy.n_heads=2", "--policy.dim_feedforward=16",
       "--policy.n_encoder_layers=1", "--policy.use_vae=false"]  # fmt: skip
TRAIN = ["--batch_size=4", "--num_workers=0", "--wandb.enable=false"]


@pytest.fixture(scope="module")
def base(click: list[str], command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an ACT that lerobot-train made in two steps."""
    run = tmp_path_factory.mktemp("act") / "run"
    command("lerobot-train", *ACT, *TRAIN, *click, "--steps=2", f"--output_dir={run}")
    return run / "checkpoints/last/pretrained_model"


def test_practice_resume_and_evaluation(
    base: Path, click: list[str], command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    straight, run = tmp_path / "straight", tmp_path / "run"
    correct = [*TINY_RUN, *click, f"--policy.base_path={base}"]
    assert main([*correct, f"--output_dir={straight}"]) == 0
    assert main([*correct, f"--output_dir={run}", "--steps=30"]) == 0
    assert main(["--resume=true", f"--output_dir={run}", "--steps=60"]) == 0
    # Not to the last digit: a transformer on the processor rounds otherwise from call to call.
    expected, resumed = ([float(r["loss"]) for r in rows(folder / "updates.csv")] for folder in (straight, run))
    assert resumed == pytest.approx(expected, rel=1e-3)
    model = run / "checkpoints/last/pretrained_model"
    assert push([f"--run={run}", "--repo_id=me/x", "--dry_run=true"]) == 2  # nobody else has the base
    assert "push the base policy first" in capsys.readouterr().err
    evaluate_with = ["--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={tmp_path}", "--policy.device=cpu"]
    command("lerobot-eval", f"--policy.path={model}", *STATION, *evaluate_with)
    assert json.loads((tmp_path / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def test_before_the_first_update_episodes_are_the_bases(base: Path, click: list[str], tmp_path: Path) -> None:
    run = tmp_path / "run"
    given = [o for o in TINY_RUN if not o.startswith(("--offline_updates", "--steps", "--eval.final"))]
    none = ["--offline_updates=0", "--steps=0", "--eval.final_n_episodes=2"]
    assert main([*given, *none, *click, f"--policy.base_path={base}", f"--output_dir={run}"]) == 0
    outcomes = []
    for model in (run / "checkpoints/last/pretrained_model", base):
        config = PreTrainedConfig.from_pretrained(str(model), cli_overrides=["--device=cpu"])
        policy = get_policy_class(config.type).from_pretrained(str(model), config=config).eval()
        pre, post = make_pre_post_processors(config, pretrained_path=str(model))
        policy.reset()
        with torch.inference_mode():
            frame = {"observation.state": torch.zeros(1, 7), "observation.environment_state": torch.zeros(1, 3)}
            outcomes.append(torch.stack([post(policy.select_action(pre(dict(frame)))) for _ in range(5)]))
    assert torch.equal(*outcomes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--policy.base_path=/nowhere"], "No policy to correct at --policy.base_path=/nowhere"),
        (["--action_bounds=environment"], "Corrections are shares of the demonstrated range"),
        (["--policy.bins=4"], "`bins` must be odd"),
        (["--policy.push_to_hub=true", "--policy.repo_id=me/x"], "push the base policy first"),
    ],
)
def test_what_cannot_be_is_said_before_work_starts(
    options: list[str], message: str, base: Path, click: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [*TINY_RUN, *click, f"--policy.base_path={base}", *options, f"--output_dir={tmp_path / 'run'}"]
    assert main(given) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_an_arm_is_not_corrected_yet(base: Path, click: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    run = [
        "--policy.type=cqn",
        "--policy.device=cpu",
        "--robot.type=sim_ur5e",
        "--robot.id=x",
        "--output_dir=/tmp/none",
    ]
    assert main([*run, *click, f"--policy.base_path={base}"]) == 2
    assert "On an arm no other policy can be corrected yet" in capsys.readouterr().err
