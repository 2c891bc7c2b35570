"""The learning curve of a run, as PNG bytes; matplotlib is imported on use (extra `report`)."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_cqn.errors import ConfigError

__all__ = ["learning_curve", "png", "pyplot"]

COLOUR = "#1f77b4"

Rows = Sequence[Mapping[str, str]]


def pyplot() -> Any:
    """Matplotlib, drawing without a screen. Raises ConfigError where it is not installed."""
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise ConfigError("Reports need the extra: pip install 'lerobot_policy_cqn[report]'.") from error
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "figure.dpi": 120})
    return plt


def png(figure: Any) -> bytes:
    """A figure as a picture; it is closed."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight")
    pyplot().close(figure)
    return buffer.getvalue()


def learning_curve(episodes: Rows, evaluations: Rows) -> bytes:
    """A run: evaluations with their 95 % intervals, and the running mean of 10 training episodes."""
    figure, axes = pyplot().subplots(figsize=(7.2, 3.2))
    if episodes:
        success = np.array([float(row["success"]) for row in episodes])
        mean = [success[max(0, i - 9) : i + 1].mean() for i in range(len(success))]
        text = "training episodes, running mean of 10"
        axes.plot([int(row["env_steps"]) for row in episodes], mean, color="0.7", linewidth=1, label=text)
    steps, rate = [int(row["env_steps"]) for row in evaluations], [float(row["success_rate"]) for row in evaluations]
    low, high = [float(row["ci_low"]) for row in evaluations], [float(row["ci_high"]) for row in evaluations]
    axes.plot(steps, rate, marker="o", markersize=4, color=COLOUR, label="evaluation, with its 95 % interval")
    spread = [np.subtract(rate, low), np.subtract(high, rate)]
    axes.errorbar(steps, rate, yerr=spread, fmt="none", ecolor=COLOUR, alpha=0.5, capsize=3)
    axes.set(xlabel="control steps online (0 is after offline training)", ylabel="success rate", ylim=(-0.03, 1.04))
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False, fontsize=9)
    return png(figure)
