"""A dataset as an operation leaves it: views on views, down to the source; nothing is written or copied.

An operation looks at the view before it and returns a view of its own; several of them in a row are one pass over the
videos, since pictures are read only for the steps and in the size of the last view.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.delta_actions import DeltaJoints

from .episode import Bounds, Camera, Episode

__all__ = ["DerivedView", "View"]


class View(ABC):
    """Episodes of a dataset, numbered as in the source: one on disk, or what an operation made of another view."""

    @property
    @abstractmethod
    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot features without its own index columns; shapes are tuples."""

    @property
    @abstractmethod
    def fps(self) -> float:
        """Steps a second."""

    @property
    @abstractmethod
    def episodes(self) -> Sequence[int]:
        """Numbers of the episodes in the source, in order."""

    @property
    @abstractmethod
    def cameras(self) -> dict[str, Camera]:
        """Crop and size of each camera's pictures, by feature."""

    @property
    @abstractmethod
    def deltas(self) -> DeltaJoints | None:
        """Action dimensions that are differences, and of what; None where all are absolute."""

    @property
    @abstractmethod
    def bounds(self) -> Bounds | None:
        """Bounds for training; None where those of the data hold."""

    @abstractmethod
    def episode(self, index: int) -> Episode:
        """Numbers of one episode; raises DataError where the source is damaged."""

    @abstractmethod
    def camera_frames(
        self,
        episode: Episode,
        steps: NDArray[np.int64],
        cameras: Mapping[str, Camera] | None = None,
        *,
        decoded: bool = False,
    ) -> Iterator[dict[str, Any]]:
        """Pictures of the given steps in order, each file read once from front to back.

        Args:
            episode: from :meth:`episode`.
            steps: (K,) ascending rows of the episode.
            cameras: what becomes of each camera's pictures; by default as in this view.
            decoded: pictures of videos in the colours in which they are stored, to be encoded again.

        Yields:
            {camera: (H, W, 3) uint8}; or, of a video, what its decoder gave.

        Raises:
            DataError: a file or a frame cannot be read; names file, episode and frame.
        """

    @abstractmethod
    def settle(self, written: Sequence[int]) -> None:
        """Last call before the target is complete, with the episodes that could be written."""

    @abstractmethod
    def history(self) -> list[dict[str, Any]]:
        """Entries of all operations that led here, first one first."""


@dataclass
class DerivedView(View):
    """The view that one operation makes of another: as its parent where a subclass does not say otherwise.

    Attributes:
        parent: the view before.
        entry: what the history keeps of the operation: its name, settings and report; nothing where it is empty.
    """

    parent: View
    entry: dict[str, Any] = field(default_factory=dict)

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """Those of the view before."""
        return self.parent.features

    @property
    def fps(self) -> float:
        """That of the view before."""
        return self.parent.fps

    @property
    def episodes(self) -> Sequence[int]:
        """Those of the view before."""
        return self.parent.episodes

    @property
    def cameras(self) -> dict[str, Camera]:
        """Those of the view before."""
        return self.parent.cameras

    @property
    def deltas(self) -> DeltaJoints | None:
        """Those of the view before."""
        return self.parent.deltas

    @property
    def bounds(self) -> Bounds | None:
        """Those of the view before."""
        return self.parent.bounds

    def episode(self, index: int) -> Episode:
        """That of the view before."""
        return self.parent.episode(index)

    def camera_frames(
        self,
        episode: Episode,
        steps: NDArray[np.int64],
        cameras: Mapping[str, Camera] | None = None,
        *,
        decoded: bool = False,
    ) -> Iterator[dict[str, Any]]:
        """Pictures from the source, as this view has them."""
        return self.parent.camera_frames(episode, steps, self.cameras if cameras is None else cameras, decoded=decoded)

    def settle(self, written: Sequence[int]) -> None:
        """Settle the view before."""
        self.parent.settle(written)

    def history(self) -> list[dict[str, Any]]:
        """Entries of the views before, then the own one."""
        return [*self.parent.history(), *([self.entry] if self.entry else [])]
