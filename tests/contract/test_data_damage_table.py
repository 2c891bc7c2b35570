"""Every kind of damage against `inspect` and every operation: what comes out is right, or one line refuses it."""

import shutil

import numpy as np
import pytest
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from PIL import Image

from cqn_train.config import DatasetSettings
from cqn_train.replay.demonstrations import Demonstrations
from lerobot_cqn.errors import CQNError
from lerobot_cqn.scaling_check import check_scaling

from ..unit.test_policy_batch import make_agent
from .columns import ACTION, STATE, TOP, edit_info, edit_rows, grey, moving, write_columns
from .data_recording import last_line, run
from .test_data_inspect import inspect
from .test_data_statistics import lack, narrow
from .test_data_tables import DAMAGES, DISORDERS, STEPS, TASKS, episodes, files_of_one

RECIPE = "steps: [{trim: {head: 1}}, {delta: {}}, {resize: {size: [32, 32]}}, {label: {all: true}}]"
OPERATIONS = [
    ["label", "--all"], ["bounds"], ["trim", "--head=1"], ["filter", "--threshold=0.01"], ["delta"],
    ["resample", "--fps=5"], ["resize", "--size=[32,32]"], ["drop", "--episodes=[0]"], ["run"],
]  # fmt: skip


def statistics(change):
    import json

    def damage(root):
        path = root / "meta/stats.json"
        stats = json.loads(path.read_text())
        path.unlink()
        if change is not None:
            change(stats)
            path.write_text(json.dumps(stats))

    return damage


def late(root):
    edit_rows(root, lambda c: c.update(timestamp=[t + 0.4 for t in c["timestamp"]]))


def drift(root):
    edit_rows(root, lambda c: c.update(timestamp=[t * 1.03 for t in c["timestamp"]]))


def gap_in_time(root):
    edit_rows(root, lambda c: c.update(timestamp=[t + 2 * (i == 5) for i, t in enumerate(c["timestamp"])]))


def not_finite(root):
    edit_rows(root, lambda c: c[ACTION][20].__setitem__(1, np.nan))


def other_size(root):
    edit_info(root, lambda info: info["features"][TOP].update(shape=[40, 48, 3]))


def no_video(root):
    next((root / "videos").rglob("*.mp4")).unlink()


def half_a_video(root):
    path = next((root / "videos").rglob("*.mp4"))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])


def half_a_table(root):
    path = next((root / "data").rglob("*.parquet"))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


KINDS = {
    "statistics_lost": statistics(None), "statistics_lacking": statistics(lack),
    "statistics_stale": statistics(narrow(ACTION, 0.2)),
    **{d.__name__: d for d in (late, drift, gap_in_time, not_finite, other_size, no_video, half_a_video, half_a_table)},
    **{d.__name__: d for d in DISORDERS if d is not files_of_one}, **{d.__name__: d for d in DAMAGES},
}  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    made = episodes()
    board = np.uint8(60) * (np.indices((48, 48)).sum(axis=0) // 8 % 2)[None, :, :, None].astype(np.uint8)
    root = write_columns(
        tmp_path_factory.mktemp("damage") / "src", [{**e, TOP: e[TOP] // 2 + board} for e in made], tasks=TASKS
    )
    assert not [f for f in inspect(root).values() if f.level == "error"]
    return root


@pytest.mark.parametrize("kind", KINDS)
def test_damage_is_known_beforehand_and_mended_or_refused(recording, tmp_path, capsys, kind):
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    KINDS[kind](root)
    (tmp_path / "mine.yaml").write_text(RECIPE)
    from cqn_data.cli import main

    capsys.readouterr()
    known = main(["inspect", "--repo_id=x", f"--root={root}", "--json", "--strict"])
    capsys.readouterr()
    assert known == 1, "inspect calls it ready"
    for number, (operation, *options) in enumerate(OPERATIONS):
        target = tmp_path / str(number)
        names = ["--repo_id=local/src", f"--root={root}", "--new_repo_id=local/dst", f"--new_root={target}"]
        recipe = [str(tmp_path / "mine.yaml")] if operation == "run" else []
        code = main([operation, *recipe, *names, *options])
        if code == 0:
            found = inspect(target)
            assert not [f for f in found.values() if f.level == "error"], (operation, found)
        else:
            assert code == 2, operation
            said = last_line(capsys)
            assert said.startswith("cqn-data "), said
            assert any(word in said for word in ("pisode", str(root))), said
            assert not target.exists()


@pytest.mark.parametrize("kind", KINDS)
def test_cqn_train_reads_it_rightly_or_says_what_is_wrong_in_a_line(recording, tmp_path, kind):
    root = tmp_path / "src"
    shutil.copytree(recording, root)
    KINDS[kind](root)
    settings = DatasetSettings("local/src", str(root))
    try:
        data = Demonstrations(settings)
        check_scaling(data.meta.stats or {}, data.meta, margin=0.0, state_bound=None)
        read = data.episodes(make_agent(LeRobotDatasetMetadata("local/src", recording)))
    except CQNError as error:
        said = str(error)
        assert "\n" not in said
        assert any(word in said for word in ("pisode", str(root), f"'{TOP}' has shape")), said
    else:
        expected = Demonstrations(DatasetSettings("local/src", str(recording))).episodes(
            make_agent(LeRobotDatasetMetadata("local/src", recording))
        )
        for one, other in zip(read, expected, strict=True):
            np.testing.assert_allclose(one.action, other.action, atol=1e-5)
            np.testing.assert_allclose(one.low_dim, other.low_dim, atol=1e-5)
            np.testing.assert_array_equal(one.pixels[0], other.pixels[0])


def test_pictures_of_more_than_8_bits_are_named(tmp_path, capsys):
    import io

    pictures = {STATE: moving(STEPS), ACTION: moving(STEPS), TOP: grey(STEPS)}
    root = write_columns(tmp_path / "src", [pictures], stills=True)

    def deep(columns):
        buffer = io.BytesIO()
        Image.fromarray(np.full((48, 48), 1100, np.uint16)).save(buffer, "PNG")
        columns[TOP] = [{"bytes": buffer.getvalue(), "path": "x.png"}] * STEPS

    edit_rows(root, deep)
    assert "more than 8 bits" in inspect(root)["broken_video"].text
    for number, operation in enumerate((["trim", "--head=1"], ["resize", "--size=[32,32]"])):
        run(operation[0], root, tmp_path / str(number), *operation[1:], code=2)
        assert "remove_feature" in last_line(capsys)


def test_columns_by_other_names_get_a_rename(tmp_path):
    root = write_columns(tmp_path / "src", [{"state": moving(STEPS), "actions": moving(STEPS)}])
    found = inspect(root)
    assert "rename it to 'action'" in found["no_action"].advice
    assert '--rename_map=\'{"state": "observation.state"}\'' in found["no_state"].advice


def test_a_page_that_cannot_be_written_costs_no_report(recording, tmp_path, capsys, monkeypatch):
    from pathlib import Path

    from cqn_data.cli import main

    monkeypatch.chdir(tmp_path)
    opened = Path.open

    def refuse(self, mode="r", *args, **kwargs):
        if mode == "x":
            raise OSError(30, "Read-only file system")
        return opened(self, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", refuse)
    assert main(["inspect", "--repo_id=x", f"--root={recording}"]) == 0
    said = capsys.readouterr()
    assert "No page was written here (Read-only file system)" in said.err
    assert "3 episodes" in said.out
    assert main(["inspect", "--repo_id=x", f"--root={recording}", "--html=page.html"]) != 0
