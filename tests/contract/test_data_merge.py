"""`cqn-data merge`: rows and pictures of all, in order; and what does not belong together is refused by name."""

import json
import shutil

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.cli import main
from cqn_data.disk.source import open_source

from .columns import ACTION, STATE, edit_info, edit_rows
from .data_recording import LENGTHS, TOP, column, history, last_line, run, what


def merge(sources, target, *options, code=0):
    names = ", ".join(f"local/part{i}" for i in range(len(sources)))
    given = [f"--repo_ids=[{names}]", f"--roots=[{', '.join(map(str, sources))}]"]
    assert main(["merge", *given, "--new_repo_id=local/all", f"--new_root={target}", *options]) == code


@pytest.fixture
def other(recording, tmp_path):
    return shutil.copytree(recording, tmp_path / "other")


def test_rows_and_pictures_of_all_are_there_in_order(recording, tmp_path):
    run("drop", recording, tmp_path / "two", "--episodes=[0]")
    run("drop", recording, tmp_path / "one", "--episodes=[1, 2]")
    merge([tmp_path / "two", tmp_path / "one"], tmp_path / "all")
    done = LeRobotDataset("local/all", tmp_path / "all")
    assert [int(e["length"]) for e in done.meta.episodes] == [LENGTHS[1], LENGTHS[2], LENGTHS[0]]
    for key in (STATE, ACTION):
        parts = np.concatenate([column(tmp_path / name, key) for name in ("two", "one")])
        np.testing.assert_array_equal(column(tmp_path / "all", key), parts)
    expected = [(e, f) for e in (1, 2, 0) for f in range(LENGTHS[e])]
    for place in (0, 11, 12, 42, 43, 62):
        episode, frame = expected[place]
        assert what(done[place][TOP]) == (frame, episode)
    (entry,) = history(tmp_path / "all")
    assert [(p["source"], p["episodes"]) for p in entry["sources"]] == [("local/part0", 2), ("local/part1", 1)]


def test_differences_stay_differences(recording, tmp_path):
    for name in ("a", "b"):
        run("delta", recording, tmp_path / name)
    merge([tmp_path / "a", tmp_path / "b"], tmp_path / "all")
    assert open_source("local/all", str(tmp_path / "all")).deltas == open_source("local/a", str(tmp_path / "a")).deltas
    run("delta", tmp_path / "all", tmp_path / "back", "--to=absolute")
    absolute = np.concatenate([column(recording, ACTION)] * 2)
    np.testing.assert_allclose(column(tmp_path / "back", ACTION), absolute, atol=1e-6)


def names(root):
    edit_info(root, lambda info: info["features"][STATE].update(names=["lift.pos", "pan.pos", "gripper.pos"]))


def rate(root):
    edit_info(root, lambda info: info.update(fps=15))
    edit_rows(root, lambda c: c.update(timestamp=[t * 2 for t in c["timestamp"]]))


def robot(root):
    edit_info(root, lambda info: info.update(robot_type="another"))


def degrees(root):
    edit_rows(root, lambda c: c.update({STATE: [np.degrees(v).astype(np.float32) for v in c[STATE]]}))


def no_video(root):
    next((root / "videos").rglob("*.mp4")).unlink()


def moved(root):
    edit_rows(root, lambda c: c.update(timestamp=[t + 0.4 for t in c["timestamp"]]))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (names, "names"), (rate, "frames a second 30"), (robot, "the robot"), (degrees, "look like other units"),
        (no_video, "is missing"), (moved, "no picture at"),
    ],
)  # fmt: skip
def test_what_does_not_belong_together_is_refused(recording, other, tmp_path, capsys, change, said):
    change(other)
    merge([recording, other], tmp_path / "all", code=2)
    line = last_line(capsys)
    assert said in line
    assert str(other) in line
    assert not (tmp_path / "all").exists()


def test_goals_and_differences_are_not_put_together(recording, tmp_path, capsys):
    run("delta", recording, tmp_path / "delta")
    merge([recording, tmp_path / "delta"], tmp_path / "all", code=2)
    assert "actions that are absolute" in last_line(capsys)


def test_the_same_dataset_twice_and_one_alone_are_refused(recording, tmp_path, capsys):
    merge([recording, recording], tmp_path / "all", code=2)
    assert "named twice" in last_line(capsys)
    merge([recording], tmp_path / "all", code=2)
    assert "at least two" in last_line(capsys)


def test_a_dry_run_only_looks(recording, other, tmp_path, capsys):
    merge([recording, other], tmp_path / "all", "--dry_run")
    assert "Dry run" in capsys.readouterr().out
    assert not (tmp_path / "all").exists()


def test_a_merge_leaves_its_sources_alone(recording, other, tmp_path):
    before = {p: p.read_bytes() for p in recording.rglob("*") if p.is_file()}
    merge([recording, other], tmp_path / "all")
    assert before == {p: p.read_bytes() for p in recording.rglob("*") if p.is_file()}
    assert json.loads((tmp_path / "all/meta/info.json").read_text())["total_frames"] == 2 * sum(LENGTHS)
