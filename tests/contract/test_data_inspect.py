"""`cqn-data inspect`: every finding provoked once, the outputs for people and machines, and two real recordings."""

import json
import logging
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.scripts.convert_dataset_v21_to_v30 import convert_dataset

from cqn_data.cli import main
from cqn_data.disk.source import open_source
from cqn_data.inspection.checks import GIB
from cqn_data.inspection.inspect import as_json, inspect_dataset
from lerobot_cqn.errors import DataError

from .recordings import (
    CAMERA,
    FPS,
    change,
    chatter,
    demonstration,
    halting,
    only,
    pair,
    slow,
    spike,
    stretch,
    wrap,
    write,
)

REAL = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(autouse=True)
def _own_process():
    """The command silences its own process for good; this one goes on."""
    environment = dict(os.environ)
    yield
    logging.disable(logging.NOTSET)
    os.environ.clear()
    os.environ.update(environment)


def inspect(root):
    """Findings as {code: finding}; each code at most once, or the first."""
    inspection = inspect_dataset("local/toy", open_source("local/toy", str(root)))
    json.dumps(as_json("local/toy", inspection), allow_nan=False)
    found = {}
    for finding in inspection.findings:
        found.setdefault(finding.code, finding)
    return found


def run(captured, root, *options, code=0):
    """Standard output and error of the command."""
    assert main(["inspect", "--repo_id=local/toy", f"--root={root}", *options]) == code
    return captured.readouterr()


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return write(tmp_path_factory.mktemp("good") / "data", [demonstration(seed) for seed in range(3)])


