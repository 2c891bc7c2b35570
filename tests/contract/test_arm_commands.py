"""From a person's demonstrations to an arm that a policy drives, with LeRobot's own commands at both ends."""

import contextlib
import csv
import json
import socket
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cqn_train.cli import main
from cqn_train.replay.files import Journal

from .conftest import ARM_CAMERA, TINY_POLICY, Command
from .zygote import Zygote, wait_until

pytest.importorskip("mujoco")
BLIND = ["--robot.camera_names=[]"]
STATE_ONLY = ['--policy.input_features={"observation.state": {"type": "STATE", "shape": [10]}}']
SMALL_EYES = ["--policy.encoder_channels=[4,8]", "--policy.shift_pixels=2"]
JOINTS = slice(0, 6)


@pytest.mark.real_time(reason="lerobot-rollout drives the simulated arm for three seconds of the machine's own clock")
@pytest.mark.parametrize(
    ("trained", "robot"),
    [(STATE_ONLY, BLIND), ([*STATE_ONLY, "--policy.type=cqn_as"], BLIND), (SMALL_EYES, ARM_CAMERA)],
    ids=["state", "sequences", "camera"],
)
def test_rollout_sends_absolute_goals(
    trained: list[str], robot: list[str], cleaned_arm: Path, command: Command, tmp_path: Path
) -> None:
    kind = [option for option in trained if option.startswith("--policy.type=")]
    command(
        "lerobot-train", *TINY_POLICY[len(kind) :], *trained, "--policy.push_to_hub=false",
        "--dataset.repo_id=local/cqn",
        f"--dataset.root={cleaned_arm}", "--batch_size=4", "--num_workers=0", "--steps=24", "--wandb.enable=false",
        f"--output_dir={tmp_path / 'run'}",
    )  # fmt: skip
    command(
        "lerobot-rollout", f"--policy.path={tmp_path / 'run/checkpoints/last/pretrained_model'}",
        "--robot.type=sim_ur5e", "--robot.id=sim", "--robot.state=true", *robot, "--duration=3", "--fps=15",
        "--return_to_initial_position=false", "--play_sounds=false", "--strategy.type=sentry",
        "--dataset.repo_id=local/rollout_arm", f"--dataset.root={tmp_path / 'seen'}", "--dataset.fps=15",
        "--dataset.push_to_hub=false", "--dataset.single_task=Press the red button.",
    )  # fmt: skip
    # What the sentry keeps as the action is what the robot was sent.
    rows = pd.concat([pd.read_parquet(file) for file in sorted((tmp_path / "seen").glob("data/**/*.parquet"))])
    measured, goals = (np.stack(rows[name].to_numpy()).astype(float) for name in ("observation.state", "action"))
    assert len(goals) >= 10  # of 45, however busy the machine is
    stats = json.loads((cleaned_arm / "meta/stats.json").read_text())["action"]
    low, high = (np.array(stats[name]) for name in ("min", "max"))
    away = goals[:, JOINTS] - measured[:, JOINTS]
    assert (away >= low[JOINTS] - 0.01).all()  # degrees
    assert (away <= high[JOINTS] + 0.01).all()
    assert ((goals[:, 6] >= -0.01) & (goals[:, 6] <= 100.01)).all()
    # Differences taken for angles would lie near zero, where several joints never are.
    far = np.abs(measured[:, JOINTS]).min(axis=0) > 2 * np.abs([low, high]).max(axis=0)[JOINTS]
    assert far.sum() >= 3
    assert (np.abs(goals[:, JOINTS][:, far]) > np.abs([low, high]).max(axis=0)[JOINTS][far]).all()
    assert np.ptp(measured[:, JOINTS], axis=0).max() > 0.5  # it moved


def rows(run: Path, table: str) -> list[dict[str, str]]:
    path = run / f"{table}.csv"
    return list(csv.DictReader(path.open())) if path.exists() else []


