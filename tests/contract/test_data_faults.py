"""Kills, full disks and other misfortunes: the target is complete or absent, the source is as it was."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from cqn_data.cli import main

from .zygote import wait_until, zygote

CODE = "import sys; from cqn_data.cli import main; sys.exit(main(sys.argv[1:]))"
SIDE, LENGTHS = 64, (40, 40, 40)
# Shares of the time that an undisturbed run takes, at which the process is killed.
MOMENTS = (0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95, 1.0)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    root = tmp_path_factory.mktemp("faults") / "src"
    vector = {"dtype": "float32", "shape": (2,), "names": ["pan.pos", "gripper.pos"]}
    camera = {"dtype": "video", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, "observation.images.top": camera}
    encoder = RGBEncoderConfig(vcodec="h264", crf=5, g=2)
    dataset = LeRobotDataset.create("local/src", 30, features, root=root, rgb_encoder=encoder)
    rng = np.random.default_rng(0)
    for length in LENGTHS:
        for step in range(length):
            state = np.array([0.1 * step, 0.0], np.float32)
            picture = rng.integers(0, 255, (SIDE, SIDE, 3), np.uint8)
            frame = {"observation.state": state, "action": state + 0.1, "observation.images.top": picture}
            dataset.add_frame({**frame, "task": "go"})
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    return root


def snapshot(root):
    return {str(p): (p.stat().st_mtime_ns, p.read_bytes()) for p in sorted(root.rglob("*")) if p.is_file()}


def start(source, target, *options, **more):
    names = ["--repo_id=local/src", f"--root={source}", "--new_repo_id=local/dst", f"--new_root={target}"]
    arguments = [sys.executable, "-c", CODE, "resize", *names, "--size=[32,32]", *options]
    return subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **more)


def arguments(source, target):
    names = ["--repo_id=local/src", f"--root={source}", "--new_repo_id=local/dst", f"--new_root={target}"]
    return ["resize", *names, "--size=[32,32]"]


def complete(target):
    dataset = LeRobotDataset("local/dst", target)
    assert (dataset.num_episodes, dataset.num_frames) == (3, sum(LENGTHS))
    assert tuple(dataset[119]["observation.images.top"].shape) == (3, 32, 32)
    assert json.loads((target / "meta/cqn_history.json").read_text())["operations"]


@pytest.mark.real_time(reason="the kills come at shares of the time that a run takes")
def test_killed_at_any_moment_the_target_is_complete_or_absent_and_the_next_run_tidies_up(recording, tmp_path):
    before = snapshot(recording)
    folder = tmp_path / "out"
    folder.mkdir()
    target = folder / "dst"
    preload = "cqn_data.cli, cqn_data.disk.encode, cqn_data.disk.readable"
    with zygote(tmp_path / "log", preload) as processes:
        begun = time.monotonic()
        process = processes.start("cqn-data", *arguments(recording, target))
        assert processes.wait(process) == 0
        took = time.monotonic() - begun
        complete(target)
        absent = left = 0
        for moment in MOMENTS:
            shutil.rmtree(target, ignore_errors=True)
            process = processes.start("cqn-data", *arguments(recording, target))
            time.sleep(moment * took)
            processes.kill(process)
            if target.exists():
                complete(target)
            absent += not target.exists()
            left += any(folder.glob(".dst.*.tmp"))
            assert snapshot(recording) == before
    assert absent >= len(MOMENTS) // 3, "hardly any kill came in time; the moments are wrong"
    assert left, "no kill left anything; the moments are wrong"
    shutil.rmtree(target, ignore_errors=True)
    (folder / f".dst.{process}.tmp" / "videos").mkdir(parents=True, exist_ok=True)
    done = start(recording, target)
    _, err = done.communicate(timeout=120)
    assert done.returncode == 0, err
    assert "which a killed process left behind" in err
    complete(target)
    assert [p.name for p in folder.iterdir()] == ["dst"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_by_a_person_it_leaves_nothing(recording, tmp_path, number, processes):
    folder, said = tmp_path / "out", tmp_path / "err"
    folder.mkdir()
    process = processes.start("cqn-data", *arguments(recording, folder / "dst"), err=str(said))
    wait_until(lambda: any(folder.glob(".dst.*.tmp/videos")) or (folder / "dst").exists())
    os.kill(process, number)
    code, err = os.waitstatus_to_exitcode(processes.wait(process)), said.read_text()
    if code == 0:
        pytest.skip("it was done before the signal came")
    assert code == 130
    assert "nothing was written" in err
    assert "Traceback" not in err
    assert list(folder.iterdir()) == []


def test_a_disk_that_takes_no_more_is_named_in_one_line(recording, tmp_path):
    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # write() fails instead, as on a full disk
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    process = start(recording, tmp_path / "dst", preexec_fn=limit)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 2, err
    assert err.count("\n") == 1, err
    assert "could not be written" in err
    assert "File too large" in err
    assert not (tmp_path / "dst").exists()
    assert not list(tmp_path.glob(".dst.*"))


def test_a_place_that_cannot_be_written_to_is_named(recording, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    for target in ("/proc/nowhere/dst", str(tmp_path / "file" / "dst")):
        names = ["--repo_id=local/src", f"--root={recording}", f"--new_root={target}", "--size=[32,32]"]
        assert main(["resize", *names]) == 2
        assert "Nothing can be written to" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "mine"


def test_two_runs_for_one_place_do_not_mix(recording, tmp_path, processes):
    target, said = tmp_path / "dst", [tmp_path / "one", tmp_path / "other"]
    runs = [processes.start("cqn-data", *arguments(recording, target), err=str(err)) for err in said]
    codes = [os.waitstatus_to_exitcode(processes.wait(run)) for run in runs]
    assert all("Traceback" not in err.read_text() for err in said)
    assert sorted(codes) == [0, 2]
    complete(target)
