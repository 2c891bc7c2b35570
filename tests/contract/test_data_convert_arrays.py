"""`cqn-data convert` from HDF5, Zarr and NPZ: the numbers and pictures that went in come out, or a clear error."""

import json
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
    rows,
    snapshot,
    target_fixture,  # noqa: F401
)
from ..foreign_formats import (
    LENGTHS,
    numbers,
    picture,
    spoil_npz,
    write_aloha,
    write_npz,
    write_robomimic,
    write_zarr,
)

# --- robomimic


def test_robomimic_state_objects_rewards_and_video(tmp_path, target, capsys):
    source = tmp_path / "lift.hdf5"
    expected = write_robomimic(source)
    before = snapshot(source)
    assert convert("robomimic", source, target) == 0
    out, err = capsys.readouterr()
    assert "20 frames a second (env_args.env_kwargs.control_freq)" in out
    assert "Left out: next_obs (6 arrays), obs/robot0_joint_pos, states." in err
    assert "Left out of the file: mask." in err
    assert snapshot(source) == before
    dataset = LeRobotDataset("local/dst", target)
    assert dataset.meta.robot_type == "Panda"
    assert dataset[0]["task"] == "Lift"
    names = dataset.meta.features["observation.state"]["names"]
    assert names[:4] == ["robot0_eef_pos.0", "robot0_eef_pos.1", "robot0_eef_pos.2", "robot0_eef_quat.0"]
    keys = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")
    state = np.concatenate([np.concatenate([e[k] for k in keys], axis=1) for e in expected]).astype(np.float32)
    np.testing.assert_array_equal(column(target, "observation.state"), state)
    for key, name in (("actions", "action"), ("object", "observation.environment_state")):
        np.testing.assert_array_equal(
            column(target, name), np.concatenate([e[key] for e in expected]).astype(np.float32)
        )
    last = [t == n - 1 for n in LENGTHS for t in range(n)]
    assert column(target, "next.done").tolist() == last
    assert column(target, "next.reward").tolist() == [float(x) for x in last]
    shown = np.stack([frame(dataset, i, "agentview") for i in range(9)]).astype(float)
    pictures = np.concatenate([e["agentview_image"] for e in expected])
    assert np.abs(shown - pictures).mean() < 6


def test_robomimic_options(tmp_path, target, capsys):
    source = tmp_path / "lift.hdf5"
    expected = write_robomimic(source, fps=False)
    assert "give --fps=N" in refusal(capsys, "robomimic", source, target)
    options = ["--fps=12", "--state_keys=[robot0_joint_pos, object]", "--rewards=false", NONE]
    assert convert("robomimic", source, target, *options) == 0
    state = np.concatenate([np.c_[e["robot0_joint_pos"], e["object"]] for e in expected]).astype(np.float32)
    np.testing.assert_array_equal(column(target, "observation.state"), state)
    assert "next.reward" not in rows(target)
    assert "observation.environment_state" not in rows(target)
    assert history(target)["settings"]["fps"] == 12


def test_robomimic_errors_name_the_demonstration(tmp_path, target, capsys):
    import h5py

    source = tmp_path / "lift.hdf5"
    write_robomimic(source)
    text = refusal(capsys, "robomimic", source, target, "--state_keys=[robot0_eef_poss]")
    assert "Did you mean 'robot0_eef_pos'?" in text
    with h5py.File(source, "a") as file:
        del file["data/demo_1/actions"]
        file["data/demo_1/actions"] = numbers(0, 3, 7)
    assert "demo_1: expected 3 rows" in refusal(capsys, "robomimic", source, target)
    with h5py.File(source, "a") as file:
        del file["data/demo_1/actions"]
    text = refusal(capsys, "robomimic", source, target)
    assert "demo_1: expected 'actions', found dones" in text
    with h5py.File(source, "a") as file:
        del file["data/demo_1"], file["data/demo_0/obs"]
    assert "dataset_states_to_obs" in refusal(capsys, "robomimic", source, target)
    with h5py.File(source, "a") as file:
        del file["data"]
    assert "expected 'data', found mask" in refusal(capsys, "robomimic", source, target)
    source.write_bytes(source.read_bytes()[:500])
    assert "lift.hdf5 cannot be read" in refusal(capsys, "robomimic", source, target)
    source.unlink()
    source.mkdir()
    assert "found a folder" in refusal(capsys, "robomimic", source, target)


# --- ALOHA


