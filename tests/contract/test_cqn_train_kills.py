"""`kill -9` at any moment of online training: what `--resume` finds and how it goes on."""

import contextlib
import itertools
import os
import random
import resource
import shutil
import signal
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cqn_train.cli import main
from cqn_train.loop.gym_env import GymEnvironment
from cqn_train.replay.files import Journal, Place
from cqn_train.run import checkpoint
from cqn_train.run.checkpoint import last_checkpoint, stored_episodes
from lerobot_cqn.errors import ConfigError

from .conftest import TINY_RUN
from .test_cqn_train import assert_same_run, tables
from .zygote import Zygote, wait_until

KILLS = 8  # of one run; 200 in ten runs are in the slow suite


@pytest.mark.parametrize("saves", [1, 2, 4])
def test_killed_at_a_checkpoint_and_resumed_equals_uninterrupted(
    straight: Path, click: list[str], tmp_path: Path, saves: int, processes: Zygote
) -> None:
    run = tmp_path / "run"
    process = processes.start("cqn-train", *TINY_RUN, *click, f"--output_dir={run}", dies_after_save=saves)
    assert os.WTERMSIG(processes.wait(process)) == signal.SIGKILL
    assert main(["--resume=true", f"--output_dir={run}"]) == 0
    assert_same_run(straight, run)


def test_killed_at_random_moments_it_loses_no_finished_episode(
    click: list[str], tmp_path: Path, processes: Zygote
) -> None:
    run, rng = tmp_path / "run", random.Random(0)
    journal = Journal(run / "replay" / "episodes.jsonl")
    steps = "--steps=100000"

    def finished() -> list[Place]:
        journal.repair()  # only while nobody writes: it would cut off what comes between its reading and cutting
        return [place for _, place in journal.entries() if place is not None]

    def completed() -> int:
        return journal.path.read_bytes().count(b'{"episode"') if journal.path.is_file() else 0

    process = processes.start(
        "cqn-train", *TINY_RUN, *click, steps, "--save_freq=70", "--eval.freq=0", f"--output_dir={run}"
    )
    wait_until((run / "checkpoints" / "last").exists)
    before = 0
    for kill in range(KILLS):
        here = completed()
        wait_until(lambda here=here: completed() > here)
        time.sleep(rng.uniform(0, 0.15))
        processes.kill(process)
        places = finished()
        assert [p.number for p in places] == list(range(len(places)))
        assert len(places) > before
        before = len(places)
        rows = [int(row["episode"]) for row in tables(run)["episodes"]]
        assert rows == list(range(len(rows)))
        if kill < KILLS - 1:
            process = processes.start("cqn-train", "--resume=true", f"--output_dir={run}")
    total = sum(place.length for place in finished())
    assert main(["--resume=true", f"--output_dir={run}", f"--steps={total}"]) == 0
    episodes = tables(run)["episodes"]
    assert [int(row["episode"]) for row in episodes] == list(range(before))
    assert [int(row["length"]) for row in episodes] == [place.length for place in finished()]
    assert int(episodes[-1]["env_steps"]) == total
    assert int(tables(run)["evaluations"][-1]["env_steps"]) == total


def kill_in_phases(run: Path, arguments: list[str], processes: Zygote, phases: list[str], rng: random.Random) -> None:
    """Kill in each phase in turn, soon after something shows that it is there, and go on by the same command.

    That is: anew while there is no checkpoint, else --resume. No finished episode is missing after any of the kills.
    """
    last, evaluations = run / "checkpoints" / "last", run / "evaluations.csv"
    journal, log = Journal(run / "replay" / "episodes.jsonl"), run.parent / "log.txt"

    def lines(path: Path, what: bytes) -> int:
        return path.read_bytes().count(what) if path.is_file() else 0

    numbers = 0
    process = processes.start("cqn-train", *arguments, out=str(log.with_name("said.txt")), err=str(log))
    for phase in phases:
        before = lines(journal.path, b'{"episode"'), lines(evaluations, b"\n")
        there = {
            "beginning": (run / ".begun").exists,
            "offline": last.exists,
            "online": lambda before=before: lines(journal.path, b'{"episode"') > before[0],
            "evaluating": lambda before=before: lines(evaluations, b"\n") > before[1],
            "saving": lambda: any((run / "checkpoints").glob(".*.tmp")),
        }[phase]
        wait_until(there)
        time.sleep(rng.uniform(0, 0.1) * (phase not in ("beginning", "saving")))
        processes.kill(process)
        assert "error" not in log.read_text()
        journal.repair()
        found = {place.number for _, place in journal.entries() if place is not None}
        assert len(found) >= numbers, "a finished episode is gone"
        numbers = len(found)
        again = ["--resume=true", f"--output_dir={run}"] if last.exists() else arguments
        process = processes.start("cqn-train", *again, out=str(log.with_name("said.txt")), err=str(log))
    wait_until(last.exists)
    processes.kill(process)
    assert main(["--resume=true", f"--output_dir={run}", "--steps=1"]) == 0
    rows = [int(row["episode"]) for row in tables(run)["episodes"]]
    assert rows == list(range(len(rows)))
    assert len(rows) >= numbers


PHASES = ["--offline_updates=60", "--steps=100000", "--save_freq=40", "--eval.freq=60", "--eval.final_n_episodes=1"]


def test_killed_in_any_phase_it_goes_on(click: list[str], tmp_path: Path, processes: Zygote) -> None:
    run = tmp_path / "run"
    phases = ["beginning", "beginning", "offline", "offline", "online", "saving", "evaluating", "online", "saving"]
    kill_in_phases(run, [*TINY_RUN, *click, *PHASES, f"--output_dir={run}"], processes, phases, random.Random(1))


