"""`cqn-data convert`: files with every optional part; what is taken is right, and what is left out is named."""

import json

import h5py
import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from ..conversions import NONE, column, convert, logs_fixture, refusal, target_fixture  # noqa: F401
from ..foreign_formats import LENGTHS, numbers, picture, write_aloha, write_npz, write_robomimic, write_zarr

TOTAL = sum(LENGTHS)


def tasks(target):
    dataset = LeRobotDataset("local/dst", target)
    return [dataset[int(e["dataset_from_index"])]["task"] for e in dataset.meta.episodes]


# --- robomimic


def test_robomimic_takes_the_actions_that_are_asked_for(tmp_path, target, capsys):
    source = tmp_path / "lift.hdf5"
    write_robomimic(source, images=False)
    absolute = [numbers(50 + i, n, 7) for i, n in enumerate(LENGTHS)]
    with h5py.File(source, "a") as file:
        for i, values in enumerate(absolute):
            file[f"data/demo_{i}/actions_abs"] = values
            file[f"data/demo_{i}/action_dict/abs_pos"] = values[:, :3]
    assert convert("robomimic", source, target, "--action_keys=[actions_abs]") == 0
    err = capsys.readouterr().err
    assert "action_dict/abs_pos" in err
    assert " actions," in err
    np.testing.assert_array_equal(column(target, "action"), np.concatenate(absolute).astype(np.float32))
    assert LeRobotDataset("local/dst", target).meta.features["action"]["names"][0] == "action.0"


def test_robomimic_names_the_actions_there_are(tmp_path, target, capsys):
    write_robomimic(tmp_path / "lift.hdf5", images=False)
    said = refusal(capsys, "robomimic", tmp_path / "lift.hdf5", target, "--action_keys=[action_abs]")
    assert "array in --action_keys 'action_abs'" in said
    assert "actions" in said


@pytest.mark.parametrize(
    ("where", "name", "value"),
    [
        ("demo", "ep_meta", json.dumps({"lang": "pick the mug", "layout_id": 3})),
        ("demo", "language_instruction", b"pick the mug"),
        ("data", "problem_info", json.dumps({"language_instruction": ['"pick the mug"']})),
    ],
)
def test_robomimic_language_becomes_the_task(tmp_path, target, where, name, value):
    source = tmp_path / "lift.hdf5"
    write_robomimic(source, images=False)
    with h5py.File(source, "a") as file:
        place = file["data"] if where == "data" else file["data/demo_1"]
        place.attrs[name] = value
    assert convert("robomimic", source, target) == 0
    expected = ["pick the mug"] * len(LENGTHS) if where == "data" else ["Lift", "pick the mug", "Lift"][: len(LENGTHS)]
    assert tasks(target) == expected


def test_robomimic_names_what_only_some_demonstrations_have(tmp_path, target, capsys):
    source = tmp_path / "lift.hdf5"
    write_robomimic(source, images=False)
    with h5py.File(source, "a") as file:
        file["data/demo_1/obs/wrist_image"] = np.stack([picture(t) for t in range(LENGTHS[1])])
    assert convert("robomimic", source, target, "--rewards=false") == 0
    err = capsys.readouterr().err
    assert f"only in some episodes: obs/wrist_image (1 of {len(LENGTHS)} episodes)" in err
    assert "dones" in err
    assert "rewards" in err


# --- ALOHA


def test_aloha_with_language_depth_a_late_camera_and_files_beside(tmp_path, target, capsys):
    folder = tmp_path / "in"
    write_aloha(folder)
    said = [b"fold the shirt", b"open the box"]
    for i, text in enumerate(said):
        with h5py.File(folder / f"episode_{i}.hdf5", "a") as file:
            file["language_raw"] = np.array([text])
            file["observations/images_depth/cam_high"] = np.zeros((LENGTHS[i], 4, 4), np.uint16)
            if i == 1:
                file["observations/images/cam_late"] = np.stack([picture(t) for t in range(LENGTHS[i])])
    (folder / "notes.txt").write_text("gripper was loose")
    (folder / "trial_7.hdf5").write_bytes(b"")
    assert convert("aloha", folder, target, NONE) == 0
    err = capsys.readouterr().err
    for part in ("observations/images_depth/cam_high", "cam_late (1 of", "notes.txt, trial_7.hdf5"):
        assert part in err, part
    assert tasks(target)[:2] == ["fold the shirt", "open the box"]


