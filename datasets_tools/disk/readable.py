"""The first view of every job: the episodes that can be read, and what their actions are."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

from lerobot_cqn.delta_actions import DeltaJoints, Kind
from lerobot_cqn.errors import DataError

from ..decisions.joints import match_joints
from ..terminal.console import note
from ..views.view import DerivedView
from .columns import refuse_infinite
from .source import Source
from .target import skip_entry

__all__ = ["readable"]


@dataclass
class Readable(DerivedView):
    """Without the episodes that cannot be read; with what the caller said of the actions."""

    readable: Sequence[int] = field(default_factory=tuple)
    said: DeltaJoints | None = None

    @property
    def episodes(self) -> Sequence[int]:
        """Those that can be read."""
        return self.readable

    @property
    def deltas(self) -> DeltaJoints | None:
        """As the caller said, else as the source's history says."""
        return self.said


def readable(source: Source, actions: str, *, skip_bad_episodes: bool, needs_videos: bool) -> DerivedView:
    """The episodes that can be read, of which all numbers are read once before any work begins.

    Args:
        source: the dataset.
        actions: what they are: "absolute", a kind of delta, or "auto" for what the source's history says.
        skip_bad_episodes: leave out what cannot be read, instead of stopping.
        needs_videos: whether an episode whose video file is missing cannot be read.

    Raises:
        DataError: an episode that cannot be read, unless bad ones are skipped; or no readable one.
    """
    bad: dict[int, str] = {}
    for index in source.episodes:
        try:
            episode = source.episode(index)
            if skip_bad_episodes:  # else where a step reads them: rows that trim or drop leave out do not matter
                refuse_infinite(episode)
            if needs_videos:
                source.check_videos([index])
        except DataError as error:
            if not skip_bad_episodes:
                raise
            bad[index] = source.without_place(str(error))
            note(f"Left out episode {index}: {error}")
    if len(bad) == len(source.episodes):
        raise DataError(f"{source.root}: not one episode can be read; the last one: {bad[max(bad)]}")
    view = Readable(source, readable=[i for i in source.episodes if i not in bad], said=_deltas(source, actions))
    if bad:
        view.entry.update(skip_entry(bad), source=source.meta.repo_id)
    return view


def _deltas(source: Source, actions: str) -> DeltaJoints | None:
    if actions == "auto":
        return source.deltas
    if actions == "absolute":
        return None
    matched = match_joints(source.features)
    if remark := matched.remark():
        note(remark)
    return DeltaJoints(cast(Kind, actions), matched.action_dims, matched.state_dims)
