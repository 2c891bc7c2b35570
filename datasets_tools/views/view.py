"""A dataset as an operation leaves it: views on views, down to the source; nothing is written or copied.

Shapes: T time steps of one episode, D dimensions of a vector. An operation looks at the view before it (``fit``) and
returns a view of its own; several of them in a row are one pass over the videos, since pictures are read only for the
steps and in the size of the last view.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ..decisions.deltas import Deltas
    from ..disk.source import Source

__all__ = ["SOURCE_EPISODE", "SOURCE_FRAME", "Bounds", "Camera", "Episode", "View", "gripper_dims"]

SOURCE_EPISODE, SOURCE_FRAME = "source.episode_index", "source.frame_index"


@dataclass(frozen=True)
class Camera:
    """What becomes of a camera's pictures: cut out (top, left, height, width), then scaled to (height, width)."""

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


@dataclass
class View:
    """What one operation makes of the view before it. Subclasses override what they change.

    Attributes:
        parent: the view before.
        entry: what the history keeps of the operation: its name, settings and report; nothing where it is empty.
    """

    parent: "View"
    entry: dict[str, Any] = field(default_factory=dict)

    @property
    def source(self) -> "Source":
        """The dataset on disk, at the bottom."""
        return self.parent.source

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot features without its own index columns; shapes are tuples."""
        return self.parent.features

    @property
    def fps(self) -> int:
        """Steps a second."""
        return self.parent.fps

    @property
    def episodes(self) -> Sequence[int]:
        """Numbers of the episodes in the source, in order."""
        return self.parent.episodes

    @property
    def cameras(self) -> dict[str, Camera]:
        """What becomes of each camera's pictures."""
        return self.parent.cameras

    @property
    def deltas(self) -> "Deltas | None":
        """Which action dimensions are differences and of what; None where all are absolute."""
        return self.parent.deltas

    @property
    def bounds(self) -> Bounds | None:
        """Bounds for training; None where those of the data hold."""
        return self.parent.bounds

    def episode(self, index: int) -> Episode:
        """Numbers of one episode; raises DataError where the source is damaged."""
        return self.parent.episode(index)

    def settle(self, written: Sequence[int]) -> None:
        """Last call before the target is complete, with the episodes that could be written."""
        self.parent.settle(written)

    def history(self) -> list[dict[str, Any]]:
        """Entries of all operations since the source, first one first."""
        return [*self.parent.history(), *([self.entry] if self.entry else [])]


def gripper_dims(names: Sequence[str], chosen: Sequence[str] = ()) -> tuple[int, ...]:
    """Dimensions of the gripper: those ``chosen`` by name, else those with "gripper" in their name."""
    return tuple(i for i, n in enumerate(names) if (n in chosen if chosen else "gripper" in n.lower()))
