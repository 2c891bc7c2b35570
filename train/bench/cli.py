"""`cqn-bench`: runs of `cqn-train` over methods, tasks and seeds, several at a time, and what they come to together.

A run that is complete is not repeated, one that was cut off continues from its checkpoint: the same command again
finishes what is left. See `benchmarks/*.yaml` for plans.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live
from rich.table import Table

from cqn_data.terminal.console import explain
from lerobot_cqn.errors import ConfigError, CQNError, one_of

from .plan import Begin, Run, begin_here, load_plan, runs_of

if TYPE_CHECKING:
    from ..config import RaySettings

__all__ = ["HELP", "main"]

HELP = """cqn-bench: train every method on every task with every seed, then compare.

Usage: cqn-bench PLAN.yaml --output_dir=DIR [--processes=2] [--ray.address=HOST:PORT] [--report_only] [--debug]

A plan is a YAML file:

  common: [--steps=2400, --offline_updates=150, --threads=1]     # arguments of cqn-train for every run
  methods:
    cqn: [--policy.type=cqn, --policy.preset=laptop_state]
    cbc: [--policy.type=cqn, --policy.preset=laptop_state, --policy.rl_loss_scale=0, --relabel=false]
  tasks:
    click_button: [--env.type=ur5e_station, --env.task=click_button, --dataset.repo_id=local/click_f,
                   --dataset.root=data/click_f]
  seeds: [1, 2, 3]
  score: success_rate                                            # or mean_return, for tasks without success

DIR/TASK/METHOD/SEED is a run as cqn-train leaves it; DIR/results.csv, results.md, table.png, aggregate.png, curves.csv
and curves.png are made anew at the end (they need pip install 'lerobot_policy_cqn[bench]'). Ctrl-C stops all runs with
their checkpoints; the same command continues. With --ray.address (or "auto") the runs are made on the nodes of a Ray
cluster, as many at a time as it has processors; DIR, and the data, must be on a disk that all of them share.
"""
STOPS_WITHIN_S = 60.0  # seconds that runs have to save after Ctrl-C


def work(
    runs: Sequence[Run], processes: int, console: Console, score: str = "success_rate", begin: Begin = begin_here
) -> None:
    """Run all that are not done, `processes` at a time. Raises KeyboardInterrupt once all have stopped and saved."""
    for run in runs:
        run.state = "done" if run.done else "waiting"
    waiting = [run for run in runs if run.state != "done"]
    begun = time.monotonic()
    try:
        with Live(_table(runs, score), console=console, refresh_per_second=1) as live:
            while waiting or any(run.process for run in runs):
                running = [run for run in runs if run.process]
                for run in waiting[: processes - len(running)]:
                    run.start(begin)
                    waiting.remove(run)
                time.sleep(0.3)
                for run in running:
                    run.look()
                    if run.state not in ("running", "done"):
                        console.print(f"{run.task} / {run.method} / {run.seed} {run.state}: {run.last_words()}")
                live.update(_table(runs, score, time.monotonic() - begun))
    except KeyboardInterrupt:
        console.print("\nStopping: the runs are saving their checkpoints ...")
        _stop([run for run in runs if run.process])
        raise
    if not console.is_terminal:
        console.print()


def _work_on_ray(runs: Sequence[Run], settings: "RaySettings", processes: str, console: Console, score: str) -> None:
    """Run all on a cluster, as many at a time as it has processors. Raises ConfigError where it cannot be joined."""
    from ..cluster.connect import connected
    from ..cluster.remote_process import RemoteProcess, check_shared

    with connected(settings, 1) as ray:
        check_shared(ray, runs[0].folder.parents[2])
        there = int(ray.cluster_resources().get("CPU", 1))
        work(runs, int(processes or there), console, score, partial(RemoteProcess, ray))


def check(runs: Sequence[Run]) -> None:
    """Parse the arguments of every method on every task, before hours of work. Raises ConfigError for a bad one."""
    from lerobot.utils.import_utils import register_third_party_plugins

    from .. import envs  # noqa: F401  # registers our environments
    from ..arguments import parse

    register_third_party_plugins()
    seen = set()
    for run in runs:
        if (run.method, run.task) not in seen and run.state != "done":
            seen.add((run.method, run.task))
            try:
                parse([*run.arguments, f"--output_dir={run.folder}"]).validate()
            except CQNError as error:
                raise ConfigError(f"{run.task} / {run.method}: {error}") from error


def _stop(runs: Sequence[Run]) -> None:
    for run in runs:
        if run.process:
            run.process.send_signal(signal.SIGINT)
    deadline = time.monotonic() + STOPS_WITHIN_S
    for run in runs:
        if run.process:
            try:
                run.process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                run.process.kill()
                run.process.wait(STOPS_WITHIN_S)


def _table(runs: Sequence[Run], score: str, seconds: float = 0.0) -> Table:
    """Every run with its latest success rate; what is left of the time, judged by what is done."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("task", "method", "seed", "state", "step", score.replace("_", " ")):
        table.add_column(name)
    for run in runs:
        rows = run.rows()
        last = rows[-1] if rows else {}
        table.add_row(run.task, run.method, str(run.seed), run.state, last.get("env_steps", ""),
                      f"{float(last[score]):.2f}" if last else "")  # fmt: skip
    done = sum(run.state == "done" for run in runs)
    table.caption = f"{done} of {len(runs)} done, {seconds / 60:.0f} min"
    return table


def _options(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    known = ("--output_dir", "--processes", "--report_only", "--ray.address", "--ray.open_network")
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name not in known:
            raise ConfigError(one_of("option", name, known))
        yield name[2:], value


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cqn-bench`; returns 0, 1 when a run failed, 2 for an error of the user's, 130 after an interrupt."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    arguments = [a for a in arguments if a != "--debug"]
    console = Console(highlight=False, soft_wrap=True)
    if not arguments or "-h" in arguments or "--help" in arguments:
        console.print(HELP, markup=False)
        return 0
    try:
        if arguments[0].startswith("--"):
            raise ConfigError("Name a plan first: cqn-bench PLAN.yaml --output_dir=DIR.")
        options = dict(_options(arguments[1:]))
        if not options.get("output_dir"):
            raise ConfigError("No output directory: give --output_dir=DIR.")
        processes = options.get("processes", "" if "ray.address" in options else "2")
        if processes and (not processes.isdigit() or int(processes) < 1):
            raise ConfigError(f"Expected --processes of at least 1, got '{processes}'.")
        folder = Path(options["output_dir"])
        from .report import check_packages, write_report

        check_packages()
        plan = load_plan(Path(arguments[0]))
        runs = runs_of(plan, folder)
        if "report_only" not in options:
            check([run for run in runs if not run.done])
            if "ray.address" in options:
                from ..config import RaySettings

                settings = RaySettings(
                    actors=1, address=options["ray.address"], open_network=options.get("ray.open_network") == "true"
                )
                _work_on_ray(runs, settings, processes, console, plan.score)
            else:
                work(runs, int(processes), console, plan.score)
        write_report(plan, runs, folder, console)
    except KeyboardInterrupt:
        console.print("Stopped; the same command continues.")
        return 130
    except (CQNError, OSError) as error:
        return int(explain("cqn-bench", error, debug=debug))
    return int(any(run.state in ("failed", "stopped") for run in runs))


if __name__ == "__main__":
    sys.exit(main())
