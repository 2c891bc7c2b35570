"""`cqn-data filter` on small datasets written by LeRobot: what comes out, and what must never happen."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.cli import main

FPS = 10
STILL = {3, 4, 5, 9}  # steps that lead nowhere
STATE = {"dtype": "float32", "shape": (3,), "names": ["a.pos", "b.pos", "gripper.pos"]}
SCALAR = {"dtype": "float32", "shape": (1,), "names": None}


def write(root, episodes=2, steps=14, still=STILL, extra=None, values=None, spoil=None):
    """A dataset with delta actions; ``values(episode, step)`` gives further columns declared in ``extra``."""
    features = {"observation.state": STATE, "action": STATE, **(extra or {})}
    encoder = RGBEncoderConfig(vcodec="h264", crf=5, g=2)
    dataset = LeRobotDataset.create("local/src", FPS, features, root=root, robot_type="toy", rgb_encoder=encoder)
    for episode in range(episodes):
        state = np.zeros(3, np.float32)
        for step in range(steps):
            delta = np.array([0.0 if step in still else 0.1 + 0.01 * episode, 0, 0], np.float32)
            frame = {"observation.state": state.copy(), "action": delta.copy(), "task": f"task {episode % 2}"}
            frame |= values(episode, step) if values else {}
            if spoil == (episode, step):
                frame["action"][1] = np.nan
            dataset.add_frame(frame)
            state = state + delta
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


def run(source, target, *options):
    """Filter with the command line and return its exit code."""
    names = ["--repo_id=local/src", f"--root={source}", "--new_repo_id=local/dst", f"--new_root={target}"]
    return main(["filter", *names, *options])


def rows(root):
    files = sorted((root / "data").glob("*/*.parquet"))
    return pd.concat([pd.read_parquet(f) for f in files]).reset_index(drop=True)


def snapshot(root):
    """Content and time of every file, to see that nothing was touched."""
    return {str(p): (p.stat().st_mtime_ns, p.read_bytes()) for p in sorted(root.rglob("*")) if p.is_file()}


def one_line(capsys):
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if "error:" in line]
    assert len(lines) == 1, err
    assert "Traceback" not in out + err
    return lines[0]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return write(tmp_path_factory.mktemp("plain") / "src")


@pytest.fixture
def target(tmp_path):
    """Where to write; at the end there may be a dataset or nothing, but no half one."""
    yield tmp_path / "dst"
    assert [p for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_result_is_a_dataset_with_right_times_indices_rewards_and_statistics(plain, target, capsys, tmp_path):
    before = snapshot(plain)
    report = tmp_path / "report.json"
    assert run(plain, target, f"--report={report}") == 0
    assert snapshot(plain) == before
    dataset = LeRobotDataset("local/dst", target)
    kept = [s for s in range(14) if s not in STILL]
    table, old = rows(target), rows(plain)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 2 * len(kept), FPS)
    assert dataset.meta.robot_type == "toy"
    assert table["index"].tolist() == list(range(2 * len(kept)))
    assert table["frame_index"].tolist() == [*range(len(kept))] * 2
    np.testing.assert_allclose(table["timestamp"], table["frame_index"] / FPS, atol=1e-6)
    assert table["source.frame_index"].tolist() == kept * 2
    assert table["source.episode_index"].tolist() == [0] * len(kept) + [1] * len(kept)
    for key in ("observation.state", "action"):
        expected = np.stack(old[key])[old["frame_index"].isin(kept)]
        np.testing.assert_array_equal(np.stack(table[key]), expected)
        stats = dataset.meta.stats[key]
        np.testing.assert_allclose(stats["mean"], expected.mean(0), atol=1e-5)
        np.testing.assert_allclose(stats["std"], expected.std(0), atol=1e-5)
        np.testing.assert_allclose(stats["min"], expected.min(0), atol=1e-6)
        np.testing.assert_allclose(stats["max"], expected.max(0), atol=1e-6)
        assert stats["count"].tolist() == [2 * len(kept)]
    assert "next.reward" not in table
    assert [dataset[i]["task"] for i in (0, len(kept))] == ["task 0", "task 1"]
    assert [e["length"] for e in dataset.meta.episodes] == [len(kept)] * 2
    [entry] = json.loads(report.read_text())
    assert entry == json.loads((target / "meta/cqn_history.json").read_text())["operations"][-1]
    assert entry["total"] == {"episodes": 2, "steps": 28, "kept": 20, "share": 0.2857}
    assert entry["episodes"][1]["pauses"] == [{"start": 3, "length": 3}, {"start": 9, "length": 1}]
    assert str(plain) not in json.dumps(entry)


def test_filtering_twice_changes_nothing_and_still_points_at_the_first_recording(plain, target, tmp_path):
    assert run(plain, target) == 0
    assert main(["filter", "--repo_id=local/dst", f"--root={target}", f"--new_root={tmp_path / 'again'}"]) == 0
    pd.testing.assert_frame_equal(rows(target), rows(tmp_path / "again"))
    assert len(json.loads((tmp_path / "again/meta/cqn_history.json").read_text())["operations"]) == 2


def test_unknown_columns_survive_and_rewards_are_never_lost(tmp_path, target):
    extra = {
        "next.reward": SCALAR,
        "next.done": {**SCALAR, "dtype": "bool"},
        "force": {"dtype": "float64", "shape": (2, 2), "names": None},
        "phase": {"dtype": "string", "shape": (1,), "names": None},
        "observation.images.still": {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]},
    }

    def values(episode, step):
        return {
            "next.reward": np.array([0.5 if step == 4 else 0.0], np.float32),
            "next.done": np.array([step == 13]),
            "force": np.full((2, 2), step, np.float64),
            "phase": f"phase {step}",
            "observation.images.still": np.full((8, 8, 3), step * 10, np.uint8),
        }

    source = write(tmp_path / "src", extra=extra, values=values)
    assert run(source, target) == 0
    table, old = rows(target), rows(source)
    kept = [s for s in range(14) if s not in STILL or s == 4]
    assert table["source.frame_index"].tolist() == kept * 2
    assert table["next.reward"].sum() == old["next.reward"].sum() == 1.0
    assert "next.success" not in table
    assert table["phase"].tolist() == [f"phase {s}" for s in kept] * 2
    dataset = LeRobotDataset("local/dst", target)
    assert dataset[2]["force"].tolist() == [[2.0, 2.0], [2.0, 2.0]]
    pictures = [round(float(dataset[i]["observation.images.still"].mean()) * 25.5) for i in range(len(kept))]
    assert pictures == kept


def test_recorded_failures_are_not_turned_into_successes(tmp_path, target):
    extra = {"next.success": {**SCALAR, "dtype": "bool"}}
    source = write(tmp_path / "src", extra=extra, values=lambda *_: {"next.success": np.array([False])})
    assert run(source, target) == 0
    assert not rows(target)["next.success"].any()


def test_video_keeps_the_right_pictures_and_their_statistics(tmp_path, target):
    camera = {"dtype": "video", "shape": (32, 32, 3), "names": ["height", "width", "channels"]}

    def values(episode, step):
        return {"observation.images.top": np.full((32, 32, 3), 10 + 15 * step + 5 * episode, np.uint8)}

    source = write(tmp_path / "src", extra={"observation.images.top": camera}, values=values)
    assert run(source, target) == 0
    dataset = LeRobotDataset("local/dst", target)
    seen = np.array([float(dataset[i]["observation.images.top"].mean()) for i in range(len(dataset))]) * 255
    table = rows(target)
    expected = 10 + 15 * table["source.frame_index"] + 5 * table["source.episode_index"]
    assert np.abs(seen - expected).max() < 3
    stats = dataset.meta.stats["observation.images.top"]
    assert stats["mean"].shape == (3, 1, 1)
    np.testing.assert_allclose(stats["mean"].ravel() * 255, expected.mean(), atol=3)
    np.testing.assert_allclose(stats["max"].ravel() * 255, expected.max(), atol=4)
    assert not (target / "images").exists()
    next((source / "videos").rglob("*.mp4")).unlink()
    assert run(source, tmp_path / "other") == 2


def test_missing_video_is_named_but_a_dry_run_needs_none(tmp_path, target, capsys):
    camera = {"dtype": "video", "shape": (32, 32, 3), "names": ["height", "width", "channels"]}
    picture = np.zeros((32, 32, 3), np.uint8)
    source = write(
        tmp_path / "src",
        1,
        8,
        extra={"observation.images.top": camera},
        values=lambda *_: {"observation.images.top": picture},
    )
    video = next((source / "videos").rglob("*.mp4"))
    video.write_bytes(b"not a video")
    assert run(source, target) == 2
    assert str(video) in one_line(capsys)
    video.unlink()
    assert run(source, target) == 2
    assert f"Video file {video} of episode 0 is missing" in one_line(capsys)
    assert run(source, target, "--dry_run") == 0
    assert "Dry run: nothing was written." in capsys.readouterr().out
    assert not target.exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (['--joint_thresholds={"a.po": 1}'], "Did you mean 'a.pos'?"),
        (['--joint_thresholds={"gripper.pos": 1}'], "Unknown joint"),
        (['--gripper_names=["griper.pos"]'], "Did you mean 'gripper.pos'?"),
        (["--threshold=5"], "Too little would be left of episode 0 (1 of 14), 1 (1 of 14)"),
    ],
)
def test_settings_that_do_not_fit_the_dataset(plain, target, capsys, options, said):
    assert run(plain, target, *options) == 2
    assert said in one_line(capsys)
    assert not target.exists()


def test_damaged_sources(tmp_path, target, capsys):
    assert run(tmp_path / "nowhere", target) == 2
    assert "meta/info.json not found" in one_line(capsys)
    assert not (tmp_path / "nowhere").exists()
    assert run(write(tmp_path / "nan", spoil=(1, 6)), target) == 2
    assert "Episode 1, frame 6: 'action' is not finite" in one_line(capsys)
    LeRobotDataset.create("local/src", FPS, {"observation.state": STATE, "action": STATE}, root=tmp_path / "empty")
    assert run(tmp_path / "empty", target) == 2
    assert "holds no episodes" in one_line(capsys)
    cut = write(tmp_path / "cut", 1)
    parquet = next((cut / "data").rglob("*.parquet"))
    parquet.write_bytes(parquet.read_bytes()[:-200])
    assert run(cut, target) == 2
    assert "cannot be read" in one_line(capsys)
    (cut / "meta/info.json").write_text("{")
    assert run(cut, target) == 2
    assert "info.json is damaged" in one_line(capsys)
    (cut / "meta/info.json").write_text('{"codebase_version": "v2.1", "total_episodes": 1, "total_frames": 1}')
    assert run(cut, target) == 2
    assert "cqn-data convert --from=lerobot_v21" in one_line(capsys)
    assert not target.exists()


def test_nothing_is_overwritten_or_put_into_the_source(plain, tmp_path, capsys):
    (tmp_path / "there").mkdir()
    assert run(plain, tmp_path / "there") == 2
    assert "exists already" in one_line(capsys)
    assert run(plain, plain) == 2
    assert "exists already" in one_line(capsys)
    assert run(plain, plain / "inside") == 2
    assert "inside the source" in one_line(capsys)
    (tmp_path / "report.json").write_text("mine")
    assert run(plain, tmp_path / "dst", f"--report={tmp_path / 'report.json'}") == 2
    assert (tmp_path / "report.json").read_text() == "mine"
    assert not (tmp_path / "dst").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_leaves_no_dataset_and_no_rest(plain, target, capsys, monkeypatch, number):
    original = LeRobotDataset.save_episode

    def save(self, *args, **kwargs):
        original(self, *args, **kwargs)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(LeRobotDataset, "save_episode", save)
    assert run(plain, target) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert not target.exists()


def test_a_failing_disk_leaves_nothing_and_says_so_in_one_line(plain, target, capsys, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(LeRobotDataset, "save_episode", full)
    assert run(plain, target) == 2
    said = one_line(capsys)
    assert "could not be written and nothing is left of it" in said
    assert "No space left on device" in said
    assert not target.exists()


RECORDINGS = Path(__file__).parents[3] / "shared" / "data"


@pytest.mark.skipif(not (RECORDINGS / "so101_recording").is_dir(), reason="no real recordings here")
def test_real_recording_without_its_videos(target, capsys, tmp_path):
    root = RECORDINGS / "so101_recording"
    before = {p: p.stat().st_mtime_ns for p in root.rglob("*")}
    names = ["--repo_id=local/so101", f"--root={root}", f"--new_root={target}", "--threshold=0.5"]
    report = tmp_path / "report.json"
    assert main(["filter", *names, "--dry_run", f"--report={report}"]) == 0
    assert [0.1 < e["share"] < 0.8 for e in json.loads(report.read_text())[0]["episodes"]] == [True] * 4
    capsys.readouterr()
    assert main(["filter", *names]) == 2
    assert "is missing" in one_line(capsys)
    assert before == {p: p.stat().st_mtime_ns for p in root.rglob("*")}
