"""Cameras as ``cqn-data inspect`` sees them: a few pictures of each, spread over the recording."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..disk.source import Source
from ..views.episode import Camera

if TYPE_CHECKING:
    from .numbers import EpisodeNumbers

__all__ = ["CameraLook", "look", "missing_videos"]

EPISODES, FRAMES = 5, 6  # pictures of a camera: at most 30
SMALL = 64  # pixels of the wider side, to compare pictures
DARK, FLAT = 8.0, 2.0  # mean brightness of a black picture; spread of one without any content; of 255
SAME = 0.25  # mean difference of two pictures of a camera that delivers nothing new, of 255

Picture = NDArray[np.uint8]


@dataclass
class CameraLook:
    """One camera.

    Attributes:
        key: feature, `observation.images.NAME`.
        height, width: of the first picture read, or as declared.
        first: its first picture, (H, W, 3) uint8; None where none can be read.
        looked: pictures read.
        dark, flat: (episode, frame) of black ones and of ones of a single colour.
        frozen: (episode, first frame, last frame) between which the arm moves and the picture does not change.
        broken: what could not be read, one sentence each.
    """

    key: str
    height: int
    width: int
    first: Picture | None = None
    looked: int = 0
    dark: list[tuple[int, int]] = field(default_factory=list)
    flat: list[tuple[int, int]] = field(default_factory=list)
    frozen: list[tuple[int, int, int]] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)


def missing_videos(source: Source) -> dict[str, list[int]]:
    """Video files that are not there, relative to the dataset, with the episodes they hold."""
    missing: dict[str, list[int]] = {}
    for key in source.meta.video_keys:
        for episode in source.episodes:
            path = source.video_path(episode, key)
            if not path.is_file():
                name = path.relative_to(source.root).as_posix() if path.is_relative_to(source.root) else str(path)
                missing.setdefault(name, []).append(episode)
    return missing


def look(
    source: Source,
    episodes: "list[EpisodeNumbers]",
    moves: Callable[[int, int, int], bool],
    advance: Callable[[], None] = lambda: None,
) -> list[CameraLook]:
    """Read at most 30 pictures of each camera and say what is wrong with them; depth is left out.

    Args:
        source: an opened dataset.
        episodes: those that can be read.
        moves: (episode, first frame, last frame) -> whether the arm moves in between.
        advance: called after each camera.
    """
    depth = set(getattr(source.meta, "depth_keys", ()))
    spread = np.unique(np.linspace(0, len(episodes) - 1, EPISODES).round().astype(int)) if episodes else ()
    chosen = [episodes[i] for i in spread]
    looks = []
    for key, feature in source.features.items():
        if feature["dtype"] not in ("image", "video") or key in depth:
            continue
        height, width = _size(feature)
        camera = CameraLook(key, height, width)
        for episode in chosen:
            if feature["dtype"] == "image" or source.video_path(episode.index, key).is_file():
                _look_at(source, camera, episode, moves)
        looks.append(camera)
        advance()
    return looks


def _look_at(
    source: Source, camera: CameraLook, summary: "EpisodeNumbers", moves: Callable[[int, int, int], bool]
) -> None:
    episode = source.episode(summary.index)
    before: tuple[int, NDArray[np.float64]] | None = None
    for frame in np.unique(np.linspace(0, len(episode) - 1, FRAMES).round().astype(np.int64)):
        at = (summary.index, int(frame))
        try:
            # One at a time: reading from the first to the last would decode everything in between.
            pictures: dict[str, Any] = next(
                iter(source.camera_frames(episode, np.array([frame]), {camera.key: Camera()}))
            )
            picture = np.asarray(pictures[camera.key], np.uint8)
        except Exception as error:  # decoders raise kinds of their own
            camera.broken.append(" ".join(str(error).split()) or type(error).__name__)
            return
        camera.looked += 1
        if camera.first is None:
            camera.first, (camera.height, camera.width) = picture, picture.shape[:2]
        small = _small(picture)
        if small.mean() < DARK:
            camera.dark.append(at)
        elif small.std(axis=(0, 1)).max() < FLAT:
            camera.flat.append(at)
        elif before is not None and np.abs(small - before[1]).mean() < SAME and moves(at[0], before[0], at[1]):
            camera.frozen.append((at[0], before[0], at[1]))
        before = (at[1], small)


def _small(picture: Picture) -> NDArray[np.float64]:
    """About 64 pixels wide, each the mean of the ones it stands for."""
    step = max(1, max(picture.shape[:2]) // SMALL)
    height, width = (n // step * step for n in picture.shape[:2])
    blocks = picture[:height, :width].reshape(height // step, step, width // step, step, -1)
    small: NDArray[np.float64] = blocks.mean(axis=(1, 3), dtype=np.float64)
    return small


def _size(feature: dict[str, Any]) -> tuple[int, int]:
    """Declared height and width, whichever place the channels have."""
    shape, names = tuple(feature["shape"]), feature.get("names") or []
    if isinstance(names, list) and "height" in names and "width" in names:
        return int(shape[names.index("height")]), int(shape[names.index("width")])
    return (int(shape[1]), int(shape[2])) if shape[0] in (1, 3, 4) else (int(shape[0]), int(shape[1]))