def test_aloha_raw_pictures_velocities_and_names(tmp_path, target):
    source = tmp_path / "transfer_cube"
    expected = write_aloha(source, lengths=(3, 2), base=True)
    write_aloha(tmp_path / "more", lengths=(2,))
    (tmp_path / "more/episode_0.hdf5").rename(source / "episode_10.hdf5")  # comes after 1, and has no base
    assert convert("aloha", source, target, LOSSLESS, "--skip_bad_episodes") == 0
    dataset = LeRobotDataset("local/dst", target)
    assert (dataset.fps, dataset.num_frames, dataset[0]["task"]) == (50, 5, "transfer cube")
    assert [s["source"] for s in history(target)["skipped"]] == ["episode_10.hdf5"]
    assert dataset.meta.features["action"]["names"][6:8] == ["left_gripper", "right_waist"]
    columns = {"qpos": "observation.state", "qvel": "observation.velocity", "effort": "observation.effort"}
    for key, name in (columns | {"action": "action", "base_action": "base_action"}).items():
        wanted = np.concatenate([e[key] for e in expected]).astype(np.float32)
        np.testing.assert_array_equal(column(target, name), wanted)
    pictures = np.concatenate([e["cam_high"] for e in expected])
    np.testing.assert_array_equal(np.stack([frame(dataset, i, "cam_high") for i in range(5)]), pictures)


@pytest.mark.parametrize("compress", [True, "bytes"])
def test_aloha_jpeg_pictures_and_swapped_colours(tmp_path, target, compress, capsys):
    expected = write_aloha(tmp_path / "in", lengths=(2,), compress=compress)
    assert convert("aloha", tmp_path / "in/episode_0.hdf5", target, LOSSLESS, "--fps=25", "--swap_colors") == 0
    dataset = LeRobotDataset("local/dst", target)
    shown = frame(dataset, 1, "cam_high").astype(float)
    assert dataset.fps == 25
    assert ("Left out: observations/images/cam_high_depth." in capsys.readouterr().err) == (compress == "bytes")
    assert np.abs(shown - expected[0]["cam_high"][1][:, :, ::-1]).mean() < 4


def test_a_picture_that_cannot_be_read_ends_or_skips_the_episode(tmp_path, target, capsys):
    import h5py

    write_aloha(tmp_path / "in", lengths=(3, 3), compress=True)
    with h5py.File(tmp_path / "in/episode_0.hdf5", "a") as file:
        file["observations/images/cam_high"][2] = 0
    text = refusal(capsys, "aloha", tmp_path / "in", target)
    assert "episode_0.hdf5, frame 2 cannot be read" in text
    for video in ("true", "false"):
        out = target.with_name("dst") if video == "true" else target.parent.parent / "second"
        assert convert("aloha", tmp_path / "in", out, "--skip_bad_episodes", f"--video={video}") == 0
        dataset = LeRobotDataset("local/dst", out)
        assert (dataset.num_episodes, dataset.num_frames) == (1, 3)
        assert np.abs(frame(dataset, 2, "cam_high").astype(float) - picture(12)).mean() < 8
        assert column(out, "source.episode_index").tolist() == [1, 1, 1]
        assert "frame 2" in history(out)["skipped"][0]["reason"]
        assert str(tmp_path) not in json.dumps(history(out))


def test_aloha_without_anything_readable(tmp_path, target, capsys):
    (tmp_path / "in").mkdir()
    assert "expected episode_0.hdf5" in refusal(capsys, "aloha", tmp_path / "in", target)
    (tmp_path / "in/episode_0.hdf5").write_bytes(b"not HDF5")
    assert "episode_0.hdf5 cannot be read" in refusal(capsys, "aloha", tmp_path / "in", target)
    assert "cannot be read" in refusal(capsys, "aloha", tmp_path / "in", target, "--skip_bad_episodes")


# --- diffusion_policy


@pytest.mark.parametrize(
    ("name", "dtype", "zarr_format"),
    [("replay_buffer.zarr", "uint8", 2), ("push.zarr.zip", "float32", 2), ("push.zarr", "unit", 3)],
)
def test_zarr_buffers(tmp_path, target, capsys, name, dtype, zarr_format):
    (tmp_path / "in").mkdir()
    values = write_zarr(tmp_path / "in" / name, dtype=dtype, zarr_format=zarr_format)
    source = tmp_path / "in" if name.startswith("replay") else tmp_path / "in" / name
    (tmp_path / "in/videos").mkdir()
    assert convert("diffusion_policy", source, target, "--fps=10", LOSSLESS, "--task=push") == 0
    assert "videos is not read" in capsys.readouterr().err
    dataset = LeRobotDataset("local/dst", target)
    assert [e["length"] for e in dataset.meta.episodes] == list(LENGTHS)
    for key, to in (("state", "observation.state"), ("action", "action"), ("n_contacts", "n_contacts")):
        np.testing.assert_array_equal(column(target, to).reshape(values[key].shape), values[key])
    stored = np.stack([np.stack(list(v)) for v in rows(target)["keypoint"]])
    np.testing.assert_array_equal(stored, values["keypoint"])
    shown = np.stack([frame(dataset, i, "img") for i in range(9)])
    np.testing.assert_array_equal(shown, values["pictures"])


