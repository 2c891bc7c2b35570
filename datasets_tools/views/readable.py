"""The first view of every job: the episodes that can be read, and what their actions are."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import dimension_names

from ..decisions.deltas import ACTION, STATE, Deltas, Kind
from ..disk.source import Source
from ..operations.job import Job
from ..terminal.console import note
from .view import View, gripper_dims

__all__ = ["match_joints", "readable"]


@dataclass
class Readable(View):
    """Without the episodes that cannot be read; with what the caller said of the actions."""

    readable: Sequence[int] = field(default_factory=tuple)
    said: Deltas | None = None

    @property
    def episodes(self) -> Sequence[int]:
        """Readable ones."""
        return self.readable

    @property
    def deltas(self) -> Deltas | None:
        """As the caller said, else as the source's history says."""
        return self.said


def readable(source: Source, job: Job) -> View:
    """Read all numbers once, before any work begins.

    Raises:
        DataError: an episode that cannot be read, unless bad ones are skipped; or no readable one.
    """
    bad: dict[int, str] = {}
    for index in source.episodes:
        try:
            source.episode(index)
            if not job.dry_run:
                source.check_videos([index])
        except DataError as error:
            if not job.skip_bad_episodes:
                raise
            bad[index] = source.without_place(str(error))
            note(f"Left out episode {index}: {error}")
    if len(bad) == len(source.episodes):
        raise DataError(f"{source.root}: not one episode can be read; the last one: {bad[max(bad)]}")
    view = Readable(source, readable=[i for i in source.episodes if i not in bad], said=_deltas(source, job))
    if bad:
        entry = {"operation": "skip_bad_episodes", "source": job.repo_id, "episodes": bad}
        view.entry.update(entry)
    return view


def match_joints(view: View, keep_absolute: Sequence[str] = ()) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Action dimensions that are joints, (J,), and the (J,) state dimensions of the same joints.

    By name where all names of the action are names of the state, else by position where both have the same size.
    Dimensions named in ``keep_absolute``, by default the gripper's, are left out.

    Raises:
        DataError: neither names nor sizes fit.
    """
    for key in (STATE, ACTION):
        if key not in view.features:
            raise DataError(f"Expected a feature '{key}', found {', '.join(view.features)}.")
    states, actions = (dimension_names(view.features[k]) for k in (STATE, ACTION))
    left_out = gripper_dims(actions, keep_absolute)
    joints = tuple(i for i in range(len(actions)) if i not in left_out)
    if all(actions[i] in states for i in joints) and len(set(states)) == len(states):
        return joints, tuple(states.index(actions[i]) for i in joints)
    if len(states) == len(actions):
        return joints, joints
    raise DataError(
        f"Cannot tell which state belongs to which action: {len(actions)} actions ({', '.join(actions[:8])}, …),"
        f" {len(states)} states ({', '.join(states[:8])}, …); expected the same names or the same number."
    )


def _deltas(source: Source, job: Job) -> Deltas | None:
    if job.actions == "auto":
        return source.deltas
    return None if job.actions == "absolute" else Deltas(cast(Kind, job.actions), *match_joints(source))
