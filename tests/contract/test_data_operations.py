"""Every operation through the command line, on a recording with a camera: what LeRobot then loads, to the pixel."""

import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data import source as source_module
from cqn_data.cli import main
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.processor_cqn import make_cqn_pre_post_processors

FPS, SIDE, LENGTHS = 30, 48, (20, 12, 31)
TOP = "observation.images.top"
NAMES = ["pan.pos", "lift.pos", "gripper.pos"]


@pytest.fixture(autouse=True)
def _logs():
    yield
    logging.disable(logging.NOTSET)


def picture(episode, step):
    """Left half shows the step, right half the episode; each in grey levels far apart."""
    image = np.full((SIDE, SIDE, 3), 20 + 7 * step, np.uint8)
    image[:, SIDE // 2 :] = 40 + 80 * episode
    return image


def what(image):
    """Step and episode that a picture, (3, H, W) in [0, 1], shows."""
    left, right = (float(half.mean()) * 255 for half in image.chunk(2, dim=-1))
    return round((left - 20) / 7), round((right - 40) / 80)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Absolute commands that lead a moving arm by a little; no reward; every third step stands still."""
    root = tmp_path_factory.mktemp("recording") / "src"
    vector = {"dtype": "float32", "shape": (3,), "names": NAMES}
    camera = {"dtype": "video", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, TOP: camera}
    encoder = RGBEncoderConfig(vcodec="h264", crf=5, g=2)
    dataset = LeRobotDataset.create("local/src", FPS, features, root=root, rgb_encoder=encoder)
    dataset.meta.info.video_files_size_in_mb = 1e-6  # a video file for every episode
    rng = np.random.default_rng(0)
    for episode, length in enumerate(LENGTHS):
        state = rng.normal(size=3).astype(np.float32)
        for step in range(length):
            move = np.zeros(3) if step % 3 == 2 else rng.uniform(0.05, 0.2, 3) * [1, -1, 0]
            command = (state + move * 1.3).astype(np.float32)
            command[2] = state[2] = float(step > length // 2)
            dataset.add_frame(
                {"observation.state": state.copy(), "action": command, TOP: picture(episode, step), "task": "go"}
            )
            state = (state + move).astype(np.float32)
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


def run(operation, source, target, *options, code=0, recipe=()):
    names = ["--repo_id=local/src", f"--root={source}", "--new_repo_id=local/dst", f"--new_root={target}"]
    assert main([operation, *recipe, *names, *options]) == code
    return LeRobotDataset("local/dst", target) if code == 0 and "--dry_run" not in options else None


def column(root, key):
    files = sorted((root / "data").glob("*/*.parquet"))
    table = pd.concat([pd.read_parquet(f) for f in files])
    return np.stack(table[key]) if len(table) else np.zeros(0)


def history(root):
    return json.loads((root / "meta/cqn_history.json").read_text())["operations"]


def videos(root):
    return {str(p.relative_to(root)): p.read_bytes() for p in (root / "videos").rglob("*.mp4")}


def last_line(capsys):
    lines = capsys.readouterr().err.strip().splitlines()
    assert "Traceback" not in "".join(lines)
    return lines[-1]


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


def test_drop_keeps_the_reason(recording, tmp_path):
    dataset = run("drop", recording, tmp_path / "dst", "--episodes=[0]", "--where=steps < 15", "--reason=clumsy")
    assert (dataset.num_episodes, dataset.num_frames) == (1, 31)
    assert history(tmp_path / "dst")[0]["dropped"] == {"0": "clumsy", "1": "clumsy: steps < 15 (12)"}
    assert what(dataset[4][TOP]) == (4, 2)


RECIPE = """
steps:
  - filter: {threshold: 0.01}
  - delta: {}
  - resize: {size: [32, 32]}
  - label: {all: true}
  - bounds: {}
"""


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
    dataset = run("resize", root, tmp_path / "dst", "--size=[32,32]", "--skip_bad_episodes")
    assert "Left out episode 1" in capsys.readouterr().err
    assert [what(dataset[i][TOP])[1] for i in (0, 30)] == [0, 2]
    assert dataset.num_frames == LENGTHS[0] + LENGTHS[2]
    assert list(history(tmp_path / "dst")[-1]["episodes"]) == ["1"]


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
