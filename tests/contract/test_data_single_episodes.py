"""Options for single episodes: their own cuts, thresholds and tasks; the other episodes stay as without them."""

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from .data_recording import LENGTHS, column, history, last_line, run, videos


def rows(root, episode):
    """Frames of the recording that are left of an episode."""
    source, frame = (column(root, f"source.{name}_index").reshape(-1) for name in ("episode", "frame"))
    return frame[source == episode].tolist()


def test_cuts_of_single_episodes_replace_those_of_all(recording, tmp_path):
    run("trim", recording, tmp_path / "cut", '--cuts={"1": [2, 3], "2": [0, 4]}', "--head=1")
    assert rows(tmp_path / "cut", 0) == list(range(1, LENGTHS[0]))
    assert rows(tmp_path / "cut", 1) == list(range(2, LENGTHS[1] - 3))
    assert rows(tmp_path / "cut", 2) == list(range(LENGTHS[2] - 4))


def test_rewards_are_cut_off_only_where_that_is_asked_for(recording, tmp_path, capsys):
    run("label", recording, tmp_path / "labelled", "--all")
    run("trim", tmp_path / "labelled", tmp_path / "no", '--cuts={"1": [0, 2]}', code=2)
    assert "Episode 1, frame 11 carries a reward" in last_line(capsys)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("steps:\n- trim: {cuts: {1: [0, 2]}, cut_rewards: true}\n- label: {all: true}\n")
    run("run", tmp_path / "labelled", tmp_path / "done", recipe=[str(recipe)])
    ends = np.cumsum([LENGTHS[0], LENGTHS[1] - 2, LENGTHS[2]]) - 1
    assert np.flatnonzero(column(tmp_path / "done", "next.reward").reshape(-1)).tolist() == ends.tolist()


def test_a_threshold_of_one_episode_leaves_the_others_alone(recording, tmp_path):
    for name, option in (
        ("all", []),
        ("own", ['--episode_thresholds={"1": 0.15}']),
        ("keep", ['--episode_thresholds={"1": 0}']),
    ):
        run("filter", recording, tmp_path / name, "--threshold=0.02", *option)
    run("filter", recording, tmp_path / "coarse", "--threshold=0.15", "--gripper_threshold=0.02")
    for name in ("own", "keep"):
        assert [rows(tmp_path / name, i) for i in (0, 2)] == [rows(tmp_path / "all", i) for i in (0, 2)]
    assert rows(tmp_path / "keep", 1) == list(range(LENGTHS[1]))
    assert rows(tmp_path / "own", 1) == rows(tmp_path / "coarse", 1) != rows(tmp_path / "all", 1)


def test_tasks_are_those_that_lerobot_reads_and_videos_stay(recording, tmp_path):
    done = run("task", recording, tmp_path / "named", '--episode_tasks={"1": "Put it down."}')
    ends = [int(done.meta.episodes[i]["dataset_to_index"]) - 1 for i in range(3)]
    assert [done[end]["task"] for end in ends] == ["go", "Put it down.", "go"]
    assert [list(done.meta.episodes[i]["tasks"]) for i in range(3)] == [["go"], ["Put it down."], ["go"]]
    assert (done.meta.total_tasks, list(done.meta.tasks.index)) == (2, ["go", "Put it down."])
    assert videos(recording) == videos(tmp_path / "named")
    assert "'Put it down.' of episode 1" in history(tmp_path / "named")[-1]["told"]
    everything = run("task", tmp_path / "named", tmp_path / "one", "--new_task=Press it.")
    assert list(everything.meta.tasks.index) == ["Press it."]
    assert pd.read_parquet(next((tmp_path / "one/data").rglob("*.parquet")))["task_index"].unique().tolist() == [0]


def test_tasks_reach_pictures_that_are_encoded_anew(recording, tmp_path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("steps:\n- task: {episode_tasks: {2: Lift it.}}\n- resize: {size: [32, 32]}\n")
    run("run", recording, tmp_path / "done", recipe=[str(recipe)])
    done = LeRobotDataset("local/dst", tmp_path / "done")
    assert sorted(done.meta.tasks.index) == ["Lift it.", "go"]
    assert done[len(done) - 1]["task"] == "Lift it."


@pytest.mark.parametrize(
    ("operation", "option", "said"),
    [
        ("trim", '--cuts={"7": [1, 1]}', "No episode 7: expected numbers from 0 to 2"),
        ("trim", '--cuts={"1": [1]}', "Expected --cuts of [start, end]"),
        ("trim", '--cuts={"1": [-1, 0]}', "both >= 0"),
        ("trim", '--cuts={"1": [6, 6]}', "Only 0 of 12 steps would be left of episode 1"),
        ("filter", '--episode_thresholds={"3": 0.1}', "No episode 3"),
        ("filter", '--episode_thresholds={"1": -1}', "Expected a finite --episode_thresholds"),
        ("task", '--episode_tasks={"5": "x"}', "No episode 5"),
        ("task", "--new_task= ", "No task: expected --new_task"),
        ("task", '--new_task="two\\nlines"', "Expected a task of one line"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(recording, tmp_path, capsys, operation, option, said):
    run(operation, recording, tmp_path / "no", option, code=2)
    assert said in last_line(capsys)
    assert not (tmp_path / "no").exists()
