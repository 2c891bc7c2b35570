"""`cqn-data convert --from=rlbench`: what is read, and that a pickle can do no harm."""

import json
import os
import pickle
import shutil

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from ..conversions import (
    LOSSLESS,
    NONE,
    column,
    convert,
    frame,
    history,
    logs_fixture,  # noqa: F401
    refusal,
    snapshot,
    target_fixture,  # noqa: F401
)
from ..foreign_formats import (
    CAMERAS,
    picture,
    write_rlbench,
)


def test_rlbench_state_action_pictures_and_sentence(tmp_path, target, capsys):
    source = tmp_path / "open_drawer"
    expected = write_rlbench(source)
    before = snapshot(source)
    assert convert("rlbench", source, target, LOSSLESS) == 0
    out, err = capsys.readouterr()
    assert "20 frames a second (RLBench's simulation step" in out
    assert "7 commanded actions, 0 measured actions" in out
    assert "Left out: front_depth, front_mask" in err
    assert snapshot(source) == before
    dataset = LeRobotDataset("local/dst", target)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 7, 20)
    joints = [f"joint_positions.{i}" for i in range(7)]
    for key in ("observation.state", "action"):
        assert dataset.meta.features[key]["names"] == [*joints, "gripper_open"]
    state = np.concatenate([np.c_[e["joints"], e["gripper"]][:-1] for e in expected]).astype(np.float32)
    action = np.concatenate([np.c_[e["command"][1:, :7], e["gripper"][1:]] for e in expected]).astype(np.float32)
    np.testing.assert_array_equal(column(target, "observation.state"), state)
    np.testing.assert_array_equal(column(target, "action"), action)
    assert column(target, "source.episode_index").tolist() == [0] * 4 + [1] * 3
    assert column(target, "source.frame_index").tolist() == [0, 1, 2, 3, 0, 1, 2]
    assert dataset.meta.camera_keys == [f"observation.images.{camera}" for camera in CAMERAS]
    np.testing.assert_array_equal(frame(dataset, 2, "wrist"), picture(2))
    np.testing.assert_array_equal(frame(dataset, 4, "front"), picture(10))
    assert dataset[0]["task"] == "open the top drawer"
    entry = history(target)
    assert (entry["operation"], entry["format"], entry["source"]) == ("convert", "rlbench", "open_drawer")
    assert entry["total"] == {"episodes": 2, "steps": 7, "commanded_actions": 7, "measured_actions": 0}
    assert [e["source"] for e in entry["episodes"]] == [f"variation0/episodes/episode{i}" for i in (0, 1)]
    assert str(tmp_path) not in json.dumps(entry)


@pytest.mark.parametrize(("protocol", "old_numpy"), [(2, True), (5, False), (0, False)])
def test_rlbench_without_commands_takes_the_next_measured_joints(tmp_path, target, protocol, old_numpy):
    expected = write_rlbench(tmp_path / "task", commanded=False, protocol=protocol, old_numpy=old_numpy)
    assert convert("rlbench", tmp_path / "task/variation0/episodes", target, NONE) == 0
    action = np.concatenate([np.c_[e["joints"], e["gripper"]][1:] for e in expected]).astype(np.float32)
    np.testing.assert_array_equal(column(target, "action"), action)
    assert history(target)["total"]["measured_actions"] == 7


def test_rlbench_chosen_keys_and_masks(tmp_path, target, capsys):
    write_rlbench(tmp_path / "task")
    options = ["--image_keys=[front_mask]", "--state_keys=[gripper_open, gripper_pose]", LOSSLESS, "--task=go"]
    assert convert("rlbench", tmp_path / "task", target, *options) == 0
    assert "only --video=false keeps them exactly" in capsys.readouterr().err
    dataset = LeRobotDataset("local/dst", target)
    assert dataset.meta.camera_keys == ["observation.images.front_mask"]
    assert dataset.meta.features["observation.state"]["names"][:2] == ["gripper_open", "gripper_pose.0"]
    assert dataset[0]["task"] == "go"


