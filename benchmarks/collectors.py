"""What a learner takes in from many arms: real collectors up to the machine's cores, and arms that only sleep.

    python -m benchmarks.collectors simulators --counts=1,2,4         # cqn-train on a simulator, steps a second
    python -m benchmarks.collectors arms --counts=8,64 --seconds=60   # arms of 10 Hz with four cameras of 84x84
    python -m benchmarks.collectors arms --counts=64 --hurry          # the same without sleeping: the limit

The arms of the second are threads of a few Ray processes: they sleep as long as an episode takes, and send episodes of
the true size through the object store. The learner's side is the real one: `Fleet`, and a replay on disk.
"""

import argparse
import csv
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from cqn_train.cluster.collector import Description, Done, Fit, Pulse, versions
from cqn_train.cluster.connect import RayCalls, connected
from cqn_train.cluster.fleet import Fleet
from cqn_train.config import RaySettings
from cqn_train.loop.acting import Finished, Turn
from cqn_train.replay.buffer import Replay
from cqn_train.replay.episode import Episode

STEPS, HZ, VIEWS, SIZE = 100, 10.0, 4, 84  # of an episode
PER_PROCESS = 8  # arms in one of Ray's processes: their own code is a sleep
WEIGHTS = 20 * 2**20  # bytes that acting needs, those of the paper's network for RLBench


class SleepingArm:
    """An arm that takes as long as a real one and does nothing."""

    def __init__(self, index: int, hurry: bool) -> None:
        self._index, self._hurry, self._since = index, hurry, time.monotonic()
        rng = np.random.default_rng(index)
        views = tuple(rng.integers(0, 256, (STEPS + 1, 3, SIZE, SIZE), dtype=np.uint8) for _ in range(VIEWS))
        self._episode = Episode(
            low_dim=np.zeros((STEPS + 1, 8), np.float32), pixels=views, action=np.zeros((STEPS, 7), np.float32),
            reward=np.zeros(STEPS, np.float32), terminated=False, success=False,
        )  # fmt: skip

    def describe(self) -> Description:
        return Description(host="arm", versions=versions(), bounds=None)

    def equip(self, *_: Any) -> Fit:
        return Fit(fps=int(HZ), max_steps=STEPS)

    def unstored(self, _: str) -> list[Finished]:
        return []

    def act(self, turn: Turn, weights: Any, *_: Any) -> Done:
        began = time.monotonic()
        idle, _bytes = began - self._since, sum(part.nbytes for part in weights.values())
        if not self._hurry:
            time.sleep(STEPS / HZ)
        self._since = time.monotonic()
        finished = Finished(turn=turn, episode=self._episode, success=False, discarded=False, values=np.zeros(STEPS))
        return Done(finished=finished, random_state=np.zeros(1, np.uint8), acted_s=self._since - began, idle_s=idle)

    def pulse(self, _: str) -> Pulse:
        return Pulse(corrected={}, said=(), doing="")


class SleepingArms:
    """Several of them in one process, each in a thread."""

    def __init__(self, first: int, count: int, hurry: bool) -> None:
        self._arms = {index: SleepingArm(index, hurry) for index in range(first, first + count)}

    def call(self, index: int, method: str, *arguments: Any) -> Any:
        return getattr(self._arms[index], method, lambda *_: None)(*arguments)


class Calls(RayCalls):
    """The way to them."""

    def call(self, collector: int, method: str, *arguments: Any) -> Any:
        return self._handles[collector // PER_PROCESS].call.remote(collector, method, *arguments)


class Asked:
    """What `Fleet` wants of a policy: weights of a true size."""

    def __init__(self) -> None:
        self.weights = {"all": np.zeros(WEIGHTS // 4, np.float32)}


def arms(count: int, seconds: float, hurry: bool) -> dict[str, Any]:
    """Let so many arms act for so long, and store what they send."""
    from cqn_train.cluster import fleet as module

    module.weights_of = lambda agent: agent.weights  # type: ignore[assignment, attr-defined]
    processes = -(-count // PER_PROCESS)
    with connected(RaySettings(actors=count), count) as ray, tempfile.TemporaryDirectory() as folder:
        actor = ray.remote(num_cpus=0, max_concurrency=2 * PER_PROCESS)(SleepingArms)
        handles = [actor.remote(i * PER_PROCESS, PER_PROCESS, hurry) for i in range(processes)]
        fleet = Fleet(
            calls=Calls(handles), count=count, max_staleness=16, worth=lambda _: 1, steps_apart=False,
            run_id=lambda: "bench", say=print, should_stop=lambda: False,
        )  # fmt: skip
        fleet.describe()
        fleet._files = 0
        for seat in fleet.seats:
            fleet._ask(seat, "equip", 0, None)
        fleet.open(())
        replay, agent, turns = Replay(1, 3, 0.99, folder=Path(folder) / "replay"), Asked(), iter(range(10**9))
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
        began, stored, storing = time.monotonic(), 0, 0.0
        while time.monotonic() - began < seconds:
            finished = fleet.collect(
                agent,  # type: ignore[arg-type]
                lambda _: Turn(number=next(turns), seed=0, steps=0),
                lambda _: None,
            )
            before = time.monotonic()
            assert finished.episode is not None  # noqa: S101  # they all have steps
            replay.add(finished.episode, demo=False, number=stored)
            fleet._weights = None  # as if there had been updates
            storing += time.monotonic() - before
            stored += 1
        passed = time.monotonic() - began
        size = sum(rows.nbytes for rows in finished.episode.arrays().values()) / 2**20
        return {
            "arms": count, "hurry": int(hurry), "episodes_s": stored / passed, "steps_s": stored * STEPS / passed,
            "mib_s": stored * size / passed, "learner_waits": fleet._learner_s / passed, "storing": storing / passed,
            "arms_wait": fleet._idle_s / max(1e-9, fleet._idle_s + fleet._acted_s),
            "memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10 - memory,
        }  # fmt: skip


def simulators(count: int, steps: int) -> dict[str, Any]:
    """Control steps a second of cqn-train on a simulator, imports and evaluations not counted; 0: in one process."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [
            sys.executable, "-m", "cqn_train.cli", "--policy.type=cqn", "--policy.preset=practice_state",
            "--policy.device=cpu", "--env.type=ur5e_station", "--env.obs_type=state", "--action_bounds=environment",
            "--demo_batch_size=0", f"--steps={steps}", "--eval.freq=0", "--eval.final_n_episodes=0", "--threads=1",
            *([f"--ray.actors={count}"] if count else []), f"--output_dir={run}",
        ]  # fmt: skip
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        with (run / "episodes.csv").open() as file:
            rows = list(csv.DictReader(file))
    first, last = rows[len(rows) // 5], rows[-1]
    wall = float(last["wall_s"]) - float(first["wall_s"])
    return {"collectors": count, "steps_s": (int(last["env_steps"]) - int(first["env_steps"])) / wall}


def main() -> None:
    """Measure, and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("simulators", "arms"))
    parser.add_argument("--counts", default="1,2")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--hurry", action="store_true", help="arms that do not sleep")
    given = parser.parse_args()
    for count in map(int, given.counts.split(",")):
        row = arms(count, given.seconds, given.hurry) if given.what == "arms" else simulators(count, given.steps)
        print("  ".join(f"{name} {value:.3g}" for name, value in row.items()), flush=True)


if __name__ == "__main__":
    main()