def test_a_good_dataset_is_ready(good, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = {p: p.stat().st_mtime_ns for p in good.rglob("*")}
    out, _ = run(capsys, good, "--strict")
    assert "Ready for training" in out
    assert "error" not in out
    assert "absolute joint positions; the motion follows the command after 1 step (0.05 s, r = 1.00)" in out
    assert "Report: inspect.html" in out
    assert {p: p.stat().st_mtime_ns for p in good.rglob("*")} == before
    page = (tmp_path / "inspect.html").read_text()
    assert "http" not in page  # nothing is fetched from anywhere
    assert page.count("<svg") == page.count("</svg>") > 5
    assert "nan" not in re.findall(r'="([^"]*)"', page)
    written = (tmp_path / "inspect.html").stat().st_mtime_ns
    assert "Report: inspect_2.html" in run(capsys, good)[0]  # once more, or another dataset
    assert main(["inspect", "--repo_id=local/toy", f"--root={good}", "--html=inspect.html"]) == 2
    assert "inspect.html exists already" in capsys.readouterr().err
    assert (tmp_path / "inspect.html").stat().st_mtime_ns == written


def test_json_is_the_only_thing_on_stdout(good, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    report = json.loads(run(capfd, good, "--json", "--strict")[0])
    assert (report["ok"], report["dataset"]["steps"], len(report["episodes"])) == (True, 180, 3)
    assert report["actions"]["kind"] == "absolute"
    assert report["actions"]["lag_steps"] == 1
    assert [e["gripper_events"] for e in report["episodes"]] == [1, 1, 1]
    assert report["episodes"][0]["still"] == pytest.approx(6 / 59, abs=0.02)
    assert report["threshold"]["clear"] is True
    # An episode of T steps has T + 1 observations of 3 numbers, and T actions of 3 with a reward.
    assert report["memory_bytes"] == {"vectors": 4 * (183 * 3 + 180 * 4), "pictures": 0, "pictures_84": 0}
    assert list(tmp_path.iterdir()) == []


STATE, ACTION, FEW = "observation.state", "action", {k: v[:3] for k, v in demonstration(1).items()}
PROVOKED = {
    "jump": ("warning", [change(state=spike), demonstration(1)], "episode 0, frame 30, pan.pos (state): +8.97"),
    "wrap": ("warning", [change(state=wrap), demonstration(1)], "frame 30, lift.pos (state): -6.3"),
    "constant_joint": ("warning", pair(state=lambda v: v * [0, 1, 1]), "1 of 3 never change: pan"),
    "constant_action": ("warning", pair(action=lambda v: v * [1, 0, 1]), "lift.pos"),
    "constant_actions": ("error", pair(action=np.ones_like), "nothing to imitate"),
    "nothing_moves": ("error", pair(state=np.ones_like), "No joint ever moves"),
    "wide_actions": ("warning", [change(action=stretch), *pair()], "worst 'pan.pos'"),
    "short_episode": ("warning", [demonstration(0), FEW], "1 episode shorter"),
    "duplicates": ("warning", [*pair(), demonstration(0)], "0 = 2"),
    "no_success": ("error", pair(reward=np.zeros_like), "No step of any episode"),
    "failures": ("note", [demonstration(0), change(1, reward=np.zeros_like)], "1 episode without a reward"),
    "early_end": ("note", [demonstration(0), change(1, reward=np.ones_like)], "leaves out the 59 of 120 steps"),
    "no_reward": ("note", only(STATE, ACTION), "last step"),
    "idle_gripper": ("note", pair(action=lambda v: v * [1, 1, 0]), "neither opens nor closes"),
    "gripper_events": ("note", [*pair(), change(2, action=chatter)], "episode 2: 59"),
    "pauses": ("warning", pair(state=halting), "% of the"),
    "unclear_threshold": ("note", [change(s, state=slow) for s in range(5)], "uncertain"),
    "lag": ("warning", [demonstration(s, steps=200, lag=9) for s in range(3)], "9 steps (0.45 s)"),
    "no_state": ("warning", only(ACTION), "cannot be looked for"),
    "no_action": ("error", only(STATE), "'action'"),
    "unmatched": ("note", pair(action=lambda v: v[:, :2]), "do not match"),
}


@pytest.mark.parametrize("case", PROVOKED)
def test_each_finding(tmp_path, case):
    level, episodes, said = PROVOKED[case]
    found = inspect(write(tmp_path / "data", episodes))
    code = "jump" if case == "wrap" else case
    assert code in found, sorted(found)
    assert found[code].level == level
    assert said in found[code].text
    if case == "jump":
        assert "and back" in found["jump"].text
        assert found["jump"].text.startswith("1 jumps")


@pytest.mark.parametrize("seed", range(3))
def test_a_good_episode_provokes_nothing(tmp_path, seed):
    assert set(inspect(write(tmp_path / "data", [demonstration(10 * seed + i) for i in range(3)]))) == set()


def test_delta_actions_are_recognised(tmp_path):
    def delta(seed):
        episode = demonstration(seed)
        episode["action"][:, :2] -= episode["observation.state"][:, :2]
        return episode

    source = open_source("local/toy", str(write(tmp_path / "data", [delta(s) for s in range(3)])))
    inspection = inspect_dataset("local/toy", source)
    assert inspection.numbers.follow.kind() == "delta"
    assert inspection.numbers.follow.lag()[0] == 1
    assert next(f.advice for f in inspection.findings if f.code == "action_kind").startswith("Say which")


def test_other_actions_are_recognised(tmp_path):
    rng = np.random.default_rng(0)
    episodes = [change(s, action=lambda v: rng.normal(size=v.shape)) for s in range(3)]
    assert inspect(write(tmp_path / "data", episodes))["action_kind"].text.startswith("The actions look neither")


def test_several_tasks_are_named(tmp_path):
    root = write(tmp_path / "data", [demonstration(0), demonstration(1)], tasks=("Press.", "Lift."))
    assert "'Press.', 'Lift.'" in inspect(root)["tasks"].text


def test_without_a_gripper(tmp_path):
    root = write(tmp_path / "data", [demonstration(0), demonstration(1)], names=["a", "b", "hand"])
    assert "no_gripper" in inspect(root)


def test_reward_and_success_must_agree(tmp_path):
    episodes = [demonstration(0), demonstration(1)]
    for episode in episodes:
        episode["next.success"] = np.zeros((60, 1), bool)
    assert "disagree" in inspect(write(tmp_path / "data", episodes))["reward_mismatch"].text


def edit_parquet(root, column, change):
    path = next((root / "data").rglob("*.parquet"))
    table = pq.read_table(path)
    values = change(np.array(table[column].to_pylist(), dtype=np.float32))
    field = table.schema.field(column)
    pq.write_table(
        table.set_column(table.schema.get_field_index(column), field, pa.array(list(values), field.type)), path
    )


def test_uneven_times_are_a_warning_and_worse_ones_an_error(good, tmp_path):
    def late(share):
        def shift(times):
            times[70:120] += share / FPS
            return times

        return shift

    root = shutil.copytree(good, tmp_path / "mild")
    edit_parquet(root, "timestamp", late(0.1))
    assert inspect(root)["jitter"].where == "episode 1"
    root = shutil.copytree(good, tmp_path / "bad")
    edit_parquet(root, "timestamp", late(0.9))
    assert "Episode 1, frame 10" in inspect(root)["bad_episode"].text


def test_an_episode_with_nan_is_named_and_the_others_are_looked_at(good, tmp_path, capsys):
    root = shutil.copytree(good, tmp_path / "data")

    def spoil(states):
        states[65, 1] = np.nan
        return states

    edit_parquet(root, "observation.state", spoil)
    out, _ = run(capsys, root, "--json", "--strict", code=1)
    report = json.loads(out)
    assert report["ok"] is False
    assert [e["episode"] for e in report["episodes"]] == [0, 2]
    assert report["bad_episodes"][0]["episode"] == 1
    assert "Episode 1, frame 5: 'observation.state' is not finite" in report["findings"][0]["text"]
    out, _ = run(capsys, root, f"--html={tmp_path / 'page.html'}")  # without --strict a report is a success
    assert "Not ready for training: 1 error" in out
    assert "is not finite" in (tmp_path / "page.html").read_text()


def test_when_no_episode_can_be_read(good, tmp_path, capsys):
    root = shutil.copytree(good, tmp_path / "data")
    edit_parquet(root, "observation.state", lambda states: states * np.nan)
    out, _ = run(capsys, root, "--strict", f"--html={tmp_path / 'page.html'}", code=1)
    assert "Not one episode can be read" in out
    report = json.loads(run(capsys, root, "--json")[0])
    assert report["episodes"] == []


def edit_info(root, **changes):
    path = root / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"total_episodes": 0, "total_frames": 0}, "holds no episodes"), ({"codebase_version": "v2.1"}, "convert")],
)
def test_what_cannot_be_opened_is_said_in_one_line(good, tmp_path, capsys, changes, said):
    root = shutil.copytree(good, tmp_path / "data")
    edit_info(root, **changes)
    out, err = run(capsys, root, f"--html={tmp_path / 'page.html'}", code=2)
    assert out == ""
    assert said in err
    assert err.count("\n") == 1
    out, _ = run(capsys, root, "--json", "--strict", code=1)
    report = json.loads(out)
    assert report["findings"][0]["code"] == "unreadable"
    assert report["dataset"] is None
    assert not (tmp_path / "page.html").exists()