@pytest.mark.slow
def test_killed_at_two_hundred_moments_it_goes_on(click: list[str], tmp_path: Path, processes: Zygote) -> None:
    rng = random.Random(2)
    for number in range(10):
        run = tmp_path / f"run{number}"
        later = [rng.choice(["online", "saving", "evaluating"]) for _ in range(14)]
        phases = [*["beginning"] * 3, *["offline"] * 3, *later]
        arguments = [*TINY_RUN, *click, *PHASES, f"--seed={number}", f"--output_dir={run}"]
        kill_in_phases(run, arguments, processes, phases, rng)


def test_a_run_can_be_continued_from_its_offline_phase(
    click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Checkpoints on the way through it change nothing of what is learned."""
    from cqn_train.loop import trainer

    options = [*TINY_RUN, *click, "--offline_updates=30", "--steps=0", "--eval.final_n_episodes=0"]
    assert main([*options, f"--output_dir={tmp_path / 'straight'}"]) == 0
    monkeypatch.setattr(trainer, "OFFLINE_SAVE_S", 0.0)
    saves, write = [], checkpoint.save

    def killed_after_some(*args: Any, **kwargs: Any) -> Path:
        saves.append(args[4].updates)
        written = write(*args, **kwargs)
        if len(saves) == 12:
            raise KeyboardInterrupt
        return written

    monkeypatch.setattr("cqn_train.build.save", killed_after_some)
    assert main([*options, f"--output_dir={tmp_path / 'run'}"]) == 130
    assert saves[0] == 0
    assert 0 < saves[-1] < 30
    assert main(["--resume=true", f"--output_dir={tmp_path / 'run'}"]) == 0
    assert_same_run(tmp_path / "straight", tmp_path / "run")


def test_the_same_command_works_again_after_a_beginning_that_failed(
    click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    options = [
        *TINY_RUN,
        *click,
        "--offline_updates=1",
        "--steps=0",
        "--eval.final_n_episodes=0",
        f"--output_dir={run}",
    ]

    for error in (ConfigError("The robot cannot be connected."), OSError("The camera is gone.")):

        def fail(_: Any, error: Exception = error) -> None:
            raise error

        with monkeypatch.context() as broken:
            broken.setattr(GymEnvironment, "open", fail, raising=False)
            assert main(options) == 2
    assert main(options) == 0
    assert main(options) == 2  # now it holds a run
    assert "exists and is not empty" in capsys.readouterr().err
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.txt").write_text("mine")
    (other / ".begun").touch()
    assert main([*options[:-1], f"--output_dir={other}"]) == 2
    assert (other / "thesis.txt").read_text() == "mine"


def test_a_nearly_full_disk_is_said_before_anything_is_written_and_ends_a_run_in_order(
    click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    options = [*TINY_RUN, *click, "--eval.freq=0", "--save_freq=100000", f"--output_dir={run}"]
    free = iter([0])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=next(free)))
    assert main(options) == 2
    assert "nearly full: 0 MiB are free, expected 64 MiB" in capsys.readouterr().err
    assert not run.exists()
    free = iter([10**12, 10**12, 0])  # at the start, after the first episode, after the second
    assert main(options) == 2
    assert "--resume=true" in capsys.readouterr().err
    assert len(tables(run)["episodes"]) == 2
    monkeypatch.undo()
    assert main(["--resume=true", f"--output_dir={run}", "--eval.final_n_episodes=0"]) == 0
    assert [int(row["episode"]) for row in tables(run)["episodes"]][:2] == [0, 1]


def test_without_descriptors_left_it_saves_what_it_has(
    click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A leak of somebody else's (a camera that is opened again and again) costs no episode and no update."""
    run, taken = tmp_path / "run", list[int]()
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    step, steps = GymEnvironment.step, itertools.count()

    def leaking(env: GymEnvironment, action: Any) -> Any:
        if next(steps) == 40:
            resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 50, before[1]))
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.open(os.devnull, os.O_RDONLY))
        return step(env, action)

    monkeypatch.setattr(GymEnvironment, "step", leaking)
    try:
        code = main([*TINY_RUN, *click, "--save_freq=100000", "--eval.freq=0", f"--output_dir={run}"])
    finally:
        for number in taken:
            os.close(number)
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert code == 2
    assert "Too many open files" in capsys.readouterr().err
    found = last_checkpoint(run).resolve()
    assert int(found.name) > 0
    finished = [place.number for _, place in Journal(run / "replay" / "episodes.jsonl").entries() if place is not None]
    assert stored_episodes(found) >= {number for number in finished if number >= 0}
    monkeypatch.undo()
    assert main(["--resume=true", f"--output_dir={run}", "--eval.final_n_episodes=0"]) == 0
    rows = [int(row["episode"]) for row in tables(run)["episodes"]]
    assert rows == list(range(len(rows)))


def test_a_damaged_replay_is_said_and_accepted_on_request(
    click: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main([*TINY_RUN, *click, "--eval.freq=0", "--eval.final_n_episodes=0", f"--output_dir={run}"]) == 0
    capsys.readouterr()
    (run / "replay" / "action.bin").write_bytes(b"")
    again = ["--resume=true", f"--output_dir={run}", "--steps=70"]
    assert main(again) == 2
    assert "action.bin is cut off" in capsys.readouterr().err
    assert main([*again, "--replay.accept_loss=true"]) == 0
    assert "0 are left" in capsys.readouterr().out