def test_rlbench_refuses_unknown_keys_and_damaged_episodes(tmp_path, target, capsys):
    source = tmp_path / "task"
    write_rlbench(source)
    episode = source / "variation0/episodes/episode1"
    text = refusal(capsys, "rlbench", source, target, "--image_keys=[front_rgp]")
    assert "Did you mean 'front_rgb'?" in text
    text = refusal(capsys, "rlbench", source, target, "--state_keys=[joint_position]")
    assert "Did you mean 'joint_positions'?" in text
    (episode / "wrist_rgb/3.png").rename(episode / "wrist_rgb/7.png")
    assert "3.png is missing" in refusal(capsys, "rlbench", source, target)
    (episode / "wrist_rgb/7.png").unlink()
    text = refusal(capsys, "rlbench", source, target)
    assert "expected 4 pictures" in text
    assert "found 3" in text
    assert "episode1/wrist_rgb" in text
    shutil.rmtree(source)
    write_rlbench(source, nan_at=(1, 2))
    assert "episode1, frame 2: 'observation.state' is not finite" in refusal(capsys, "rlbench", source, target)
    data = (episode / "low_dim_obs.pkl").read_bytes()
    (episode / "low_dim_obs.pkl").write_bytes(data[: len(data) // 2])
    assert "low_dim_obs.pkl cannot be read" in refusal(capsys, "rlbench", source, target)
    (episode / "low_dim_obs.pkl").unlink()
    assert "low_dim_obs.pkl is missing" in refusal(capsys, "rlbench", source, target)
    assert convert("rlbench", source, target, NONE, "--skip_bad_episodes") == 0
    assert LeRobotDataset("local/dst", target).num_episodes == 1


class Command:
    """Runs a command when it is unpickled."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_a_hostile_pickle_is_refused_by_name_and_nothing_runs(tmp_path, target, capsys, protocol):
    write_rlbench(tmp_path / "task")
    victim = tmp_path / "victim"
    calls = [
        (os.system, f"touch {victim}"), (eval, f"open({str(victim)!r}, 'w')"), (getattr, "x", "upper"),
        (np.load, str(victim)), (np.memmap, str(victim), "u1", "w+"), (shutil.rmtree, str(tmp_path)),
    ]  # fmt: skip
    path = tmp_path / "task/variation0/episodes/episode0/low_dim_obs.pkl"
    for function, *arguments in calls:
        path.write_bytes(pickle.dumps([Command(function, *arguments)], protocol=protocol))
        text = refusal(capsys, "rlbench", tmp_path / "task", target)
        assert f".{function.__name__}" in text
        assert "refused" in text
        assert str(path) in text
        assert not victim.exists()
    (tmp_path / "task/variation0/variation_descriptions.pkl").write_bytes(path.read_bytes())
    assert "refused" in refusal(capsys, "rlbench", tmp_path / "task", target)


def test_known_classes_cannot_be_misused(tmp_path, target, capsys):
    path = tmp_path / "task/variation0/episodes/episode0/low_dim_obs.pkl"
    path.parent.mkdir(parents=True)
    # Sets an attribute of the class itself, which must not be seen by the next reading.
    path.write_bytes(b"\x80\x02crlbench.demo\nDemo\n(N}X\x0d\x00\x00\x00_observations]stb.")
    assert "found 0; leave it out" in refusal(capsys, "rlbench", tmp_path / "task", target)
    path.write_bytes(b"\x80\x02crlbench.demo\nDemo\n)\x81.")
    assert "expected an RLBench Demo" in refusal(capsys, "rlbench", tmp_path / "task", target)
    path.write_bytes(pickle.dumps({"a": 1}))
    assert "expected an RLBench Demo" in refusal(capsys, "rlbench", tmp_path / "task", target)
    path.write_bytes(pickle.dumps(np.array([{}], dtype=object)))
    assert "array of Python objects" in refusal(capsys, "rlbench", tmp_path / "task", target)