# --- Cameras.


def filmed(seed, picture):
    """A short good episode with a camera; `picture(step, noise)` gives (48, 64, 3)."""
    episode = {k: v[:24] for k, v in demonstration(seed).items()}
    noise = np.random.default_rng(seed).integers(0, 255, (6, 8, 3)).repeat(8, 0).repeat(8, 1)
    episode[CAMERA] = np.stack([picture(step, noise) for step in range(24)]).astype(np.uint8)
    return episode


def moving(step, noise):
    return np.roll(noise, 3 * step, axis=1)


PICTURES = {
    "black_camera": lambda step, noise: np.zeros_like(noise),
    "blank_camera": lambda step, noise: np.full_like(noise, 1) * [200, 100, 30],
    "frozen_camera": lambda step, noise: noise,
}


@pytest.mark.parametrize("code", PICTURES)
def test_pictures_that_show_nothing(tmp_path, code):
    found = inspect(write(tmp_path / "data", [filmed(s, PICTURES[code]) for s in (0, 1)]))
    assert found[code].where == CAMERA
    assert found[code].level == ("warning" if code == "frozen_camera" else "error")
    assert "episode 0" in found[code].text or code == "frozen_camera"
    assert not ({*PICTURES} - {code}) & {*found}


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return write(tmp_path_factory.mktemp("film") / "data", [filmed(s, moving) for s in range(3)])


