"""Rows of a dataset, compared with where LeRobot's loader looks for them: what lies elsewhere would be learned wrongly.

Shapes: K rows of a dataset.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import DataError
from .scaling_check import rows_of

__all__ = ["check_rows"]

REMEDY = "write it anew, which puts that right or says more: cqn-data trim, or any operation of cqn-data"


def check_rows(meta: Any) -> None:
    """Look whether each episode's rows lie in one piece, in order, and at their own pictures.

    meta: LeRobot's metadata of the dataset; where only a part of its rows is on this disk, nothing is looked at.

    Raises DataError naming the first episode for which that is not so, or a data file that cannot be read.
    """
    episodes, frames, times = (_column(meta.root, key) for key in ("episode_index", "frame_index", "timestamp"))
    if not len(frames) or len(frames) != meta.total_frames:
        return
    firsts, lasts = (np.asarray(meta.episodes[f"dataset_{end}_index"]) for end in ("from", "to"))
    for number, first, last, length in zip(
        meta.episodes["episode_index"], firsts, lasts, meta.episodes["length"], strict=True
    ):
        rows = slice(int(first), int(last))
        found = frames[rows]
        if len(found) != length or (episodes[rows] != number).any() or (found != np.arange(length)).any():
            raise DataError(
                f"{meta.root}: the {length} rows of episode {number} are not in order at {first} to {last}, where"
                f" LeRobot looks for them; {REMEDY}."
            )
        off = np.abs(times[rows] - found / meta.fps)
        if meta.video_keys and off.max(initial=0.0) > 0.5 / meta.fps:
            row = int(off.argmax())
            raise DataError(
                f"{meta.root}: row {row} of episode {number} is at {times[rows][row]:.3f} s, where the picture of"
                f" another row is; {REMEDY}."
            )


def _column(root: Path, key: str) -> NDArray[np.float64]:
    """(K,) of all data files, in the order in which LeRobot reads them."""
    return np.concatenate([np.zeros(0), *(values[:, 0] for values in rows_of(root, key))])
