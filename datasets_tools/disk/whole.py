"""Whether a dataset can be read as it lies there, by LeRobot's loader and without writing it anew."""

from collections.abc import Sequence

from lerobot_cqn.errors import DataError

from .source import Source
from .timing import TOLERANCE

__all__ = ["refuse_damaged"]

REMEDY = "write it anew first, which puts that right, e.g. with cqn-data trim"


def refuse_damaged(source: Source, episodes: Sequence[int] | None = None) -> None:
    """Look at rows, videos and the times of both; nothing is decoded.

    Args:
        source: an opened dataset.
        episodes: which are wanted; by default all.

    Raises:
        DataError: naming file, episode or frame, and what to do.
    """
    wanted = source.episodes if episodes is None else episodes
    for index in wanted:
        source.episode(index)
    source.check_videos(wanted)
    if not source.in_order:
        raise DataError(f"{source.root}: its rows, episodes or tasks are not where LeRobot looks for them; {REMEDY}.")
    for index in wanted:
        apart = source.drift(index, source.recorded_times(index))
        if apart > TOLERANCE:
            raise DataError(
                f"{source.root}: rows of episode {index} are up to {1000 * apart:.3g} ms off their pictures, which"
                f" LeRobot refuses; {REMEDY}."
            )