def test_aloha_other_arrays_can_be_the_action(tmp_path, target):
    expected = write_aloha(tmp_path / "in", base=True)
    assert convert("aloha", tmp_path / "in", target, NONE, "--action_keys=[action, base_action]") == 0
    both = np.concatenate([np.c_[e["action"], e["base_action"]] for e in expected]).astype(np.float32)
    np.testing.assert_array_equal(column(target, "action"), both)


# --- Zarr


def umi(path, hands=1):
    """A buffer as UMI writes it: poses, gripper widths and a camera for each hand, no action."""
    import zarr

    root = zarr.open_group(str(path), mode="w", zarr_format=2)
    data = {}
    for hand in range(hands):
        data[f"robot{hand}_eef_pos"] = numbers(hand, TOTAL, 3).astype(np.float32)
        data[f"robot{hand}_eef_rot_axis_angle"] = numbers(hand + 10, TOTAL, 3).astype(np.float32)
        data[f"robot{hand}_gripper_width"] = numbers(hand + 20, TOTAL, 1).astype(np.float32)
        data[f"robot{hand}_demo_start_pose"] = numbers(hand + 30, TOTAL, 6)
        data[f"camera{hand}_rgb"] = np.stack([picture(t) for t in range(TOTAL)])
    for key, values in data.items():
        root.create_group("data", overwrite=False) if "data" not in root else None
        root["data"].create_array(key, data=values, chunks=(3, *values.shape[1:]))
    root.create_group("meta").create_array("episode_ends", data=np.cumsum(LENGTHS))
    return data


@pytest.mark.parametrize("hands", [1, 2])
def test_umi_without_actions_acts_by_where_the_hand_is_next(tmp_path, target, capsys, hands):
    data = umi(tmp_path / "in.zarr", hands)
    assert convert("diffusion_policy", tmp_path / "in.zarr", target, "--fps=10") == 0
    assert "There is no action: it is the next step's robot0_eef_pos" in capsys.readouterr().err
    parts = [f"robot{h}_{p}" for h in range(hands) for p in ("eef_pos", "eef_rot_axis_angle", "gripper_width")]
    state = np.concatenate([data[key] for key in parts], axis=1)
    np.testing.assert_array_equal(column(target, "observation.state"), state)
    ends = np.cumsum(LENGTHS) - 1
    following = np.minimum(np.arange(TOTAL) + 1, ends[np.searchsorted(ends, np.arange(TOTAL))])
    np.testing.assert_array_equal(column(target, "action"), state[following])


def test_zarr_actions_by_name_and_what_is_beside(tmp_path, target, capsys):
    import zarr

    values = write_zarr(tmp_path / "in.zarr")
    root = zarr.open_group(str(tmp_path / "in.zarr"), mode="a")
    root["meta"].create_array("notes", data=np.arange(3))
    assert (
        convert("diffusion_policy", tmp_path / "in.zarr", target, "--fps=10", NONE, "--action_keys=[n_contacts]") == 0
    )
    err = capsys.readouterr().err
    assert "meta/notes" in err
    assert "data/action" in err  # its name is taken
    np.testing.assert_array_equal(column(target, "action").reshape(-1), values["n_contacts"].reshape(-1))


def test_zarr_without_any_action_says_how_to_name_one(tmp_path, target, capsys):
    import shutil

    write_zarr(tmp_path / "in.zarr")
    shutil.rmtree(tmp_path / "in.zarr/data/action")
    said = refusal(capsys, "diffusion_policy", tmp_path / "in.zarr", target, "--fps=10")
    assert "--action_keys=" in said


def test_a_choice_of_actions_is_refused_where_there_is_none(tmp_path, target, capsys):
    write_npz(tmp_path / "in")
    assert "--from=npz has one action" in refusal(
        capsys, "npz", tmp_path / "in", target, "--fps=5", "--action_keys=[a]"
    )