@pytest.mark.real_time(reason="the arm and the person of another process live by the machine's own clock")
def test_online_with_a_person_killed_and_resumed(
    cleaned_arm: Path, command: Command, processes: Zygote, free_port: int, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A simulated person at the page starts, takes over and labels; a kill loses no finished episode."""
    monkeypatch.setenv("CQN_PAGE_TOKEN", "a-token-of-the-test")
    run, log = tmp_path / "run", tmp_path / "log.txt"
    arguments = [
        *TINY_POLICY, *SMALL_EYES, *ARM_CAMERA, "--robot.type=sim_ur5e", "--robot.state=true", "--robot.speed=4",
        f"--robot.person=http://127.0.0.1:{free_port}", "--robot.person_takes_over_s=2", "--teleop.type=sim_leader",
        "--dataset.repo_id=local/cqn", f"--dataset.root={cleaned_arm}", f"--page.port={free_port}", "--operator_page",
        "--offline_updates=2", "--updates_per_episode=2", "--batch_size=4", "--demo_batch_size=4", "--steps=100000",
        "--arm.episode_s=2.5", "--save_freq=40", "--log_freq=1", "--threads=1", f"--output_dir={run}",
    ]  # fmt: skip
    process = processes.start("cqn-train", *arguments, err=str(log))
    with contextlib.suppress(AssertionError):  # said below, with the reason
        wait_until(lambda: len(rows(run, "episodes")) >= 3)
    processes.kill(process)
    before = rows(run, "episodes")
    assert len(before) >= 3, log.read_text()[-2000:]
    assert any(int(row["taught"]) > 0 and row["success"] == "1" for row in before)
    places = [place for _, place in Journal(run / "replay/episodes.jsonl").entries() if place is not None]
    assert [place.length for place in places][: len(before)] == [int(row["length"]) for row in before]
    done = command(
        "cqn-train", "--resume=true", f"--output_dir={run}", f"--steps={int(before[-1]['env_steps']) + 30}",
        "--eval.final_n_episodes=1",
    )  # fmt: skip
    assert f"Operator's page: http://127.0.0.1:{free_port}/ (with its token in {run}/page/address" in done.stdout
    address = run / "page" / "address"  # which may be read by nobody else, unlike a log
    assert address.stat().st_mode & 0o777 == 0o600
    assert address.read_text() == f"http://127.0.0.1:{free_port}/?token=a-token-of-the-test\n"
    assert "Hz of 40" in done.stdout
    after = rows(run, "episodes")
    assert [int(row["episode"]) for row in after] == list(range(len(after)))
    assert len(after) > len(before)
    assert rows(run, "evaluations")[-1]["phase"] == "final"
    saved = (run / "checkpoints/last/pretrained_model/train_config.json").read_text()
    assert "a-token-of-the-test" not in saved + done.stdout + done.stderr + log.read_text()


@pytest.mark.parametrize(("options", "said"), [
    (["--robot.type=sim_ur5e", "--env.type=ur5e_station"], "got both"),
    (["--robot.type=sim_ur5e", "--updates_per_step=1"], "would make the arm jerk"),
    (["--robot.type=sim_ur5"], "sim_ur5e"),
    (["--robot.type=sim_ur5e", "--robot.state=true", "--robot.camera_names=[left_shoulder]"], "Unknown camera of"),
    (["--robot.type=sim_ur5e", "--robot.camera_names=[upper_wrist]"], "state has 10 values, the robot's 7"),
    (["--robot.type=sim_ur5e", *ARM_CAMERA, "--robot.state=true", "--arm.joint_limits={elbo.pos: [0, 1]}"],
     "elbow.pos"),
    (["--robot.type=sim_ur5e", *ARM_CAMERA, "--robot.state=true", "--arm.workspace=[1, 0, 0, 1, 0, 1]"], "low < high"),
    (["--teleop.type=sim_leader", "--env.type=ur5e_station"], "leader of an arm"),
    (["--robot.type=sim_ur5e", *ARM_CAMERA, "--robot.state=true", "--operator_page=false"], "There is no terminal"),
])  # fmt: skip
def test_mistakes_are_said_before_anything_moves(
    options: list[str], said: str, cleaned_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = ["--dataset.repo_id=local/cqn", f"--dataset.root={cleaned_arm}"]
    assert main([*TINY_POLICY, *SMALL_EYES, *data, *options, f"--output_dir={tmp_path / 'run'}"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert said in error
    assert not (tmp_path / "run").exists()


def test_a_port_in_use_is_said_before_anything_is_written(
    cleaned_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        options = [
            *TINY_POLICY, *SMALL_EYES, *ARM_CAMERA, "--dataset.repo_id=local/cqn", f"--dataset.root={cleaned_arm}",
            "--robot.type=sim_ur5e", "--robot.state=true", f"--page.port={port}",
            f"--output_dir={tmp_path / 'run'}",
        ]  # fmt: skip
        assert main(options) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"127.0.0.1:{port}" in error
    assert not (tmp_path / "run").exists()
