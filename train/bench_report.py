"""Results of a plan: success of every run, aggregates with bootstrap intervals, learning curves."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lerobot_cqn.errors import ConfigError, DataError

if TYPE_CHECKING:
    from .bench import Plan, Run

__all__ = ["Aggregate", "aggregate", "check_packages", "write_report"]

REPS = 2000  # bootstrap samples
COLOURS = ("#2e6fb6", "#c45c26", "#3a8f5c", "#8a56a8", "#6b6f76", "#b8942c")

Aggregate = dict[str, tuple[float, float, float]]
type Scores = Mapping[str, NDArray[np.float64]]


def check_packages() -> None:
    """Raises ConfigError where the packages of the extra are missing."""
    try:
        import matplotlib  # noqa: F401
        import rliable  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"{error}: cqn-bench needs pip install 'lerobot_policy_cqn[bench]'.") from error


def aggregate(scores: Scores) -> tuple[Aggregate, Aggregate]:
    """Interquartile mean of each method, and the probability that the first one is better than each other.

    Args:
        scores: method -> (seeds, tasks) success rates.

    Returns:
        both as name -> (estimate, lower, upper), 95 % stratified bootstrap intervals (rliable).
    """
    from rliable import library, metrics

    rng = np.random.RandomState(0)
    means, spans = library.get_interval_estimates(
        dict(scores), lambda s: np.array([metrics.aggregate_iqm(s)]), reps=REPS, random_state=rng
    )
    iqm = {name: (float(means[name][0]), float(spans[name][0, 0]), float(spans[name][1, 0])) for name in scores}
    first, *others = scores
    if not others:
        return iqm, {}
    pairs = {other: (scores[first], scores[other]) for other in others}
    better, spread = library.get_interval_estimates(
        pairs, metrics.probability_of_improvement, reps=REPS, random_state=rng
    )
    return iqm, {o: (float(better[o]), float(spread[o][0, 0]), float(spread[o][1, 0])) for o in others}


def write_report(plan: "Plan", runs: Sequence["Run"], folder: Path, console: Console) -> None:
    """Write results.csv, results.md, aggregate.png and curves.png into `folder`, and print the table.

    Methods are compared over the seeds that all of them have finished on all tasks; DataError where there is none.
    """
    final = {(r.task, r.method, r.seed): row for r in runs for row in r.rows() if row["phase"] == "final"}
    if not final:
        raise DataError(f"No run in {folder} has its final evaluation yet; there is nothing to report.")
    with (folder / "results.csv").open("w", newline="") as file:
        columns = ["task", "method", "seed", "n", "successes", "success_rate", "env_steps", "updates", "wall_s"]
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        for (task, method, seed), row in final.items():
            writer.writerow({**row, "task": task, "method": method, "seed": seed})
    seeds = [s for s in plan.seeds if all((t, m, s) in final for t in plan.tasks for m in plan.methods)]
    if not seeds:
        raise DataError(f"{folder}: no seed is finished for all methods and tasks; results.csv has what there is.")
    scores = {
        method: np.array([[float(final[t, method, s]["success_rate"]) for t in plan.tasks] for s in seeds])
        for method in plan.methods
    }
    iqm, better = aggregate(scores)
    text = _markdown(plan, scores, iqm, better, seeds, final)
    (folder / "results.md").write_text(text, encoding="utf-8")
    _draw_aggregate(iqm, len(seeds), len(plan.tasks), folder / "aggregate.png")
    _draw_curves(plan, runs, folder / "curves.png")
    console.print(text, markup=False)
    console.print(f"Wrote results.csv, results.md, aggregate.png and curves.png to {folder}", markup=False)


def _markdown(
    plan: "Plan", scores: Scores, iqm: Aggregate, better: Aggregate, seeds: Sequence[int], final: Mapping[Any, Any]
) -> str:
    n = {row["n"] for row in final.values()}
    heads = ["method", *plan.tasks, "IQM (95 %)", f"P({next(iter(scores))} better) (95 %)"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for method, values in scores.items():
        cells = [f"{m:.2f} ± {s:.2f}" for m, s in zip(values.mean(axis=0), values.std(axis=0), strict=True)]
        versus = "{:.2f} ({:.2f}-{:.2f})".format(*better[method]) if method in better else ""
        lines.append(f"| {method} | {' | '.join(cells)} | {'{:.2f} ({:.2f}-{:.2f})'.format(*iqm[method])} | {versus} |")
    lines += [
        "",
        f"Success rate of the deterministic policy at the end, {'/'.join(sorted(n))} evaluation episodes a run, seeds"
        f" {', '.join(map(str, seeds))}: mean ± standard deviation over seeds; interquartile mean over seeds and tasks,"
        " and probability of improvement with 95 % stratified bootstrap intervals.",
    ]
    return "\n".join(lines) + "\n"


def _draw_aggregate(iqm: Aggregate, seeds: int, tasks: int, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 1.0 + 0.45 * len(iqm)), layout="constrained")
    axis = figure.subplots()
    for row, (estimate, low, high) in enumerate(iqm.values()):
        axis.barh(row, high - low, left=low, height=0.55, color=COLOURS[row % len(COLOURS)], alpha=0.35)
        axis.plot([estimate, estimate], [row - 0.28, row + 0.28], color=COLOURS[row % len(COLOURS)], linewidth=2.5)
    axis.set_yticks(range(len(iqm)), list(iqm))
    counts = f"{seeds} seeds, {tasks} task{'s' * (tasks > 1)}"
    axis.set(xlim=(-0.02, 1.02), xlabel=f"success rate, interquartile mean and 95 % interval ({counts})")
    axis.invert_yaxis()
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)


def _draw_curves(plan: "Plan", runs: Sequence["Run"], path: Path) -> None:
    """Mean over seeds with the range between the worst and the best one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4 * len(plan.tasks), 3.4), layout="constrained")
    axes = figure.subplots(1, len(plan.tasks), squeeze=False, sharey=True)[0]
    for axis, task in zip(axes, plan.tasks, strict=True):
        for number, method in enumerate(plan.methods):
            steps, rates = _curve([r for r in runs if r.task == task and r.method == method])
            if len(steps) == 0:
                continue
            colour = COLOURS[number % len(COLOURS)]
            axis.plot(steps, rates.mean(axis=0), color=colour, label=method, marker="o", markersize=3)
            axis.fill_between(steps, rates.min(axis=0), rates.max(axis=0), color=colour, alpha=0.18, linewidth=0)
        axis.set(title=task, xlabel="control steps online", ylim=(-0.03, 1.03))
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("success rate in evaluation")
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=130)


def _curve(runs: Sequence["Run"]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps [K], and success rates [seeds, K] interpolated there: runs end episodes at different steps."""
    found = []
    for run in runs:
        rows = run.rows()
        if any(row["phase"] == "final" for row in rows):
            found.append(np.array([[float(row["env_steps"]), float(row["success_rate"])] for row in rows]))
    if not found:
        return np.zeros(0), np.zeros((0, 0))
    steps = np.unique(np.round(np.concatenate([points[:, 0] for points in found]), -1))
    return steps, np.array([np.interp(steps, points[:, 0], points[:, 1]) for points in found])
