"""Tables in odd states: tasks, rows and files out of order, tables beside them, episodes of one frame, NaN."""

import shutil

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.decisions.rewards import last_step_rewards
from cqn_data.disk.columns import places

from .columns import ACTION, STATE, TOP, edit_info, edit_rows, edit_table, grey, moving, write_columns
from .data_recording import column, last_line, run
from .test_data_inspect import inspect

STEPS, TASKS = 12, ("pick", "place", "wipe")
OPERATIONS = [["label", "--all"], ["trim", "--head=2"], ["resize", "--size=[32,32]"]]


def episodes(steps=(STEPS,) * 3):
    return [
        {STATE: moving(n, seed=s), ACTION: moving(n, seed=s) + 1, TOP: grey(n, start=20 + 60 * s)}
        for s, n in enumerate(steps)
    ]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write_columns(tmp_path_factory.mktemp("tables") / "src", episodes(), tasks=TASKS)


def files_of_one_episode(root):
    """The recording in a data file for each episode."""
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    for number in range(3):
        rows = table.filter(pa.compute.equal(table["episode_index"], number))
        pq.write_table(rows, path.with_name(f"file-{number:03d}.parquet"))
    edit_meta(root, lambda columns: columns.update({"data/file_index": [0, 1, 2]}))


def edit_meta(root, change):
    for path in (root / "meta/episodes").rglob("*.parquet"):
        edit_table(path, change)


def tasks(root, numbers):
    frame = pd.DataFrame({"task_index": list(numbers.values())}, index=pd.Index(list(numbers), name="task"))
    frame.to_parquet(root / "meta/tasks.parquet")


def tasks_reversed(root):
    tasks(root, {"wipe": 2, "place": 1, "pick": 0})


def tasks_with_gaps(root):
    tasks(root, {"place": 11, "pick": 7, "wipe": 40})
    edit_rows(root, lambda c: c.update(task_index=[{0: 7, 1: 11, 2: 40}[n] for n in c["task_index"]]))


def numbers_from_100(root):
    edit_rows(root, lambda c: c.update(index=[n + 100 for n in c["index"]]))


def places_from_100(root):
    numbers_from_100(root)
    ends = ("dataset_from_index", "dataset_to_index")
    edit_meta(root, lambda c: c.update({end: [n + 100 for n in c[end]] for end in ends}))


def files_out_of_order(root):
    files_of_one_episode(root)
    folder = next((root / "data").rglob("*.parquet")).parent
    (folder / "file-000.parquet").rename(folder / "x")
    (folder / "file-002.parquet").rename(folder / "file-000.parquet")
    (folder / "x").rename(folder / "file-002.parquet")
    edit_meta(root, lambda c: c.update({"data/file_index": [2, 1, 0]}))


def files_of_one(root):
    files_of_one_episode(root)


DISORDERS = [tasks_reversed, tasks_with_gaps, numbers_from_100, places_from_100, files_out_of_order, files_of_one]


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda o: o[0])
@pytest.mark.parametrize("disorder", DISORDERS, ids=lambda f: f.__name__)
def test_each_episode_keeps_its_rows_pictures_and_task(recording, tmp_path, operation, disorder):
    root, first = tmp_path / "src", 2 if operation[0] == "trim" else 0
    shutil.copytree(recording, root)
    disorder(root)
    assert ("order" in inspect(root)) == (disorder is not files_of_one)
    dataset = run(operation[0], root, tmp_path / "dst", *operation[1:])
    assert "order" not in inspect(tmp_path / "dst")
    steps = STEPS - first
    for episode in range(3):
        for frame in (0, steps - 1):
            row = dataset[episode * steps + frame]
            np.testing.assert_allclose(row[ACTION], moving(STEPS, seed=episode)[first + frame] + 1, atol=1e-5)
            assert row["task"] == TASKS[episode]
            assert int(row["index"]) == episode * steps + frame
            assert int(row["episode_index"]) == episode
            assert abs(float(row[TOP].mean()) * 255 - (20 + 60 * episode + 4 * (first + frame))) < 3
    assert dataset.meta.stats[ACTION]["count"] == 3 * steps


def shuffled(root):
    edit_rows(root, lambda c: c.update(frame_index=[n ^ 1 for n in c["frame_index"]]))


def scattered(root):
    edit_rows(root, lambda c: c.update(episode_index=[n % 3 for n in range(3 * STEPS)]))


def gap(root):
    edit_rows(root, lambda c: c.update({k: [v for v, e in zip(c[k], c["episode_index"], strict=True) if e != 1]
                                        for k in [k for k in c if k != "episode_index"]}
                                       | {"episode_index": [e for e in c["episode_index"] if e != 1]}))  # fmt: skip
    edit_meta(root, lambda c: c.update({k: [v[0], v[2]] for k, v in c.items()}))
    edit_info(root, lambda i: i.update(total_episodes=2, total_frames=2 * STEPS))


def no_task(root):
    tasks(root, {"pick": 0, "place": 1})


def shorter(root):
    edit_meta(root, lambda c: c.update(length=[STEPS - 1, STEPS, STEPS]))


DAMAGES = {
    shuffled: "Episode 0: frame_index is 1 in its row 0",
    scattered: "in one piece",
    gap: "out of order or with gaps (lacking 1)",
    no_task: "task_index 2 is not in",
    shorter: "says that episode 0 has 11 rows, the data files hold 12",
}


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda f: f.__name__)
def test_what_cannot_be_put_in_order_is_named(recording, tmp_path, capsys, damage):
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    damage(root)
    for number, operation in enumerate(OPERATIONS):
        run(operation[0], root, tmp_path / str(number), *operation[1:], code=2)
        assert DAMAGES[damage] in last_line(capsys)


