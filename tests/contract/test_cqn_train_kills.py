"""`kill -9` at any moment of online training: what `--resume` finds and how it goes on."""

import os
import random
import signal
import time
from pathlib import Path

import pytest

from cqn_train.cli import main
from cqn_train.replay.files import Journal, Place

from .conftest import TINY_RUN
from .test_cqn_train import assert_same_run, tables
from .zygote import Zygote, wait_until


@pytest.mark.parametrize("saves", [1, 2, 4])
def test_killed_at_a_checkpoint_and_resumed_equals_uninterrupted(
    straight: Path, click: list[str], tmp_path: Path, saves: int, processes: Zygote
) -> None:
    run = tmp_path / "run"
    process = processes.start("cqn-train", *TINY_RUN, *click, f"--output_dir={run}", dies_after_save=saves)
    assert os.WTERMSIG(processes.wait(process)) == signal.SIGKILL
    assert main(["--resume=true", f"--output_dir={run}"]) == 0
    assert_same_run(straight, run)


def test_killed_at_twenty_random_moments_it_loses_no_finished_episode(
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
    for kill in range(20):
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
        if kill < 19:
            process = processes.start("cqn-train", "--resume=true", f"--output_dir={run}")
    total = sum(place.length for place in finished())
    assert main(["--resume=true", f"--output_dir={run}", f"--steps={total}"]) == 0
    episodes = tables(run)["episodes"]
    assert [int(row["episode"]) for row in episodes] == list(range(before))
    assert [int(row["length"]) for row in episodes] == [place.length for place in finished()]
    assert int(episodes[-1]["env_steps"]) == total
    assert int(tables(run)["evaluations"][-1]["env_steps"]) == total
