"""Parts of a view: an episode's numbers, the shape of a camera's pictures, bounds of the actions.

Shapes: T time steps of one episode, A action dimensions.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["SOURCE_EPISODE", "SOURCE_FRAME", "Bounds", "Camera", "Episode"]

SOURCE_EPISODE, SOURCE_FRAME = "source.episode_index", "source.frame_index"


@dataclass(frozen=True)
class Camera:
    """Shape of a camera's pictures: cut out (top, left, height, width), then scaled to (height, width)."""

    crop: tuple[int, int, int, int] | None = None
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Bounds:
    """Action bounds, (A,) each, that training takes instead of the smallest and largest action."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]


@dataclass(frozen=True)
class Episode:
    """One episode.

    Attributes:
        index: its number in the source.
        start: row of the source at which the episode begins there.
        frames: (T,) its frames in the source, ascending.
        times: (T,) seconds since the episode's start in the source, where the pictures lie.
        columns: name -> array with T rows, or list of T strings; no pictures.
        tasks: the T task sentences.
    """

    index: int
    start: int
    frames: NDArray[np.int64]
    times: NDArray[np.float64]
    columns: dict[str, Any]
    tasks: list[str]

    def __len__(self) -> int:
        return len(self.frames)

    def at(self, rows: NDArray[np.int64]) -> "Episode":
        """The given rows only, in their order."""
        columns = {k: [v[i] for i in rows] if isinstance(v, list) else v[rows] for k, v in self.columns.items()}
        tasks = [self.tasks[i] for i in rows]
        return replace(self, frames=self.frames[rows], times=self.times[rows], columns=columns, tasks=tasks)

    def with_columns(self, columns: Mapping[str, Any]) -> "Episode":
        """The same steps with some columns added or replaced."""
        return replace(self, columns={**self.columns, **columns})
