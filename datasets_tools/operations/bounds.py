"""``cqn-data bounds``: the action range that training maps to [-1, 1], written where it reads it: meta/stats.json."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.schema import dimension_names

from ..terminal.console import note, table
from ..terminal.options import option
from ..views.view import Bounds, View
from .job import Step, help_for, main_for, settings_of

__all__ = ["SetBounds", "help", "main", "quantile_bounds"]

BINS = 1 << 16  # of the histogram that quantiles are read from


@dataclasses.dataclass
class SetBounds(Step):
    """Settings of ``cqn-data bounds``."""

    name = "bounds"
    summary = "set the action bounds that training scales by"
    example = """
cqn-data bounds --repo_id=local/pick --root=data/pick --new_root=data/pick_bounded --quantile=0.001 --margin=0.1
"""
    notes = """
The bounds become min and max of the action in meta/stats.json, which policies with MIN_MAX scaling (CQN) map to -1 and
1; actions outside are cut to them in training. Operations that change actions or steps set them back to min and max.
Merging and splitting with lerobot-edit-dataset does so, too.
"""

    quantile: float = option(0.0, help="Share of the steps left out at either end of each dimension, 0 to below 0.5.")
    margin: float = option(
        0.0,
        help=(
            "Share of the range added at either end; 0.2 is like the authors' code. Where some actions are "
            "differences, only of these: the ends of an absolute one (a gripper) are the robot's own."
        ),
    )

    def validate(self) -> None:
        """Check ranges; raises ConfigError naming the option, the range and the value."""
        from lerobot_cqn.errors import ConfigError

        if not 0 <= self.quantile < 0.5:
            raise ConfigError(f"Expected --quantile in [0, 0.5), got {self.quantile}.")
        if not 0 <= self.margin < float("inf"):
            raise ConfigError(f"Expected --margin >= 0, got {self.margin}.")

    def on(self, view: View) -> View:
        """Compute the bounds and show them; raises DataError without actions."""
        from lerobot_cqn.errors import DataError

        if "action" not in view.features:
            raise DataError(f"Expected a feature 'action', found {', '.join(view.features)}.")
        after = Bounded(view, quantile=self.quantile, margin=self.margin)
        after.settle(list(view.episodes))
        self._show(view, after)
        after.entry.update(settings=settings_of(self))
        return after

    def _show(self, view: View, after: "Bounded") -> None:
        names, bounds = dimension_names(view.features["action"]), after.bounds
        assert bounds is not None  # noqa: S101  # settled above
        low, high = extremes(view, view.episodes)
        outside, steps = np.zeros(len(names)), 0
        for values in _actions(view, view.episodes):
            outside += ((values < bounds.low - 1e-9) | (values > bounds.high + 1e-9)).sum(axis=0)
            steps += len(values)
        rows = []
        for i, name in enumerate(names):
            numbers = (low[i], high[i], bounds.low[i], bounds.high[i])
            rows.append([name, *(f"{v:.4g}" for v in numbers), f"{outside[i] / steps:.2%}"])
        table(["dimension", "min", "max", "lower bound", "upper bound", "outside"], rows)
        constant = [n for n, a, b in zip(names, bounds.low, bounds.high, strict=True) if b - a <= 1e-8]
        if constant:
            note(f"Constant: {', '.join(constant)}; CQN maps such a dimension to 0 and back to its constant.")


@dataclasses.dataclass
class Bounded(View):
    """With bounds for training."""

    quantile: float = 0.0
    margin: float = 0.0
    _settled: Bounds | None = None

    @property
    def bounds(self) -> Bounds | None:
        """Of the episodes last settled."""
        return self._settled

    def settle(self, written: Sequence[int]) -> None:
        """Compute them over these episodes."""
        self._settled = quantile_bounds(self, written, self.quantile, self.margin)
        named = {"low": self._settled.low.tolist(), "high": self._settled.high.tolist()}
        self.entry["bounds"] = named
        self.parent.settle(written)


def extremes(view: View, episodes: Sequence[int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Smallest and largest action, (A,) each."""
    lows, highs = zip(*((v.min(axis=0), v.max(axis=0)) for v in _actions(view, episodes)), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def quantile_bounds(view: View, episodes: Sequence[int], quantile: float, margin: float) -> Bounds:
    """Bounds over ``episodes`` in memory that does not grow with them.

    Args:
        view: the actions.
        episodes: at least one.
        quantile: share left out at either end; exact to 1/65536 of the range.
        margin: share of what is left, added at either end; where some dimensions are differences, only of these.
    """
    low, high = extremes(view, episodes)
    if quantile > 0:
        width = np.where(high > low, high - low, 1.0)
        counts = np.zeros((len(low), BINS), np.int64)
        for values in _actions(view, episodes):
            bins = np.minimum(((values - low) / width * BINS).astype(np.int64), BINS - 1)
            for dim in range(len(low)):
                counts[dim] += np.bincount(bins[:, dim], minlength=BINS)
        shares = np.cumsum(counts, axis=1) / counts.sum(axis=1, keepdims=True)
        first, last = (shares > quantile).argmax(axis=1), (shares >= 1 - quantile).argmax(axis=1) + 1
        low, high = low + width * first / BINS, np.minimum(high, low + width * last / BINS)
    spread = margin * (high - low)
    if view.deltas is not None:
        spread[[i for i in range(len(spread)) if i not in view.deltas.action_dims]] = 0.0
    return Bounds(low - spread, high + spread)


def _actions(view: View, episodes: Sequence[int]) -> Iterator[NDArray[Any]]:
    """(T, A) float64 actions of each episode."""
    for index in episodes:
        episode = view.episode(index)
        yield np.asarray(episode.columns["action"], np.float64).reshape(len(episode), -1)


def help() -> str:
    """Help page."""
    return help_for(SetBounds)


def main(args: list[str]) -> None:
    """Run from the command line; errors as in ``run_job``."""
    main_for(SetBounds, args)
