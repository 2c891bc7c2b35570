"""Views with fewer steps a second."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.delta_actions import DeltaJoints
from lerobot_cqn.schema import NEXT_DONE, NEXT_REWARD, NEXT_SUCCESS

from .episode import Bounds, Episode
from .selected import select
from .view import DerivedView

__all__ = ["Resampled", "windows"]


@dataclass
class Resampled(DerivedView):
    """With fewer steps a second."""

    rate: int = 1

    @property
    def fps(self) -> float:
        """The new rate."""
        return self.rate

    @property
    def bounds(self) -> Bounds | None:
        """Those of the view before were for other steps."""
        return None

    def episode(self, index: int) -> Episode:
        """The chosen steps."""
        return _resampled(self.parent.episode(index), self.parent.fps, self.rate, self.parent.deltas)


def windows(steps: int, old: float, new: float) -> NDArray[np.int64]:
    """(K,) first row of each new step; the rows until the next one belong to it. ``new`` < ``old``, in Hz."""
    count = int(-(-steps * new // old))
    starts: NDArray[np.int64] = np.floor(np.arange(count) * (old / new) + 0.5).astype(np.int64)
    return starts[starts < steps]


def _resampled(episode: Episode, old: float, new: float, deltas: DeltaJoints | None) -> Episode:
    rows = windows(len(episode), old, new)
    last = np.append(rows[1:], len(episode)) - 1
    chosen = select(episode, rows, deltas, action_rows=last)
    joined: dict[str, Any] = {}
    if NEXT_REWARD in episode.columns:
        joined[NEXT_REWARD] = np.add.reduceat(episode.columns[NEXT_REWARD], rows, axis=0)
    for key in (NEXT_DONE, NEXT_SUCCESS, "next.truncated"):
        if key in episode.columns:
            joined[key] = np.logical_or.reduceat(episode.columns[key], rows, axis=0)
    return chosen.with_columns(joined)