def test_zarr_errors(tmp_path, target, capsys):
    import zarr

    source = tmp_path / "push.zarr"
    write_zarr(source)
    assert "give --fps=N" in refusal(capsys, "diffusion_policy", source, target)
    text = refusal(capsys, "diffusion_policy", source, target, "--fps=10", "--state_keys=[stat]")
    assert "Did you mean 'state'?" in text
    root = zarr.open_group(str(source), mode="a")
    root["data/state"][6] = np.nan
    text = refusal(capsys, "diffusion_policy", source, target, "--fps=10")
    assert "episode_1, frame 1: 'observation.state' is not finite" in text
    root["data/img"].resize((7, 32, 32, 3))
    text = refusal(capsys, "diffusion_policy", source, target, "--fps=10")
    assert "data/img: expected 9 rows" in text
    del root["data/action"]
    assert "expected 'action', found img" in refusal(capsys, "diffusion_policy", source, target, "--fps=10")
    shutil.rmtree(source / "meta")
    assert "expected 'meta', found data" in refusal(capsys, "diffusion_policy", source, target, "--fps=10")
    write_zarr(tmp_path / "push.zarr.zip")
    (tmp_path / "push.zarr.zip").write_bytes((tmp_path / "push.zarr.zip").read_bytes()[:3000])
    text = refusal(capsys, "diffusion_policy", tmp_path / "push.zarr.zip", target, "--fps=10")
    assert "complete .zarr.zip" in text
    text = refusal(capsys, "diffusion_policy", tmp_path / "push.zarr/data", target, "--fps=10")
    assert "expected 'data', found img" in text


def test_zarr_damaged_chunk_is_found(tmp_path, target, capsys):
    source = tmp_path / "push.zarr"
    write_zarr(source)
    chunk = next(p for p in (source / "data/img").rglob("*") if p.name.startswith("2.0"))
    chunk.write_bytes(b"broken")
    text = refusal(capsys, "diffusion_policy", source, target, "--fps=10")
    assert "episode_1, frame" in text
    chunk.unlink()
    assert convert("diffusion_policy", source, target, "--fps=10", "--dry_run") == 0
    assert "data/img: 1 of 3 chunks are not on disk" in capsys.readouterr().err


# --- NPZ


def test_npz_names_unknown_columns_and_cameras(tmp_path, target, capsys):
    expected = write_npz(tmp_path / "takes", task="pour", fps=30, intrinsics=np.eye(3))
    assert convert("npz", tmp_path / "takes", target, LOSSLESS) == 0
    assert "Left out: label, intrinsics." in capsys.readouterr().err
    dataset = LeRobotDataset("local/dst", target)
    assert (dataset.fps, dataset[0]["task"]) == (30, "pour")
    assert [e["source"] for e in history(target)["episodes"]] == ["take_9.npz", "take_10.npz"]
    for key in ("observation.state", "action", "force", "phase"):
        stored = np.stack([np.stack(list(v)) if np.ndim(v) else v for v in rows(target)[key]])
        np.testing.assert_array_equal(stored, np.concatenate([e[key] for e in expected]))
    assert column(target, "next.success").tolist() == column(target, "next.reward").astype(bool).tolist()
    np.testing.assert_array_equal(frame(dataset, 6, "top_rgb"), picture(11))
    np.testing.assert_array_equal(frame(dataset, 6, "side"), picture(1))


def test_npz_errors(tmp_path, target, capsys):
    source = tmp_path / "takes"
    write_npz(source)
    assert "give --fps=N" in refusal(capsys, "npz", source, target)
    spoil_npz(source / "take_10.npz", "force", b"\x93NUMPY\x01\x00v\x00nonsense")
    assert "take_10.npz cannot be read" in refusal(capsys, "npz", source, target, "--fps=30")
    shutil.rmtree(source)
    write_npz(source, force=np.array([{}], dtype=object))
    assert "Python objects" in refusal(capsys, "npz", source, target, "--fps=30")
    shutil.rmtree(source)
    write_npz(source, lengths=(4,), action=numbers(0, 3, 2))
    text = refusal(capsys, "npz", source, target, "--fps=30")
    assert "expected 3 rows of 'observation.state', as of the action, found 4" in text
    shutil.rmtree(source)
    source.mkdir()
    np.savez(source / "a.npz", state=np.zeros((3, 2)), action=np.zeros((3, 2)))
    assert "expected 'observation.state', found action, state" in refusal(capsys, "npz", source, target, "--fps=3")
    assert convert("npz", source, target, "--fps=3", "--state_keys=[state]") == 0
