"""Judgements of ``cqn-data inspect`` on places: whether rows, tasks and pictures lie where LeRobot looks for them."""

from collections.abc import Iterator

import numpy as np

from lerobot_cqn.errors import DataError

from ..disk.source import Source
from ..disk.timing import TOLERANCE
from .finding import NAMED, Finding, episodes_text, more
from .numbers import Numbers

__all__ = ["order", "timing"]


def order(source: Source) -> Iterator[Finding]:
    """Rows, numbers and tasks that do not lie where LeRobot looks for them."""
    if not source.in_order:
        text = "Rows, their numbers or the tasks do not lie in order from 0; LeRobot finds them by their place."
        advice = "Any operation of cqn-data (label, bounds, filter, …) writes them anew, in order."
        yield Finding("error", "order", "data, meta/tasks.parquet", text, advice)


def timing(source: Source, numbers: Numbers) -> Iterator[Finding]:
    """Rows without a picture, and rows whose time stamps are not those of their pictures; decodes nothing."""
    lost: list[str] = []
    apart: dict[int, float] = {}
    for summary in numbers.episodes if source.meta.video_keys else ():
        episode = source.episode(summary.index)
        stamps = float(np.abs(source.recorded_times(episode.index) - episode.times).max())
        try:
            source.check_videos([episode.index])
        except DataError:  # named as a missing file
            continue
        try:
            apart[episode.index] = stamps + source.drift(episode.index, episode.times)
        except DataError as error:
            lost.append(str(error))
    if lost:
        text = " ".join(lost[:NAMED]) + more(lost)
        advice = "Cut such rows off with cqn-data trim, or leave the episodes out with --skip_bad_episodes."
        yield Finding("error", "no_picture", "videos", text, advice)
    far = {index: seconds for index, seconds in apart.items() if seconds > TOLERANCE}
    if far:
        worst = max(far, key=lambda index: far[index])
        text = (
            f"Time stamps and pictures are up to {far[worst]:.4g} s apart (episode {worst}); LeRobot's loader allows"
            f" {TOLERANCE:g} s, and takes another picture or stops."
        )
        advice = "Any operation of cqn-data (label, bounds, filter, …) writes them anew, in order, from 0."
        yield Finding("error", "time_stamps", episodes_text(list(far)), text, advice)