def test_pictures_are_looked_at_and_shown(film, tmp_path, capsys):
    out, _ = run(capsys, film, "--json", f"--html={tmp_path / 'page.html'}")
    report = json.loads(out)
    camera = report["cameras"][0]
    assert (camera["looked"], camera["height"], camera["width"]) == (18, 48, 64)
    assert camera["black"] == camera["blank"] == camera["frozen"] == camera["broken"] == []
    assert report["memory_bytes"]["pictures"] == (72 + 3) * 48 * 64 * 3
    assert report["memory_bytes"]["pictures_84"] == (72 + 3) * 84 * 84 * 3
    assert (tmp_path / "page.html").read_text().count("data:image/jpeg;base64,") == 1


def test_missing_and_broken_videos(film, tmp_path, capsys):
    root = shutil.copytree(film, tmp_path / "data")
    video = next(root.rglob("*.mp4"))
    video.write_bytes(b"nothing of a video")
    assert inspect(root)["broken_video"].level == "error"
    video.unlink()
    found = inspect(root)
    assert found["missing_video"].where == video.relative_to(root).as_posix()
    assert "episodes 0, 1, 2" in found["missing_video"].text
    run(capsys, root, "--strict", f"--html={tmp_path / 'page.html'}", code=1)
    assert "No picture can be read" in (tmp_path / "page.html").read_text()


def test_much_memory_is_mentioned(film, monkeypatch):
    from cqn_data.inspection import checks as inspect_checks

    monkeypatch.setattr(inspect_checks, "GIB", GIB // 4096)
    assert "resize" in inspect(film)["memory"].advice


def test_names_from_a_dataset_cannot_break_the_page(tmp_path, capsys):
    names = ["<script>alert(1)</script>", "a&b", "gripper"]
    root = write(tmp_path / "data", [demonstration(0), demonstration(1)], tasks=("<b>Press</b>",), names=names)
    run(capsys, root, f"--html={tmp_path / 'page.html'}")
    page = (tmp_path / "page.html").read_text()
    assert "<script>" not in page
    assert "<b>Press" not in page
    assert "a&amp;b" in page


# --- What people really record.

real = pytest.mark.skipif(not REAL.is_dir(), reason="the recordings are not part of the repository")


@real
def test_a_recording_without_its_videos(tmp_path, capsys):
    root = REAL / "so101_recording"
    out, _ = run(capsys, root, "--json", "--strict", f"--html={tmp_path / 'page.html'}", code=1)
    report = json.loads(out)
    missing = [f["where"] for f in report["findings"] if f["code"] == "missing_video"]
    assert missing == [f"videos/observation.images.{c}/chunk-000/file-000.mp4" for c in ("front", "top")]
    assert report["counts"]["error"] == 2
    assert report["threshold"]["clear"] is True
    assert 0.09 < report["threshold"]["threshold"] < 0.2  # between one encoder step and two
    assert [0.2 < e["still"] < 0.7 for e in report["episodes"]] == [True] * 4
    assert report["actions"]["kind"] == "absolute"
    assert 1 < np.mean(report["actions"]["mean_gap"]) < 5
    assert "No picture can be read" in (tmp_path / "page.html").read_text()


@real
def test_a_recording_without_a_gap(tmp_path, capsys):
    root = shutil.copytree(REAL / "g1_teleop_v21", tmp_path / "g1")
    with pytest.raises(DataError, match=r"v2\.1.*convert"):
        open_source("local/g1", str(root))
    convert_dataset("local/g1", root=root, push_to_hub=False)
    capsys.readouterr()
    out, _ = run(capsys, root, "--json", "--strict")
    report = json.loads(out)
    assert report["threshold"]["clear"] is False
    assert report["threshold"]["threshold"] < 0.003
    assert report["threshold"]["share"] < 0.15
    assert report["cameras"][0]["looked"] == 30
    assert report["cameras"][0]["frozen"] == report["cameras"][0]["black"] == []
    assert report["actions"]["kind"] == "absolute"
    assert report["jump_count"] == 0