def test_a_bad_episode_alone_is_left_out(recording, tmp_path):
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    shorter(root)
    for number, operation in enumerate(OPERATIONS):
        dataset = run(operation[0], root, tmp_path / str(number), *operation[1:], "--skip_bad_episodes")
        assert {dataset[i]["task"] for i in range(dataset.num_frames)} == {"place", "wipe"}


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda o: o[0])
def test_tables_beside_the_episodes_travel_along(recording, tmp_path, operation, capsys):
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    table = pd.DataFrame({"subtask_index": [0, 1]}, index=pd.Index(["reach", "grasp"], name="subtask"))
    table.to_parquet(root / "meta/subtasks.parquet")
    pd.DataFrame({"episode_index": [0, 1, 2], "note": ["a", "b", "c"]}).to_parquet(root / "meta/notes.parquet")
    run(operation[0], root, tmp_path / "dst", *operation[1:])
    said = capsys.readouterr().err
    assert pd.read_parquet(tmp_path / "dst/meta/subtasks.parquet").equals(table)
    if operation[0] != "label":  # what is of single episodes cannot be told for others
        assert "meta/notes.parquet" in said
        assert "subtasks" not in said


ONE = [
    ["filter", "--threshold=0.01"], ["delta"], ["delta", "--of=state"], ["resample", "--fps=5"], ["label", "--all"],
    ["bounds"], ["resize", "--size=[32,32]"], ["drop", "--episodes=[0]"],
]  # fmt: skip


@pytest.mark.parametrize("operation", ONE, ids=" ".join)
@pytest.mark.parametrize("lengths", [(8, 1, 6), (1, 1)], ids=str)
def test_episodes_of_one_frame_are_episodes(tmp_path, operation, lengths):
    longer = write_columns(tmp_path / "longer", episodes([n + 1 for n in lengths]))  # which LeRobot can write
    root = tmp_path / "src"
    run("trim", longer, root, "--head=1", "--min_steps=1")
    assert "short_episode" in inspect(root)
    dataset = run(operation[0], root, tmp_path / "dst", *operation[1:])
    found = [int(e["length"]) for e in dataset.meta.episodes]
    wanted = [-(-n // 2) for n in lengths] if operation[0] == "resample" else list(lengths)
    assert found == (wanted[1:] if operation[0] == "drop" else wanted)
    for row in range(dataset.num_frames):
        assert np.isfinite(dataset[row][ACTION]).all()
    assert np.isfinite(dataset.meta.stats[TOP]["mean"]).all()
    again = LeRobotDataset("local/dst", tmp_path / "dst")
    assert float(again[0][TOP].mean()) > 0


def test_an_episode_of_one_frame_with_a_column_of_pairs_is_named(tmp_path, capsys):
    made = [{**e, "observation.keypoints": np.ones((n, 9, 2), np.float32)}
            for e, n in zip(episodes((8, 2, 6)), (8, 2, 6), strict=True)]  # fmt: skip
    root = write_columns(tmp_path / "src", made)
    dataset = run("label", root, tmp_path / "dst", "--all")
    assert tuple(dataset[0]["observation.keypoints"].shape) == (9, 2)
    run("trim", root, tmp_path / "no", "--head=1", "--min_steps=1", code=2)
    assert "Episode 1 has one step" in last_line(capsys)
    (tmp_path / "mine.yaml").write_text("steps: [{drop: {where: steps < 3}}, {trim: {head: 1, min_steps: 1}}]")
    assert run("run", root, tmp_path / "ok", recipe=[str(tmp_path / "mine.yaml")]).num_episodes == 2


def test_places_of_episodes_among_rows():
    assert places(np.array([2, 2, 0, 1, 1])) == {2: (0, 2), 0: (2, 3), 1: (3, 5)}
    assert places(np.array([0, 1, 0])) == {0: (0, 0), 1: (1, 2)}
    assert places(np.zeros(0, int)) == {}


def test_a_column_that_nobody_trains_on_may_hold_anything(tmp_path, capsys):
    effort = np.full((STEPS, 4), np.nan, np.float32)
    made = [{**e, "observation.effort": effort} for e in episodes()]
    root = write_columns(tmp_path / "src", made)
    found = inspect(root)
    assert "bad_episode" not in found
    assert "'observation.effort'" in found["infinite_column"].text
    for number, operation in enumerate([*OPERATIONS, ["delta"], ["filter", "--threshold=0.01"], ["bounds"]]):
        run(operation[0], root, tmp_path / str(number), *operation[1:])
        assert np.isnan(column(tmp_path / str(number), "observation.effort")).all()


def test_rows_that_are_left_out_may_be_infinite_others_not(tmp_path, capsys):
    made = [{**e, **last_step_rewards(STEPS)} for e in episodes()]
    made = [{k: v for k, v in e.items() if not k.startswith("next.")} for e in made]
    made[1][ACTION][-1] = np.nan
    root = write_columns(tmp_path / "src", made)
    assert "frame 11" in inspect(root)["bad_episode"].text
    dataset = run("trim", root, tmp_path / "cut", "--tail=1")
    assert np.isfinite(column(tmp_path / "cut", ACTION)).all()
    assert dataset.num_frames == 3 * (STEPS - 1)
    assert run("drop", root, tmp_path / "dropped", "--episodes=[1]").num_episodes == 2
    for number, operation in enumerate((["label", "--all"], ["trim", "--head=1"], ["delta"], ["trim", "--motion"])):
        run(operation[0], root, tmp_path / str(number), *operation[1:], code=2)
        assert "Episode 1, frame 11: 'action' is not finite" in last_line(capsys)
    assert run("label", root, tmp_path / "one", "--all", "--skip_bad_episodes").num_episodes == 2
