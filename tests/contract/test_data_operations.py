"""Every operation through the command line, on a recording with a camera: what LeRobot then loads, to the pixel."""

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.processor_cqn import make_cqn_pre_post_processors

from .data_recording import LENGTHS, NAMES, TOP, column, history, last_line, run, videos, what


def test_delta_and_back_is_exact_and_leaves_the_videos_alone(recording, tmp_path):
    there = run("delta", recording, tmp_path / "delta")
    state, absolute = column(recording, "observation.state"), column(recording, "action")
    delta = column(tmp_path / "delta", "action")
    np.testing.assert_allclose(delta[:, :2], absolute[:, :2] - state[:, :2], atol=1e-6)
    np.testing.assert_array_equal(delta[:, 2], absolute[:, 2])  # the gripper stays as it was
    np.testing.assert_allclose(there.meta.stats["action"]["max"], delta.max(0), atol=1e-6)
    np.testing.assert_allclose(there.meta.stats["action"]["mean"], delta.mean(0), atol=1e-6)
    run("delta", tmp_path / "delta", tmp_path / "back", "--to=absolute")
    np.testing.assert_allclose(column(tmp_path / "back", "action"), absolute, atol=1e-6)
    assert videos(recording) == videos(tmp_path / "delta") == videos(tmp_path / "back")
    old = LeRobotDataset("local/src", recording).meta
    np.testing.assert_array_equal(there.meta.stats[TOP]["mean"], old.stats[TOP]["mean"])
    assert there.meta.info.features[TOP] == old.info.features[TOP]
    first = history(tmp_path / "back")[0]
    assert (first["operation"], first["deltas"]) == (
        "delta",
        {"kind": "command", "action": NAMES[:2], "state": NAMES[:2]},
    )
    for index in (0, 25, 62):
        episode, frame = int(there[index]["source.episode_index"]), int(there[index]["source.frame_index"])
        assert (
            what(there[index][TOP])
            == (frame, episode)
            == (int(there[index]["frame_index"]), int(there[index]["episode_index"]))
        )


def test_delta_refuses_to_do_it_twice_or_to_guess(recording, tmp_path, capsys):
    run("delta", recording, tmp_path / "delta")
    run("delta", tmp_path / "delta", tmp_path / "twice", code=2)
    assert "deltas already (kind command)" in last_line(capsys)
    run("delta", recording, tmp_path / "back", "--to=absolute", code=2)
    assert "--actions=command, command_steps or state" in last_line(capsys)
    run("delta", tmp_path / "delta", tmp_path / "other", "--actions=absolute", "--keep_absolute=[pam.pos]", code=2)
    assert "Did you mean 'pan.pos'?" in last_line(capsys)


def test_filter_forms_delta_actions_anew(recording, tmp_path):
    for kind in ("command_steps", "state"):
        run("delta", recording, tmp_path / kind, f"--of={kind}")
        run("filter", tmp_path / kind, tmp_path / f"{kind}_f", "--threshold=0.01")
        folder = tmp_path / f"{kind}_f"
        state, action = column(folder, "observation.state")[:, :2], column(folder, "action")[:, :2]
        assert len(state) < sum(LENGTHS)
        episode = column(folder, "episode_index")
        same = episode[1:] == episode[:-1]
        if kind == "state":
            np.testing.assert_allclose((state + action)[:-1][same], state[1:][same], atol=1e-5)
        else:
            commands = column(recording, "action")[:, :2]
            starts = np.cumsum([0, *LENGTHS])[column(folder, "source.episode_index")]
            wanted = commands[starts + column(folder, "source.frame_index")]
            np.testing.assert_allclose(np.diff(wanted, axis=0)[same], action[1:][same], atol=1e-5)


def test_label_copies_videos_and_marks_the_last_steps(recording, tmp_path):
    dataset = run("label", recording, tmp_path / "dst", "--failed=[1]")
    ends = np.cumsum(LENGTHS) - 1
    reward, done = column(tmp_path / "dst", "next.reward"), column(tmp_path / "dst", "next.done")
    assert np.flatnonzero(reward).tolist() == [ends[0], ends[2]]
    assert np.flatnonzero(done).tolist() == ends.tolist()
    assert column(tmp_path / "dst", "next.success").sum() == 2
    np.testing.assert_allclose(dataset.meta.stats["next.reward"]["mean"], 2 / 63)
    assert videos(recording) == videos(tmp_path / "dst")
    assert history(tmp_path / "dst")[-1]["failures"] == [1]


