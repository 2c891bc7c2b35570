"""Recipes as one pass, previews, damaged sources, and what must survive, on a recording with a camera."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.disk import source as source_module

from .data_recording import LENGTHS, RECIPE, TOP, column, history, last_line, run, videos, what


def test_a_recipe_is_one_pass_and_equals_its_steps_one_by_one(recording, tmp_path, monkeypatch):
    (tmp_path / "mine.yaml").write_text(RECIPE)
    calls = []
    original = source_module.video_pictures

    def counted(path, times, fps, episode, frames):
        calls.append(len(times))
        return original(path, times, fps, episode, frames)

    monkeypatch.setattr(source_module, "video_pictures", counted)
    dataset = run("run", recording, tmp_path / "once", recipe=[str(tmp_path / "mine.yaml")])
    assert len(calls) == len(LENGTHS)
    assert sum(calls) == dataset.num_frames
    step = recording
    for number, (operation, options) in enumerate(
        [
            ("filter", ["--threshold=0.01"]),
            ("delta", []),
            ("resize", ["--size=[32,32]"]),
            ("label", ["--all"]),
            ("bounds", []),
        ]
    ):
        run(operation, step, tmp_path / f"s{number}", *options)
        step = tmp_path / f"s{number}"
    assert [e["operation"] for e in history(step)] == [e["operation"] for e in history(tmp_path / "once")]
    apart = LeRobotDataset("local/dst", step)
    assert dataset.meta.info.features.keys() == apart.meta.info.features.keys()
    for key in (
        "observation.state",
        "action",
        "next.reward",
        "source.frame_index",
        "source.episode_index",
        "timestamp",
    ):
        np.testing.assert_array_equal(column(tmp_path / "once", key), column(step, key))
    assert what(dataset[3][TOP])[1] == what(apart[3][TOP])[1]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("steps: [filtr]", "Did you mean 'filter'?"),
        ("steps: [{filter: {treshold: 1}}]", "Did you mean 'threshold'?"),
        ("steps: [{filter: {threshold: -1}}]", "positive"),
        ("steps: []", "expected one key 'steps'"),
        ("filter: {}", "expected one key 'steps'"),
        ("steps: [{bounds: {}}, {filter: {threshold: 0.01}}]", "bounds must come after"),
        ("steps: [{filter: {threshold: x}}]", "step filter: Bad option value"),
        ("steps: [", "is not YAML"),
        ("steps: [{resize: {}}, {resize: {}}]", "resized twice"),
    ],
)
def test_recipes_that_cannot_work_say_why(recording, tmp_path, capsys, text, said):
    (tmp_path / "mine.yaml").write_text(text)
    run("run", recording, tmp_path / "dst", code=2, recipe=[str(tmp_path / "mine.yaml")])
    assert said in last_line(capsys)
    assert not (tmp_path / "dst").exists()


def test_shipped_recipe_by_name_with_a_changed_setting(recording, tmp_path, capsys):
    changes = ["--filter.auto=false", "--filter.threshold=0.01", "--resize.size=[32, 32]", "--dry_run"]
    run("run", recording, tmp_path / "dst", *changes, recipe=["paper_real_world"])
    out = capsys.readouterr().out
    assert "32x32" in out
    assert "Dry run: nothing was written." in out
    run("run", recording, tmp_path / "dst", "--trim.head=1", code=2, recipe=["paper_real_world"])
    assert "Unknown step of paper_real_world" in last_line(capsys)
    run("run", recording, tmp_path / "dst", code=2, recipe=["papr_real_world"])
    assert "Did you mean 'paper_real_world'?" in last_line(capsys)


def damaged(recording, tmp_path):
    """A copy in which the video of episode 1 ends early."""
    root = tmp_path / "damaged"
    shutil.copytree(recording, root)
    path = sorted((root / "videos").rglob("*.mp4"))[1]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return root, path


def test_a_broken_video_is_named_or_its_episode_skipped(recording, tmp_path, capsys):
    root, path = damaged(recording, tmp_path)
    run("resize", root, tmp_path / "dst", "--size=[32,32]", code=2)
    said = last_line(capsys)
    assert str(path) in said
    assert "episode 1, frame" in said
    assert not (tmp_path / "dst").exists()
    run("label", root, tmp_path / "copied", "--all", code=2)  # copying does not pass it on, either
    assert str(path) in last_line(capsys)
    dataset = run("resize", root, tmp_path / "dst", "--size=[32,32]", "--skip_bad_episodes")
    assert "Left out episode 1" in capsys.readouterr().err
    assert [what(dataset[i][TOP])[1] for i in (0, 30)] == [0, 2]
    assert dataset.num_frames == LENGTHS[0] + LENGTHS[2]
    assert list(history(tmp_path / "dst")[-1]["episodes"]) == ["1"]
    assert str(tmp_path) not in json.dumps(history(tmp_path / "dst"))


def test_uneven_times_and_missing_numbers_name_episode_and_frame(recording, tmp_path, capsys):
    for name, spoil, said in (
        ("times", lambda t: t.update({"timestamp": t["timestamp"].where(t["index"] != 25, 9.0)}), "Episode 1, frame 5"),
        ("nan", lambda t: t["action"][40].__setitem__(1, np.nan), "Episode 2, frame 8: 'action' is not finite"),
    ):
        root = tmp_path / name
        shutil.copytree(recording, root)
        path = next((root / "data").rglob("*.parquet"))
        table = pd.read_parquet(path)
        table["action"] = [np.array(v) for v in table["action"]]
        columns = {k: table[k] for k in table}
        spoil(columns)
        pd.DataFrame(columns).to_parquet(path)
        run("label", root, tmp_path / "dst", "--all", code=2)
        assert said in last_line(capsys)
        dataset = run("label", root, tmp_path / f"{name}_ok", "--all", "--skip_bad_episodes")
        assert dataset.num_episodes == 2


def test_files_that_are_not_understood_are_carried_or_named(recording, tmp_path, capsys):
    root = tmp_path / "extra"
    shutil.copytree(recording, root)
    (root / "meta" / "cameras.json").write_text("{}")
    run("label", root, tmp_path / "copied", "--all")
    assert (tmp_path / "copied/meta/cameras.json").read_text() == "{}"
    capsys.readouterr()
    run("drop", root, tmp_path / "dropped", "--episodes=[0]")
    assert "Not carried over, since their meaning is unknown: meta/cameras.json" in capsys.readouterr().err


def annotated(recording, tmp_path):
    """A copy with the annotations that LeRobot keeps in a column of their own, as its own tool writes them."""
    import datasets
    from lerobot.datasets.language import language_persistent_column_feature

    root = tmp_path / "annotated"
    shutil.copytree(recording, root)
    path = next((root / "data").rglob("*.parquet"))
    table = datasets.Dataset.from_parquet(str(path), cache_dir=str(tmp_path / "cache"))
    feature = language_persistent_column_feature()
    row = dict.fromkeys(("role", "content", "style", "timestamp", "camera", "tool_calls"))
    rows = [[{**row, "role": "user", "content": f"step {i}", "style": "plan"}] for i in range(len(table))]
    column = datasets.Dataset.from_dict(
        {"language_persistent": rows}, features=datasets.Features(language_persistent=feature)
    )
    datasets.concatenate_datasets([table, column], axis=1).to_parquet(str(path))
    info = json.loads((root / "meta/info.json").read_text())
    info["features"]["language_persistent"] = {"dtype": "language", "shape": [1], "names": None}
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def test_annotations_are_carried_where_frames_stay_and_refused_by_name_elsewhere(recording, tmp_path, capsys):
    root = annotated(recording, tmp_path)
    dataset = run("label", root, tmp_path / "labelled", "--all")
    assert dataset.hf_dataset.with_format(None)[40]["language_persistent"][0]["content"] == "step 40"
    assert videos(root) == videos(tmp_path / "labelled")
    run("drop", root, tmp_path / "dropped", "--episodes=[0]", code=2)
    assert "'language_persistent' is a language column" in last_line(capsys)
    assert not (tmp_path / "dropped").exists()


def test_quality_of_new_videos_can_be_chosen(recording, tmp_path):
    for crf in (5, 45):
        run("resize", recording, tmp_path / str(crf), "--size=[32,32]", f"--crf={crf}")
    sizes = {crf: sum(map(len, videos(tmp_path / str(crf)).values())) for crf in (5, 45)}
    assert sizes[5] > sizes[45]


def test_previews_are_written_once_and_show_what_goes(recording, tmp_path):
    import av
    from PIL import Image

    film, curves = tmp_path / "film.mp4", tmp_path / "curves.png"
    run("filter", recording, tmp_path / "x", "--threshold=0.01", "--dry_run", f"--preview={film}")
    run("filter", recording, tmp_path / "x", "--threshold=0.01", "--dry_run", f"--preview={curves}")
    with av.open(str(film)) as container:
        frames = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
    assert len(frames) == sum(LENGTHS)
    red = [f[4, -20:, 0].mean() > 150 for f in frames]
    entry = json.loads(_report(recording, tmp_path))[0]
    assert sum(red) == entry["total"]["steps"] - entry["total"]["kept"]
    assert Image.open(curves).width > 500
    run("filter", recording, tmp_path / "x", "--threshold=0.01", "--dry_run", f"--preview={film}", code=2)


def _report(recording, tmp_path):
    run("filter", recording, tmp_path / "x", "--threshold=0.01", "--dry_run", f"--report={tmp_path / 'r.json'}")
    return (tmp_path / "r.json").read_text()


def test_the_source_is_never_touched(recording, tmp_path):
    before = {str(p): (p.stat().st_mtime_ns, p.stat().st_size) for p in recording.rglob("*")}
    assert Path(recording).exists()
    for number, arguments in enumerate(
        [["label", "--all"], ["trim", "--head=1"], ["bounds"], ["resample", "--fps=15"]]
    ):
        run(arguments[0], recording, tmp_path / str(number), *arguments[1:])
    assert before == {str(p): (p.stat().st_mtime_ns, p.stat().st_size) for p in recording.rglob("*")}
