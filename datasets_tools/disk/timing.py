"""When the pictures of a video come, without decoding it, and whether each row of a table has one of its own.

Shapes: K pictures of a file, T rows of an episode. Times are seconds in the file.
"""

from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

__all__ = ["TOLERANCE", "distances", "picture_times"]

TOLERANCE = 1e-4  # seconds that LeRobot's loader allows between a row and its picture

type Times = NDArray[np.float64]


def picture_times(path: Path) -> Times:
    """(K,) ascending times of the pictures in a video file.

    Raises:
        DataError: it cannot be read at all.
    """
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stamps = [float(p.pts * p.time_base) for p in container.demux(stream) if p.pts is not None and p.time_base]
    except (av.error.FFmpegError, OSError, ValueError, IndexError) as error:
        raise DataError(f"Video {path} cannot be read: {' '.join(str(error).split())[:160]}") from error
    return np.sort(np.asarray(stamps, np.float64))


def distances(path: Path, pictures: Times, wanted: Times, fps: float, episode: int) -> Times:
    """(T,) seconds from each row's time to the picture nearest to it.

    Args:
        path: of the video, for messages.
        pictures: (K,) from :func:`picture_times`.
        wanted: (T,) ascending times of the rows.
        fps: rows a second.
        episode: for messages.

    Raises:
        DataError: a row has no picture within half a period, or shares one with the row before it.
    """
    period = float(np.median(np.diff(pictures))) if len(pictures) > 1 else 1 / fps
    why = (
        f" (its pictures come at {1 / period:.4g} a second, the rows at {fps:g})"
        if abs(period * fps - 1) > 0.01
        else ""
    )
    if not len(pictures):
        raise DataError(f"Video {path} has no pictures; restore it.")
    after = np.clip(np.searchsorted(pictures, wanted), 1, max(1, len(pictures) - 1))
    before = np.minimum(after - 1, len(pictures) - 1)
    after = np.minimum(after, len(pictures) - 1)
    nearest = np.where(wanted - pictures[before] <= pictures[after] - wanted, before, after)
    apart = np.abs(pictures[nearest] - wanted)
    lost = np.flatnonzero(apart >= 0.5 / fps)
    if len(lost):
        frame = int(lost[0])
        raise DataError(
            f"Video {path} cannot be read at episode {episode}, frame {frame}: no picture at {wanted[frame]:.3f} s{why}"
        )
    shared = np.flatnonzero(np.diff(nearest) == 0)
    if len(shared):
        frame = int(shared[0])
        raise DataError(f"Video {path}: frames {frame} and {frame + 1} of episode {episode} have one picture{why}.")
    return np.asarray(apart, np.float64)
