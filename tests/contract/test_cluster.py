"""`cqn-train --ray.actors=N` over Ray itself: the same run as in one process, processes that are killed, refusals."""

import socket
import sys
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from cqn_train.cli import main
from cqn_train.replay.files import Journal

from .conftest import TINY_RUN
from .test_cqn_train import assert_same_run, tables
from .zygote import Zygote, wait_until

TURNS = ["--threads=1", "--ray.actors=1", "--ray.max_staleness=0"]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def stored(run: Path) -> list[str]:
    journal = Journal(run / "replay" / "episodes.jsonl")
    return [place.note["key"] for _, place in journal.entries() if place is not None]


def descendants(number: int, begin: str = "") -> list[psutil.Process]:
    """Processes that a command started, whose title begins so."""
    found = []
    for process in psutil.Process(number).children(recursive=True):
        try:
            if " ".join(process.cmdline()).startswith(begin):
                found.append(process)
        except psutil.Error:
            continue
    return found


def kill_one(number: int, begin: str) -> None:
    wait_until(lambda: bool(descendants(number, begin)))
    descendants(number, begin)[0].kill()


def test_in_turns_with_one_collector_a_run_is_that_of_one_process(
    straight: Path, click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every row of every table, and every weight: an update after each control step, and evaluations."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    run = Path("run")
    assert main([*TINY_RUN, *click, *TURNS, f"--output_dir={run}"]) == 0
    assert_same_run(straight, run)
    assert len(stored(run)) == 6
    assert not list((tmp_path / "cache").rglob("*.npz"))
    # The run goes on in one process as well.
    assert main(["--resume=true", "--ray.actors=0", "--steps=70", f"--output_dir={run}"]) == 0
    assert int(tables(run)["evaluations"][-1]["env_steps"]) == 70


def test_killed_processes_cost_no_finished_episode(
    click: list[str], tmp_path: Path, processes: Zygote, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A collector, the learner, then the command itself; meanwhile no port is open to other machines."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    run, out = tmp_path / "run", tmp_path / "out"
    options = ["--steps=100000", "--eval.freq=0", "--save_freq=40", "--threads=1", "--ray.actors=2"]

    def more_than(count: int) -> Callable[[], bool]:
        path = run / "replay" / "episodes.jsonl"
        return lambda: path.is_file() and path.read_bytes().count(b'{"episode": {') > count

    process = processes.start(
        "cqn-train", *TINY_RUN, *click, *options, f"--output_dir={run}", out=str(out), err=str(out)
    )
    try:
        wait_until(more_than(3), 180)
        listening = [one for one in psutil.net_connections("inet") if one.status == psutil.CONN_LISTEN]
        ours = {one.pid for one in descendants(process)}
        addresses = {one.laddr.ip.removeprefix("::ffff:") for one in listening if one.pid in ours}
        assert addresses == {"127.0.0.1"}
        for begin in ("ray::Collector", "ray::Learner"):
            kill_one(process, begin)
            if begin == "ray::Collector":
                wait_until(lambda: "is lost" in out.read_text(), 120)
            before = len(stored(run))
            wait_until(more_than(before + 6), 180)
        rays = [*descendants(process, "ray::Collector"), *descendants(process, "ray::Learner")]
        assert len(rays) >= 2  # a collector may still be on its way back
    finally:
        processes.kill(process)
    before = stored(run)
    assert len(before) == len({*before})
    psutil.wait_procs(rays, timeout=30)
    assert not [one for one in rays if one.is_running() and one.status() != psutil.STATUS_ZOMBIE]
    said = out.read_text()
    assert "The learner's process died: another one goes on from the last checkpoint." in said
    steps = sum(place.length for _, place in Journal(run / "replay" / "episodes.jsonl").entries() if place)
    assert main(["--resume=true", f"--output_dir={run}", f"--steps={steps + 20}"]) == 0
    keys = stored(run)
    assert len(keys) == len({*keys})
    assert {*before} <= {*keys}
    rows = tables(run)["episodes"]
    assert len({row["episode"] for row in rows}) == len(rows) == len(keys)
    assert sum(int(row["length"]) for row in rows) == int(rows[-1]["env_steps"]) >= steps + 20
    assert not list((tmp_path / "cache").rglob("*.npz"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--ray.address=127.0.0.1:1"], "--ray.address=127.0.0.1:1 cannot be joined"),
        (["--ray.address=10.1.2.3:6379"], "would be joined without a token"),
        (["--ray.address=auto"], "would be joined without a token"),
        (["--ray.each=[{robot.prot: a}]"], "there is no setting 'robot.prot'"),
        (["--ray.each=[{}, {}]"], "--ray.each has 2 entries for --ray.actors=1"),
        (["--async_updates=5"], "leave out --async_updates"),
        (["--ray.actors=0", "--ray.device=cuda"], "--ray.… has no effect without collectors"),
        (["--ray.max_stalenes=3"], "max_staleness"),
    ],
)
def test_what_cannot_be_is_said_in_a_line_before_anything_starts(
    click: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    options: list[str], said: str,
) -> None:  # fmt: skip
    monkeypatch.setenv("RAY_raylet_start_wait_time_s", "3")
    assert main([*TINY_RUN, *click, "--ray.actors=1", *options, f"--output_dir={tmp_path / 'run'}"]) == 2
    shown = capsys.readouterr().err.strip().splitlines()
    assert said in shown[-1]
    assert not (tmp_path / "run").exists()


def test_without_the_extra_it_says_what_to_install(
    click: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main([*TINY_RUN, *click, "--ray.actors=1", f"--output_dir={tmp_path / 'run'}"]) == 2
    assert "pip install 'lerobot_policy_cqn[ray]'" in capsys.readouterr().err


def test_an_error_of_a_collector_is_a_line_and_nothing_is_left(
    click: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    each = "--ray.each=[{env.episode_length: 20}]"
    assert main([*TINY_RUN, *click, "--ray.actors=2", each, f"--output_dir={run}"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "steps an episode" in error
    assert "10" in error
    assert "20" in error
    assert not (run / "checkpoints").exists()  # so that the same command begins again
