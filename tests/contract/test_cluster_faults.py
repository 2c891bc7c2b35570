"""Learner and collectors that die at random moments: no finished episode is lost or stored twice."""

import random
import threading
from pathlib import Path
from typing import Any

import pytest
from draccus.options import ConfigType, Options

from cqn_train.arguments import parse
from cqn_train.cluster import fleet
from cqn_train.cluster.launch import settings_of
from cqn_train.cluster.learner import Learner
from cqn_train.replay.files import Journal

from ..threaded_calls import ThreadedCalls
from .conftest import TINY_RUN

RUN = [*TINY_RUN, "--eval.freq=0", "--save_freq=40", "--threads=1", "--ray.actors=3", "--ray.max_staleness=20"]


@pytest.fixture(autouse=True)
def each_thread_reads_settings_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draccus keeps the format it reads in one place for all threads; processes of Ray have one each."""
    local = threading.local()
    usual = Options.get_config_type()
    monkeypatch.setattr(Options, "get_config_type", staticmethod(lambda: getattr(local, "kind", usual)))

    def keep(kind: ConfigType | str) -> None:
        local.kind = ConfigType[kind.upper()] if isinstance(kind, str) else kind

    monkeypatch.setattr(Options, "set_config_type", staticmethod(keep))


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet, "RETRY_S", 0.05)
    monkeypatch.setattr(fleet, "PULSE_S", 0.02)


def notes(run: Path) -> list[dict[str, Any]]:
    """Rows of the stored episodes, in the order of storing."""
    return [place.note for _, place in Journal(run / "replay" / "episodes.jsonl").entries() if place]


def stored(run: Path) -> list[str]:
    return [note["key"] for note in notes(run)]


class Killed(BaseException):
    """The learner's process is gone."""


@pytest.mark.parametrize(("seed", "dies"), [(0, 0.0), (1, 0.1), (2, 0.3)])
def test_collectors_that_die_cost_no_finished_episode(click: list[str], tmp_path: Path, seed: int, dies: float) -> None:
    arguments = [*RUN, *click, "--steps=150", f"--output_dir={tmp_path / 'run'}"]
    calls = ThreadedCalls(settings_of(parse(arguments)), tmp_path / "kept", dies, seed)
    ended = Learner(arguments, calls, 1, str(Path.cwd())).run()
    assert (ended.code, ended.error) == (0, "")
    assert calls.deaths > 0 or not dies
    keys = stored(tmp_path / "run")
    assert sorted(keys) == sorted({*keys})
    assert {*keys} == {*calls.spool.seen}
    rows = notes(tmp_path / "run")
    assert len({row["episode"] for row in rows}) == len(rows)
    steps = [row["env_steps"] for row in rows]
    assert steps == sorted(steps)
    assert steps[-1] == sum(row["length"] for row in rows)


def test_a_learner_that_dies_takes_up_what_its_collectors_kept(
    click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The collectors live on, and finish what they were at."""
    arguments = [*RUN, *click, "--steps=250", f"--output_dir={tmp_path / 'run'}"]
    calls = ThreadedCalls(settings_of(parse(arguments)), tmp_path / "kept", 0.05, 3)
    rng, collect = random.Random(0), fleet.Fleet.collect

    def dies(self: fleet.Fleet, *given: Any) -> Any:
        finished = collect(self, *given)
        if rng.random() < 0.45:
            raise Killed  # an episode has come, and is not stored
        return finished

    monkeypatch.setattr(fleet.Fleet, "collect", dies)
    deaths = 0
    while True:
        try:
            ended = Learner(arguments, calls, 1, str(Path.cwd())).run()
            break
        except Killed:
            deaths += 1
            arguments = ["--resume=true", f"--output_dir={tmp_path / 'run'}"]
            if deaths == 6:
                monkeypatch.setattr(fleet.Fleet, "collect", collect)
    assert ended.code == 0, ended.error
    assert deaths > 2
    keys = stored(tmp_path / "run")
    assert sorted(keys) == sorted({*keys})
    assert {*keys} == {*calls.spool.seen}
    assert not list(calls.spool.folder.glob("*.npz"))


def test_a_collector_that_stalls_holds_up_nobody(
    click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither turns nor evaluations; what it was at is taken in once it goes on."""
    monkeypatch.setattr(fleet, "STALLED_S", 0.3)
    options = ["--steps=200", "--eval.freq=50", "--eval.n_episodes=4", f"--output_dir={tmp_path / 'run'}"]
    arguments = [*RUN, *click, *options]
    calls = ThreadedCalls(settings_of(parse(arguments)), tmp_path / "kept")
    goes_on, stalled = threading.Event(), []

    def stall(index: int, method: str) -> None:
        if index == 1 and method in ("act", "evaluate", "pulse") and (stalled or calls.spool.seen):
            stalled.append(method)
            goes_on.wait(60)

    calls.before = stall
    said: list[str] = []
    message = Learner.message

    def hear(self: Learner, text: str) -> None:
        said.append(text)
        if "online" in text:  # an evaluation was made without it
            goes_on.set()
        message(self, text)

    monkeypatch.setattr(Learner, "message", hear)
    ended = Learner(arguments, calls, 1, str(Path.cwd())).run()
    assert (ended.code, ended.error) == (0, "")
    assert stalled
    assert any("Collector 1 is lost (no sign of life" in text for text in said)
    keys = stored(tmp_path / "run")
    assert sorted(keys) == sorted({*keys})


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(30))
def test_collectors_that_die_often(click: list[str], tmp_path: Path, seed: int) -> None:
    dies = random.Random(seed).uniform(0.02, 0.5)
    test_collectors_that_die_cost_no_finished_episode(click, tmp_path, seed + 100, dies)
