"""What samples are drawn from: episodes, and what of them is a demonstration or one driver's own."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

from .files import Place

__all__ = ["Table"]

ROW = [("start", int), ("length", int), ("terminated", bool), ("demo", bool), ("first", int), ("last", int)]


@dataclass(frozen=True)
class Table:
    """Table of all episodes for one state of the replay.

    rows: one for each episode, and behind them one for each span that a person drove in an episode that is no
        demonstration.
    left_out: steps before an episode's end that no sample starts at, as long as one is left.
    count: the episodes.
    borders: sorted rows of the replay before which a sequence of actions ends: another driver took over, a pause lay
        between, or the episode is over.
    """

    rows: NDArray[Any]
    left_out: int
    count: int
    borders: NDArray[np.int64]

    @classmethod
    def of(cls, places: Sequence[Place], left_out: int = 0) -> Self:
        """The table of these episodes."""
        rows = [(p.start, p.length, p.terminated, p.demo, 0, p.length) for p in places]
        rows += [(p.start, p.length, p.terminated, True, *span) for p in places if not p.demo for span in p.taught]
        borders = {
            p.start + step for p in places for step in (*p.borders, *(s for span in p.taught for s in span), p.length)
        }
        return cls(np.array(rows, dtype=ROW), left_out, len(places), np.array(sorted(borders), dtype=np.int64))

    def draw(
        self, count: int, demo_count: int, rng: np.random.Generator, *, by_step: bool
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Rows [B] and steps [B] of `count` samples from everything, then `demo_count` from demonstrations.

        by_step: uniform over time steps; else over episodes first.
        Raises DataError when a store that is asked for is empty.
        """
        everything, demos = np.arange(self.count), np.flatnonzero(self.rows["demo"])
        first = self.rows["first"]
        last = np.maximum(first + 1, np.minimum(self.rows["last"], self.rows["length"] - self.left_out))
        steps = last - first
        if (count and not len(everything)) or (demo_count and not len(demos)):
            raise DataError(
                f"Cannot sample {count} + {demo_count}: the replay holds {len(everything)} episodes, of which "
                f"{len(demos)} are demonstrations; give a dataset or set the batch size of the empty store to 0."
            )
        parts = []
        for ids, size in ((everything, count), (demos, demo_count)):
            weights = steps[ids] / steps[ids].sum() if by_step and size else None
            parts += [rng.choice(ids, size, p=weights)] if size else []
        episode = np.concatenate(parts)
        return episode, rng.integers(first[episode], last[episode])

    def shown(self, episode: NDArray[Any], step: NDArray[Any]) -> NDArray[Any]:
        """Whether the steps [B] are of a demonstration, or driven by a person in an episode that is none."""
        shown: NDArray[Any] = self.rows["demo"][episode]
        for row in self.rows[self.count :]:
            inside = (row["first"] <= step) & (step < row["last"])
            shown = shown | (inside & (self.rows["start"][episode] == row["start"]))
        return shown

    def ahead(self, episode: NDArray[Any], step: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Steps [B] from `step` on that one driver drove without a pause, and whether [B] the episode went on then."""
        row = self.rows["start"][episode] + step
        border = self.borders[np.searchsorted(self.borders, row, side="right")]
        return border - row, border < self.rows["start"][episode] + self.rows["length"][episode]