def test_bounds_are_what_training_maps_to_one_and_hold_until_actions_change(recording, tmp_path, capsys):
    run("bounds", recording, tmp_path / "b", "--margin=0.25")
    action = column(recording, "action")
    low, high = action.min(0), action.max(0)
    spread = 0.25 * (high - low)
    after = run("label", tmp_path / "b", tmp_path / "bl", "--all")
    np.testing.assert_allclose(after.meta.stats["action"]["min"], low - spread, atol=1e-6)
    np.testing.assert_allclose(after.meta.stats["action"]["max"], high + spread, atol=1e-6)
    capsys.readouterr()
    filtered = run("filter", tmp_path / "bl", tmp_path / "blf", "--threshold=0.01")
    assert "bounds do not hold for the result" in capsys.readouterr().err
    np.testing.assert_allclose(
        filtered.meta.stats["action"]["min"], column(tmp_path / "blf", "action").min(0), atol=1e-6
    )
    from lerobot.configs.types import FeatureType, PolicyFeature

    state, joints = PolicyFeature(FeatureType.STATE, (3,)), PolicyFeature(FeatureType.ACTION, (3,))
    config = CQNConfig(input_features={"observation.state": state}, output_features={"action": joints}, device="cpu")
    pre, _ = make_cqn_pre_post_processors(config, after.meta.stats)
    for bound, value in ((low - spread, -1.0), (high + spread, 1.0)):
        batch = {"observation.state": torch.zeros(3), "action": torch.tensor(bound, dtype=torch.float32)}
        np.testing.assert_allclose(pre(batch)["action"].numpy().ravel(), np.full(3, value), atol=1e-5)


def test_resample_takes_the_right_pictures_and_last_commands(recording, tmp_path):
    dataset = run("resample", recording, tmp_path / "dst", "--fps=10")
    assert dataset.fps == 10
    assert [e["length"] for e in dataset.meta.episodes] == [7, 4, 11]
    action = column(recording, "action")
    starts = np.cumsum([0, *LENGTHS])
    for index in range(len(dataset)):
        item = dataset[index]
        episode, frame = int(item["source.episode_index"]), int(item["source.frame_index"])
        assert frame == 3 * int(item["frame_index"])
        assert what(item[TOP]) == (frame, episode)
        last = min(frame + 2, LENGTHS[episode] - 1)
        np.testing.assert_array_equal(item["action"].numpy(), action[starts[episode] + last])


def test_resize_and_crop(recording, tmp_path, capsys):
    dataset = run("resize", recording, tmp_path / "dst", "--size=[32, 32]", '--crop={"top": [0, 24, 48, 24]}')
    assert tuple(dataset.meta.features[TOP]["shape"]) == (32, 32, 3)
    assert "squeezed" in capsys.readouterr().err
    for index in (0, 20, 62):  # only the right half is left
        shown = float(dataset[index][TOP].mean()) * 255
        assert abs(shown - 40 - 80 * int(dataset[index]["episode_index"])) < 4
    assert abs(float(dataset.meta.stats[TOP]["max"].max()) * 255 - 200) < 6
    run("resize", recording, tmp_path / "x", '--crop={"topp": [0, 0, 8, 8]}', code=2)
    assert "Unknown camera 'topp'" in last_line(capsys)
    run("resize", recording, tmp_path / "x", '--crop={"top": [0, 40, 8, 9]}', code=2)
    assert "lies outside its 48x48 picture" in last_line(capsys)


def test_drop_keeps_the_reason(recording, tmp_path, capsys):
    dataset = run(
        "drop", recording, tmp_path / "dst", "--episodes=[0]", "--where=steps < 15", "--reason=clumsy [a] [/b]"
    )
    assert "clumsy [a] [/b]: steps < 15 (12)" in " ".join(capsys.readouterr().out.split())
    assert (dataset.num_episodes, dataset.num_frames) == (1, 31)
    assert history(tmp_path / "dst")[0]["dropped"] == {"0": "clumsy [a] [/b]", "1": "clumsy [a] [/b]: steps < 15 (12)"}
    assert what(dataset[4][TOP]) == (4, 2)
