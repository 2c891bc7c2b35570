"""`cqn-data convert`: LeRobot's own older format, and what holds for every format."""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.cli import main

from ..conversions import (
    LOSSLESS,
    column,
    convert,
    history,
    logs_fixture,  # noqa: F401
    refusal,
    snapshot,
    target_fixture,  # noqa: F401
)
from ..foreign_formats import (
    write_lerobot_v21,
    write_npz,
)

REAL_V21 = Path(__file__).parents[3] / "shared/data/g1_teleop_v21"

# --- LeRobot v2.1


def test_lerobot_v21_without_touching_the_source(tmp_path, target, capfd):
    source = tmp_path / "old"
    states = write_lerobot_v21(source)
    before = snapshot(source)
    assert convert("lerobot_v21", source, target) == 0
    out, err = capfd.readouterr()
    assert "it/s" not in out + err
    assert snapshot(source) == before
    dataset = LeRobotDataset("local/dst", target)
    assert (dataset.num_episodes, dataset.num_frames, dataset[0]["task"]) == (2, 9, "wave")
    np.testing.assert_array_equal(column(target, "observation.state"), np.concatenate(states))
    assert sorted(p.name for p in target.iterdir()) == ["LICENSE", "data", "meta"]
    assert history(target)["format"] == "lerobot_v21"


def test_lerobot_v21_refusals(tmp_path, target, capsys):
    source = tmp_path / "old"
    write_lerobot_v21(source)
    assert "leave out --task, --video" in refusal(capsys, "lerobot_v21", source, target, "--video=false", "--task=x")
    (source / "meta/episodes_stats.jsonl").write_text("{}\n")
    assert "by LeRobot's converter" in refusal(capsys, "lerobot_v21", source, target)
    (source / "data/chunk-000/episode_000001.parquet").unlink()
    assert "episode_000001.parquet is missing" in refusal(capsys, "lerobot_v21", source, target)
    info = json.loads((source / "meta/info.json").read_text())
    for version, words in (("v3.0", "nothing to convert"), ("v2.0", "format v2.0, expected v2.1")):
        (source / "meta/info.json").write_text(json.dumps(info | {"codebase_version": version}))
        assert words in refusal(capsys, "lerobot_v21", source, target)
    (source / "meta/info.json").write_text("{")
    assert "info.json cannot be read" in refusal(capsys, "lerobot_v21", source, target)
    (source / "meta/info.json").unlink()
    assert "info.json is missing" in refusal(capsys, "lerobot_v21", source, target)


@pytest.mark.skipif(not REAL_V21.is_dir(), reason="the real recording is not there")
def test_a_real_v21_recording(target):
    before = snapshot(REAL_V21)
    assert convert("lerobot_v21", REAL_V21, target) == 0
    assert snapshot(REAL_V21) == before
    dataset = LeRobotDataset("local/dst", target)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (5, 1529, 30)
    old = [pd.read_parquet(p) for p in sorted(REAL_V21.glob("data/*/*.parquet"))]
    for key in ("observation.state", "action"):
        np.testing.assert_array_equal(column(target, key), np.concatenate([np.stack(t[key]) for t in old]))
    assert dataset[1528]["observation.images.cam_high"].shape == (3, 480, 640)


# --- All formats


def test_dry_run_lists_and_writes_nothing(tmp_path, target, capsys):
    write_npz(tmp_path / "takes", fps=30)
    assert convert("npz", tmp_path / "takes", target, "--dry_run") == 0
    out = capsys.readouterr().out
    for part in ("take_9.npz", "observation.state float32 3", "next.success bool 1", "observation.images.side video"):
        assert part in out
    assert "nothing was written" in out
    assert not target.parent.exists()


def test_mistakes_are_told_before_anything_is_read(tmp_path, target, capsys):
    write_npz(tmp_path / "takes", fps=30)
    assert "Did you mean 'aloha'?" in refusal(capsys, "alohaa", tmp_path, target)
    assert "Nothing found at --input" in refusal(capsys, "npz", tmp_path / "no", target)
    assert "--fps >= 1" in refusal(capsys, "npz", tmp_path / "takes", target, "--fps=0")
    assert main(["convert", "--input=x", "--new_repo_id=a/b"]) == 2
    assert "Missing --from=" in capsys.readouterr().err
    inside = tmp_path / "takes/new"
    assert "lies inside the source" in refusal(capsys, "npz", tmp_path / "takes", inside)
    target.mkdir(parents=True)
    assert convert("npz", tmp_path / "takes", target) == 2
    assert "exists already" in capsys.readouterr().err
    assert list(target.iterdir()) == []
    assert main(["convert", "--help"]) == 0
    text = capsys.readouterr().out
    assert "--from\n" in text
    assert "from_" not in text


@pytest.mark.parametrize(("package", "kind"), [("h5py", "robomimic"), ("zarr", "diffusion_policy")])
def test_a_missing_package_is_named_with_its_remedy(tmp_path, target, capsys, monkeypatch, package, kind):
    (tmp_path / "in").mkdir()
    monkeypatch.setitem(sys.modules, package, None)
    text = refusal(capsys, kind, tmp_path / "in", target, "--fps=10")
    assert f"needs {package}, which cannot be imported" in text
    assert text.endswith("pip install 'lerobot_policy_cqn[convert]'.")


def test_a_failure_while_writing_leaves_nothing(tmp_path, target, capsys, monkeypatch):
    from cqn_data.disk.target import Target

    write_npz(tmp_path / "takes", fps=30)
    saved = Target.save_episode

    def fail(self):
        if self.episodes:
            raise OSError("disk full")
        saved(self)

    monkeypatch.setattr(Target, "save_episode", fail)
    for options in ([], ["--skip_bad_episodes"]):  # not the fault of the episode, so never passed over
        text = refusal(capsys, "npz", tmp_path / "takes", target, *options)
        assert "disk full" in text
        assert list(target.parent.iterdir()) == []


def test_pictures_too_small_for_video_are_refused(tmp_path, target, capsys):
    write_npz(tmp_path / "takes", fps=30, side_image=np.zeros((5, 24, 40, 3), np.uint8), lengths=(5,))
    text = refusal(capsys, "npz", tmp_path / "takes", target)
    assert "'observation.images.side' has 24x40 pixels, too few for video" in text
    assert convert("npz", tmp_path / "takes", target, LOSSLESS) == 0


def test_episodes_of_other_shapes_do_not_mix(tmp_path, target, capsys):
    write_npz(tmp_path / "takes", fps=30, lengths=(3,))
    write_npz(tmp_path / "wider", fps=30, lengths=(3,), **{"observation.state": np.zeros((3, 4), np.float32)})
    (tmp_path / "wider/take_9.npz").rename(tmp_path / "takes/take_20.npz")
    text = refusal(capsys, "npz", tmp_path / "takes", target)
    assert "take_20.npz: expected 'observation.state' of shape (3,), as in the first episode, found (4,)" in text
