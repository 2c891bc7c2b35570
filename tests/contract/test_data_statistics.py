"""Statistics that are lost, or of other data: training stops, `inspect` says so before, operations write them anew."""

import json
import shutil

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors

from cqn_train.cli import main as cqn_train
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.errors import DataError

from .columns import ACTION, STATE, TOP, grey, moving, write_columns
from .conftest import TINY_POLICY, TINY_RUN
from .data_recording import run
from .test_data_inspect import inspect


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    episodes = [{STATE: moving(40, seed=s), ACTION: moving(40, seed=s) + 1, TOP: grey(40)} for s in (0, 1)]
    return write_columns(tmp_path_factory.mktemp("statistics") / "src", episodes)


def changed(good, tmp_path, change):
    """A copy whose statistics are lost (None) or changed."""
    root = tmp_path / "src"
    shutil.copytree(good, root)
    path = root / "meta/stats.json"
    if change is None:
        path.unlink()
    else:
        stats = json.loads(path.read_text())
        change(stats)
        path.write_text(json.dumps(stats))
    return root


def narrow(column, factor):
    def change(stats):
        for end in ("min", "max"):
            stats[column][end] = [factor * v for v in stats[column][end]]

    return change


def lack(stats):
    del stats[ACTION]


def fewer(stats):
    stats[ACTION]["max"] = stats[ACTION]["max"][:3]


STALE = {
    "lost": (None, "no_statistics", "error"),
    "lacking": (lack, "no_statistics", "error"),
    "action": (narrow(ACTION, 0.3), "stale_statistics", "error"),
    "state": (narrow(STATE, 0.1), "stale_statistics", "error"),
    "size": (fewer, "stale_statistics", "error"),
    "wide": (narrow(ACTION, 1.5), "stale_statistics", "warning"),
}


def processors(root):
    meta = LeRobotDataset("local/src", root).meta
    config = CQNConfig(device="cpu", preset="laptop_state", push_to_hub=False)
    make_policy(config, ds_meta=meta)
    return make_pre_post_processors(config, dataset_stats=meta.stats)


@pytest.mark.parametrize("kind", STALE)
def test_statistics_of_other_data_are_found_refused_and_mended(good, tmp_path, kind):
    change, code, level = STALE[kind]
    root = changed(good, tmp_path, change)
    found = inspect(root)[code]
    assert found.level == level
    assert "recompute_stats" in found.advice
    if level == "error":
        with pytest.raises(DataError, match="recompute_stats") as error:
            processors(root)
        assert "stats.json" in str(error.value)
        assert "\n" not in str(error.value)
    mended = run("label", root, tmp_path / "dst", "--all")
    want = LeRobotDataset("local/src", good).meta.stats
    for column in (STATE, ACTION, TOP):
        for name in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(mended.meta.stats[column][name], want[column][name], rtol=1e-4, atol=1e-5)
    processors(tmp_path / "dst")
    assert code not in inspect(tmp_path / "dst")


def test_the_remedy_of_lerobot_works(good, tmp_path, command):
    root = changed(good, tmp_path, None)
    command(
        "lerobot-edit-dataset", "--repo_id=local/src", f"--root={root}", "--operation.type=recompute_stats",
        "--new_repo_id=local/new", f"--new_root={tmp_path / 'new'}",
    )  # fmt: skip
    processors(tmp_path / "new")


def test_bounds_that_leave_out_what_was_asked_for_are_no_fault(good, tmp_path):
    run("bounds", good, tmp_path / "dst", "--quantile=0.2")
    processors(tmp_path / "dst")
    assert "stale_statistics" not in inspect(tmp_path / "dst")
    run("bounds", good, tmp_path / "wide", "--margin=0.3")
    processors(tmp_path / "wide")
    assert "stale_statistics" not in inspect(tmp_path / "wide")


@pytest.mark.parametrize("kind", ["lost", "action"])
def test_both_trainers_stop_before_any_update(click, tmp_path, capsys, command, kind):
    root = tmp_path / "src"
    shutil.copytree(click[1].partition("=")[2], root)
    path = root / "meta/stats.json"
    stats = json.loads(path.read_text())
    path.unlink()
    if kind == "action":
        narrow(ACTION, 0.2)(stats)
        path.write_text(json.dumps(stats))
    data = [click[0], f"--dataset.root={root}"]
    assert cqn_train([*TINY_RUN, *data, f"--output_dir={tmp_path / 'run'}"]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "stats.json" in said
    assert "recompute_stats" in said
    assert not (tmp_path / "run").exists()
    done = command(
        "lerobot-train", *TINY_POLICY, "--policy.push_to_hub=false", *data, "--batch_size=4", "--steps=1",
        "--num_workers=0", f"--output_dir={tmp_path / 'lerobot'}", code=1,
    )  # fmt: skip
    assert "recompute_stats" in done.stderr.strip().splitlines()[-1]
    assert not (tmp_path / "lerobot/checkpoints").exists()


def test_mean_and_deviation_of_other_data_are_said(tmp_path):
    episodes = [{STATE: moving(40, seed=s), ACTION: moving(40, seed=s) + 1} for s in (0, 1)]
    root = write_columns(tmp_path / "src", episodes)
    assert "stale_moments" not in inspect(root)
    path = root / "meta/stats.json"
    stats = json.loads(path.read_text())
    stats[ACTION]["std"] = [0.0] * 4
    path.write_text(json.dumps(stats))
    found = inspect(root)["stale_moments"]
    assert found.level == "warning"
    assert "CQN does not use them" in found.text
    run("label", root, tmp_path / "dst", "--all")
    assert "stale_moments" not in inspect(tmp_path / "dst")
