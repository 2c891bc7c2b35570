"""The pictures of a plan's results: a table of scores, aggregates with intervals, learning curves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .plan import Plan

__all__ = ["Curve", "draw_aggregate", "draw_curves", "draw_table", "spread"]

COLOURS = ("#2e6fb6", "#c45c26", "#3a8f5c", "#8a56a8", "#6b6f76", "#b8942c", "#1f9aa0", "#b0457b")


@dataclass(frozen=True)
class Curve:
    """Scores of a method on a task at the K-th evaluation: values [seeds, K], steps [K] their mean over seeds."""

    task: str
    method: str
    steps: NDArray[np.float64]
    values: NDArray[np.float64]

    def rows(self) -> list[dict[str, Any]]:
        """One row a step: mean, lowest and highest over seeds."""
        return [
            {
                "task": self.task, "method": self.method, "env_steps": int(step), "seeds": len(column),
                "mean": f"{column.mean():.4f}", "lowest": f"{column.min():.4f}", "highest": f"{column.max():.4f}",
            }
            for step, column in zip(self.steps, self.values.T, strict=True)
        ]  # fmt: skip


def spread(values: NDArray[np.float64]) -> Any:
    """Standard deviation of a sample over seeds, the first axis; 0 for a single one."""
    return values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1:])


def draw_aggregate(iqm: Mapping[str, tuple[float, float, float]], plan: Plan, seeds: int, path: Path) -> None:
    """Interquartile mean of each method as a line in its 95 % interval."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 1.0 + 0.45 * len(iqm)), layout="constrained")
    axis = figure.subplots()
    for row, (estimate, low, high) in enumerate(iqm.values()):
        colour = COLOURS[row % len(COLOURS)]
        axis.barh(row, high - low, left=low, height=0.55, color=colour, alpha=0.35)
        axis.plot([estimate, estimate], [row - 0.28, row + 0.28], color=colour, linewidth=2.5)
    axis.set_yticks(range(len(iqm)), list(iqm))
    tasks = len(plan.tasks)
    counts = f"{seeds} seed{'s' * (seeds > 1)}, {tasks} task{'s' * (tasks > 1)}"
    axis.set_xlabel(f"{_name(plan)}, interquartile mean and 95 % interval ({counts})")
    if plan.score == "success_rate":
        axis.set_xlim(-0.02, 1.02)
    axis.invert_yaxis()
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)


def draw_table(scores: Mapping[str, NDArray[np.float64]], plan: Plan, seeds: int, path: Path) -> None:
    """Methods by tasks, mean ± standard deviation over seeds, the shade following the mean; last, the mean of tasks."""
    from matplotlib.figure import Figure

    tasks = list(plan.tasks) + (["all tasks"] if len(plan.tasks) > 1 else [])
    means = np.array([[*v.mean(axis=0), *([v.mean()] if len(plan.tasks) > 1 else [])] for v in scores.values()])
    spreads = np.array(
        [[*spread(v), *([spread(v.mean(axis=1))] if len(plan.tasks) > 1 else [])] for v in scores.values()]
    )
    figure = Figure(figsize=(max(5.2, 2.0 + 1.5 * len(tasks)), 1.2 + 0.38 * len(scores)), layout="constrained")
    axis = figure.subplots()
    top = 1.0 if plan.score == "success_rate" else float(max(means.max(), 1e-9))
    axis.imshow(means, cmap="Blues", vmin=0, vmax=2 * top, aspect="auto")  # light enough for black text
    for row, column in np.ndindex(means.shape):
        text = f"{means[row, column]:.{plan.digits}f}"
        text += f" ± {spreads[row, column]:.{plan.digits}f}" if seeds > 1 else ""
        best = means[row, column] >= means[:, column].max() - 1e-9
        axis.text(column, row, text, ha="center", va="center", fontsize=9, fontweight="bold" if best else "normal")
    axis.set_xticks(range(len(tasks)), [task.replace("_", " ") for task in tasks], fontsize=9)
    axis.set_yticks(range(len(scores)), list(scores), fontsize=9)
    axis.xaxis.tick_top()
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    over = f"mean ± standard deviation over {seeds} seeds" if seeds > 1 else "one seed"
    axis.set_xlabel(f"{_name(plan)}, {over}", fontsize=9)
    figure.savefig(path, dpi=130)


def draw_curves(curves: Sequence[Curve], plan: Plan, path: Path) -> None:
    """Mean over seeds with the range from the lowest to the highest one, one panel a task."""
    from matplotlib.figure import Figure

    columns = min(3, len(plan.tasks))
    lines = -(-len(plan.tasks) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.3 * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False, sharey=plan.score == "success_rate").flatten()
    colours = {method: COLOURS[i % len(COLOURS)] for i, method in enumerate(plan.methods)}
    for axis, task in zip(axes, plan.tasks, strict=False):
        for curve in (curve for curve in curves if curve.task == task):
            colour = colours[curve.method]
            axis.plot(
                curve.steps, curve.values.mean(axis=0), color=colour, label=curve.method, marker="o", markersize=3
            )
            low, high = curve.values.min(axis=0), curve.values.max(axis=0)
            axis.fill_between(curve.steps, low, high, color=colour, alpha=0.18, linewidth=0)
        axis.set(title=task.replace("_", " "), xlabel="control steps online (band: lowest to highest seed)")
        if plan.score == "success_rate":
            axis.set_ylim(-0.03, 1.03)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[len(plan.tasks) :]:
        axis.set_visible(False)
    for axis in axes[::columns]:
        axis.set_ylabel(f"{_name(plan)} in evaluation")
    axes[0].legend(frameon=False, fontsize=9)
    figure.savefig(path, dpi=130)


def _name(plan: Plan) -> str:
    return plan.score.replace("_", " ")
