"""Views with action bounds for training, and the bounds of a view's actions.

Shapes: T time steps of one episode, A action dimensions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.schema import ACTION

from .episode import Bounds
from .view import DerivedView, View

__all__ = ["Bounded", "actions", "extremes", "quantile_bounds"]

BINS = 1 << 16  # of the histogram that quantiles are read from


@dataclass
class Bounded(DerivedView):
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
    lows, highs = zip(*((v.min(axis=0), v.max(axis=0)) for v in actions(view, episodes)), strict=True)
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
        for values in actions(view, episodes):
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


def actions(view: View, episodes: Sequence[int]) -> Iterator[NDArray[Any]]:
    """(T, A) float64 actions of each episode."""
    for index in episodes:
        episode = view.episode(index)
        yield np.asarray(episode.columns[ACTION], np.float64).reshape(len(episode), -1)
