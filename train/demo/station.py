"""`make demo`: paused demonstrations -> pause filter -> CQN offline -> CQN online, with and without the filter.

Runs the same commands a user would type, two trainings at a time on one thread each, and draws a report.
Interrupted at any moment, it continues where it was when started again.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ..run.metrics import read_rows
from .config import DemoConfig
from .stages import Stages, Watched, fresh, run_once

__all__ = ["main", "run_demo"]

VARIANTS = {"filtered": "pauses dropped", "unfiltered": "pauses kept"}
ENV = ("--env.type=ur5e_station", "--env.task=click_button")


def run_demo(config: DemoConfig, console: Console) -> dict[str, Any]:
    """The demo from recording to report; returns what `summary.json` holds. Raises DemoError when a command fails."""
    from .report import write_report

    stages = Stages(config.output_dir, console)
    with stages.timed():
        _prepare_and_train(stages, config)
    with console.status("  drawing the report"):
        return write_report(config, VARIANTS, stages.seconds())


def _prepare_and_train(stages: Stages, config: DemoConfig) -> None:
    data = {name: config.output_dir / "data" / name for name in VARIANTS}
    report = config.output_dir / "dropped.json"
    stages.run(
        "record", f"recording {config.demonstrations} demonstrations, {config.pause_share:.0%} pauses",
        data["unfiltered"], "cqn_data.cli", "record", *ENV, "--repo_id=demo/unfiltered",
        f"--root={data['unfiltered']}", f"--episodes={config.demonstrations}", f"--pause_share={config.pause_share}",
        f"--seed={config.seed}",
    )  # fmt: skip
    stages.run(
        "filter", "dropping the pauses", data["filtered"], "cqn_data.cli", "run", "simulation",
        "--repo_id=demo/unfiltered", f"--root={data['unfiltered']}", "--new_repo_id=demo/filtered",
        f"--new_root={data['filtered']}", f"--report={report}",
    )  # fmt: skip
    train(stages, config, data)


def train(stages: Stages, config: DemoConfig, data: dict[str, Path]) -> None:
    """Train both variants side by side, with one progress bar each."""
    running: dict[str, Watched] = {}
    total = config.offline_updates + config.steps
    for name, variant in VARIANTS.items():
        run = config.output_dir / name
        if _finished(run):
            continue
        if (run / "checkpoints" / "last").exists():
            arguments = ["--resume=true", f"--output_dir={run}"]
        else:
            arguments = [
                "--policy.type=cqn", "--policy.preset=laptop_state", "--policy.device=cpu", *ENV,
                f"--dataset.repo_id=demo/{name}", f"--dataset.root={data[name]}", f"--output_dir={fresh(run)}",
                f"--seed={config.seed}", f"--offline_updates={config.offline_updates}", f"--steps={config.steps}",
                f"--eval.freq={config.eval_freq}", f"--eval.n_episodes={config.eval_episodes}",
                f"--eval.final_n_episodes={config.final_episodes}", "--save_freq=1000", "--threads=1",
            ]  # fmt: skip
        running[name] = Watched(
            process=stages.start(name, "cqn_train.cli", *arguments), text=f"training, {variant}", total=total,
            progress=partial(_progress, run, config),
        )  # fmt: skip
    stages.watch(running)


def _finished(run: Path) -> bool:
    return any(row["phase"] == "final" for row in read_rows(run / "evaluations.csv"))


def _progress(run: Path, config: DemoConfig) -> tuple[int, str]:
    updates, evaluations = read_rows(run / "updates.csv"), read_rows(run / "evaluations.csv")
    if not updates:
        return 0, "loading"
    offline = min(int(updates[-1]["updates"]), config.offline_updates)
    note = f"success {float(evaluations[-1]['success_rate']):.2f}" if evaluations else "offline"
    return offline + int(updates[-1]["env_steps"]), note


def show(summary: dict[str, Any], config: DemoConfig, console: Console) -> None:
    """The short table at the end."""
    table = Table(title="click_button, success over evaluation episodes", title_justify="left")
    for column in ("demonstrations", "steps", "after offline", "after online", "95 % interval"):
        table.add_column(column, justify="left" if column == "demonstrations" else "right")
    expert = summary["expert"]
    table.add_row("scripted expert", "", "", _rate(expert), _interval(expert))
    for name, text in VARIANTS.items():
        variant = summary["variants"][name]
        table.add_row(
            text, str(variant["steps_in_dataset"]), _rate(variant["offline"]), _rate(variant["online"]),
            _interval(variant["online"]),
        )  # fmt: skip
    console.print(table)
    console.print(f"report   {config.output_dir / 'report.html'}\nsummary  {config.output_dir / 'summary.json'}")
    console.print(f"policy   {config.output_dir / 'filtered' / 'checkpoints' / 'last' / 'pretrained_model'}")


def _rate(result: dict[str, Any]) -> str:
    return f"{result['success_rate']:.2f} ({result['successes']}/{result['n']})"


def _interval(result: dict[str, Any]) -> str:
    return f"{result['ci_low']:.2f} - {result['ci_high']:.2f}"


def main() -> int:
    """Entry of `python -m cqn_train.demo.station`."""
    introduction = "CQN on paused demonstrations, with and without the pause filter: 6-9 minutes"
    return run_once("demo", DemoConfig, introduction, run_demo, show)


if __name__ == "__main__":
    sys.exit(main())
