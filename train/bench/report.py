"""Results of a plan: scores of every run, aggregates with bootstrap intervals, learning curves."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from lerobot_cqn.errors import ConfigError, DataError

from .figures import Curve, draw_aggregate, draw_curves, draw_table, spread
from .plan import Plan, Run

__all__ = ["Aggregate", "aggregate", "check_packages", "write_report"]

REPS = 2000  # bootstrap samples
RESULTS = ("task", "method", "seed", "n", "successes", "success_rate", "mean_return", "env_steps", "updates", "wall_s")
CURVES = ("task", "method", "env_steps", "seeds", "mean", "lowest", "highest")

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


def write_report(plan: Plan, runs: Sequence[Run], folder: Path, console: Console) -> None:
    """Write results.csv, results.md, curves.csv and the pictures of both into `folder`, and print the table.

    Methods are compared over the seeds that all of them have finished on all tasks; DataError where there is none.
    """
    final = {(r.task, r.method, r.seed): row for r in runs for row in r.rows() if row["phase"] == "final"}
    if not final:
        raise DataError(f"No run in {folder} has its final evaluation yet; there is nothing to report.")
    rows = [{**row, "task": task, "method": method, "seed": seed} for (task, method, seed), row in final.items()]
    _write_csv(folder / "results.csv", RESULTS, rows)
    seeds = [s for s in plan.seeds if all((t, m, s) in final for t in plan.tasks for m in plan.methods)]
    if not seeds:
        raise DataError(f"{folder}: no seed is finished for all methods and tasks; results.csv has what there is.")
    scores = {
        method: np.array([[float(final[t, method, s][plan.score]) for t in plan.tasks] for s in seeds])
        for method in plan.methods
    }
    iqm, better = aggregate(scores)
    text = _markdown(plan, scores, iqm, better, seeds, final)
    (folder / "results.md").write_text(text, encoding="utf-8")
    curves = [curve for task in plan.tasks for method in plan.methods if (curve := _curve(plan, runs, task, method))]
    _write_csv(folder / "curves.csv", CURVES, [row for curve in curves for row in curve.rows()])
    draw_aggregate(iqm, plan, len(seeds), folder / "aggregate.png")
    draw_table(scores, plan, len(seeds), folder / "table.png")
    draw_curves(curves, plan, folder / "curves.png")
    console.print(text, markup=False)
    console.print(f"Wrote results.csv, results.md, table.png, aggregate.png, curves.csv and curves.png to {folder}")


def _write_csv(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


def _markdown(
    plan: Plan, scores: Scores, iqm: Aggregate, better: Aggregate, seeds: Sequence[int], final: Mapping[Any, Any]
) -> str:
    n = {row["n"] for row in final.values()}
    digits = plan.digits
    heads = ["method", *plan.tasks, "IQM (95 %)", f"P({next(iter(scores))} better) (95 %)"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for method, values in scores.items():
        pairs = zip(values.mean(axis=0), spread(values), strict=True)
        # One seed says nothing of the spread over seeds: no figure is better than a zero.
        cells = [f"{m:.{digits}f}" + (f" ± {s:.{digits}f}" if len(seeds) > 1 else "") for m, s in pairs]
        versus = "{:.2f} ({:.2f}-{:.2f})".format(*better[method]) if method in better else ""
        middle = "{:.{d}f} ({:.{d}f}-{:.{d}f})".format(*iqm[method], d=digits)
        middle, versus = (middle, versus) if len(seeds) > 1 else (f"{iqm[method][0]:.{digits}f}", "")
        lines.append(f"| {method} | {' | '.join(cells)} | {middle} | {versus} |")
    what = plan.score.replace("_", " ")
    spread_over = (
        "mean ± standard deviation over seeds; interquartile mean over seeds and tasks, and probability of improvement"
        " with 95 % stratified bootstrap intervals."
        if len(seeds) > 1
        else "a single run of each method, so nothing is known of the spread over seeds."
    )
    lines += [
        "",
        f"{what.capitalize()} of the deterministic policy at the end, {'/'.join(sorted(n))} evaluation episodes a run,"
        f" seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}: {spread_over}",
    ]
    return "\n".join(lines) + "\n"


def _curve(plan: Plan, runs: Sequence[Run], task: str, method: str) -> Curve | None:
    """Over seeds, evaluation by evaluation: they lie at ends of episodes, so their steps differ a little.

    None where no run is done. Where runs differ in their number of evaluations, the last ones before the end are left
    out.
    """
    found = []
    for run in runs:
        rows = run.rows() if (run.task, run.method) == (task, method) else []
        if any(row["phase"] == "final" for row in rows):
            found.append([(float(row["env_steps"]), float(row[plan.score])) for row in rows])
    if not found:
        return None
    count = min(len(points) for points in found)
    points = np.array([[*points[: count - 1], points[-1]] for points in found])  # [seeds, K, 2]
    return Curve(task, method, points[:, :, 0].mean(axis=0), points[:, :, 1])
