"""What the recipe leaves is a dataset to LeRobot's own commands: load, show, edit, train."""

import json
import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.cli import main

from .conftest import TINY_POLICY, Command

RECORDINGS = Path(__file__).parents[3] / "shared" / "data"
EPISODES, STEPS, SIDE = 4, 24, 96
CAMERAS = ("observation.images.top", "observation.images.wrist")
ACT = [
    "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.chunk_size=4",
    "--policy.n_action_steps=4", "--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=32",
    "--policy.pretrained_backbone_weights=null", "--batch_size=2", "--steps=2", "--num_workers=0", "--log_freq=1",
]  # fmt: skip
CQN = [*TINY_POLICY, "--policy.preset=paper_real_world", "--policy.push_to_hub=false", "--batch_size=2", "--steps=2",
       "--num_workers=0", "--log_freq=1"]  # fmt: skip


def scene(rng):
    """A picture that survives compression: soft blobs."""
    small = rng.integers(0, 255, (6, 8, 3), np.uint8)
    return cv2.resize(small, (SIDE + 32, SIDE), interpolation=cv2.INTER_CUBIC)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """As lerobot-record leaves it: absolute commands, two cameras, pauses, no reward."""
    root = tmp_path_factory.mktemp("recorded") / "src"
    vector = {"dtype": "float32", "shape": (3,), "names": ["pan.pos", "lift.pos", "gripper.pos"]}
    camera = {"dtype": "video", "shape": (SIDE, SIDE + 32, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, **dict.fromkeys(CAMERAS, camera)}
    encoder = RGBEncoderConfig(vcodec="h264")
    dataset = LeRobotDataset.create("local/src", 30, features, root=root, robot_type="toy", rgb_encoder=encoder)
    rng = np.random.default_rng(0)
    for episode in range(EPISODES):
        state = rng.normal(size=3).astype(np.float32)
        for step in range(STEPS):
            move = 0.0 if 8 <= step < 14 else rng.uniform(0.05, 0.1)
            action = state + np.float32([move, -move, 0])
            pictures = {k: scene(rng) for k in CAMERAS}
            task = "Pick it up." if episode % 2 else "Put it down."
            dataset.add_frame({"observation.state": state.copy(), "action": action, **pictures, "task": task})
            state = action
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


@pytest.fixture(scope="module")
def prepared(recorded, tmp_path_factory):
    """The paper's recipe on it."""
    target = tmp_path_factory.mktemp("prepared") / "dst"
    names = [f"--root={recorded}", "--new_repo_id=local/dst", f"--new_root={target}"]
    try:
        assert main(["run", "paper_real_world", "--repo_id=local/src", *names]) == 0
    finally:
        logging.disable(logging.NOTSET)
    return target


def edit(command: Command, root: Path, *arguments: str) -> str:
    done = command("lerobot-edit-dataset", "--repo_id=local/dst", f"--root={root}", *arguments)
    return done.stdout + done.stderr


def numbers(root, key):
    files = sorted((root / "data").glob("*/*.parquet"))
    return np.concatenate([np.stack(pd.read_parquet(f)[key]) for f in files])


def test_it_loads_with_statistics_of_what_is_in_it(prepared):
    dataset = LeRobotDataset("local/dst", prepared)
    assert dataset.num_episodes == EPISODES
    assert dataset.num_frames == EPISODES * (STEPS - 6)
    assert {dataset[i]["task"] for i in (0, 30)} == {"Pick it up.", "Put it down."}
    for camera in CAMERAS:
        pictures = np.stack([dataset[i][camera].numpy() for i in range(0, len(dataset), 3)])
        assert pictures.shape[1:] == (3, 84, 84)
        stats = dataset.meta.stats[camera]
        np.testing.assert_allclose(np.ravel(stats["mean"]), pictures.mean((0, 2, 3)), atol=0.02)
        np.testing.assert_allclose(np.ravel(stats["std"]), pictures.std((0, 2, 3)), atol=0.02)
    for key in ("action", "observation.state", "next.reward"):
        values = numbers(prepared, key).reshape(len(dataset), -1)
        margin = np.zeros(values.shape[1])
        if key == "action":  # the recipe widens the bounds of the differences, and not the gripper's
            margin[:-1] = 0.2 * np.ptp(values, axis=0)[:-1]
        for name, expected in (
            ("mean", values.mean(0)),
            ("std", values.std(0)),
            ("min", values.min(0) - margin),
            ("max", values.max(0) + margin),
        ):
            np.testing.assert_allclose(np.ravel(dataset.meta.stats[key][name]), expected, atol=1e-5)


def test_lerobot_edits_it(prepared, command: Command, tmp_path):
    shutil.copytree(prepared, tmp_path / "dst")
    root = tmp_path / "dst"
    assert "local/dst" in edit(command, root, "--operation.type=info")
    fewer = f"--new_root={tmp_path / 'fewer'}"
    edit(
        command,
        root,
        "--new_repo_id=local/fewer",
        fewer,
        "--operation.type=delete_episodes",
        "--operation.episode_indices=[1]",
    )
    left = LeRobotDataset("local/fewer", tmp_path / "fewer")
    assert left.num_episodes == EPISODES - 1
    np.testing.assert_array_equal(
        numbers(tmp_path / "fewer", "action"),
        numbers(prepared, "action")[numbers(prepared, "episode_index") != 1],
    )
    assert left[20][CAMERAS[0]].shape == (3, 84, 84)
    splits = '--operation.splits={"a": [0, 1], "b": [2, 3]}'
    edit(command, root, f"--new_root={tmp_path / 'split'}", "--operation.type=split", splits)
    parts = sorted(p.parent.parent for p in tmp_path.glob("split*/**/meta/info.json"))
    assert len(parts) == 2
    command(
        "lerobot-edit-dataset", "--new_repo_id=local/all", f"--new_root={tmp_path / 'all'}", "--operation.type=merge",
        "--operation.repo_ids=['local/a', 'local/b']", f"--operation.roots={[str(p) for p in parts]}",
    )  # fmt: skip
    merged = LeRobotDataset("local/all", tmp_path / "all")
    np.testing.assert_array_equal(numbers(tmp_path / "all", "action"), numbers(prepared, "action"))
    assert merged[len(merged) - 1][CAMERAS[1]].shape == (3, 84, 84)


def test_lerobot_shows_it(prepared, command: Command, tmp_path):
    pytest.importorskip("rerun", exc_type=ImportError)
    options = [f"--root={prepared}", "--episode-index=1", "--save=1", f"--output-dir={tmp_path}", "--num-workers=0"]
    command("lerobot-dataset-viz", "--repo-id=local/dst", *options)
    assert next(tmp_path.glob("*.rrd")).stat().st_size > 1000


@pytest.mark.parametrize("policy", [ACT, CQN], ids=["act", "cqn"])
def test_lerobot_trains_on_it(prepared, command: Command, tmp_path, policy):
    data = ["--dataset.repo_id=local/dst", f"--dataset.root={prepared}"]
    command("lerobot-train", *policy, *data, f"--output_dir={tmp_path / 'run'}")
    assert (tmp_path / "run/checkpoints/000002/pretrained_model/model.safetensors").is_file()


@pytest.mark.skipif(not (RECORDINGS / "g1_teleop_v21").is_dir(), reason="no real recordings here")
def test_a_real_recording_from_v21_to_training(command: Command, tmp_path):
    before = {p: p.stat().st_mtime_ns for p in RECORDINGS.rglob("*")}
    old, new = ["--from=lerobot_v21", f"--input={RECORDINGS / 'g1_teleop_v21'}"], tmp_path / "g1"
    assert main(["convert", *old, "--new_repo_id=local/g1", f"--new_root={new}"]) == 0
    names = ["--repo_id=local/g1", f"--root={new}", "--new_repo_id=local/cqn", f"--new_root={tmp_path / 'cqn'}"]
    assert main(["run", "paper_real_world", *names, '--filter.gripper_names=["kRightHandIndex"]']) == 0
    logging.disable(logging.NOTSET)
    dataset = LeRobotDataset("local/cqn", tmp_path / "cqn")
    assert dataset.num_episodes == 5
    assert 800 < dataset.num_frames < 1529
    assert dataset[0]["observation.images.cam_high"].shape == (3, 84, 84)
    operations = json.loads((tmp_path / "cqn/meta/cqn_history.json").read_text())["operations"]
    assert [e["operation"] for e in operations] == ["convert", "filter", "delta", "resize", "label", "bounds"]
    data = ["--dataset.repo_id=local/cqn", f"--dataset.root={tmp_path / 'cqn'}"]
    for number, policy in enumerate((ACT, CQN)):
        command("lerobot-train", *policy, *data, f"--output_dir={tmp_path / f'run{number}'}")
    assert before == {p: p.stat().st_mtime_ns for p in RECORDINGS.rglob("*")}
