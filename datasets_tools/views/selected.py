"""Views of some rows of some episodes, such as those without the pauses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.delta_actions import DeltaJoints
from lerobot_cqn.errors import DataError
from lerobot_cqn.schema import ACTION, STATE

from ..decisions.deltas import absolute_action, delta_action
from ..decisions.joints import match_joints
from ..decisions.pauses import EpisodeReport, Rule, keep_mask, report_episode
from ..decisions.rewards import carries_reward
from .episode import Bounds, Episode
from .view import DerivedView, View

__all__ = ["Selected", "filtered_view", "select"]


@dataclass
class Selected(DerivedView):
    """Some rows of some episodes.

    Attributes:
        rows: episode -> (K,) ascending rows of the view before.
    """

    rows: dict[int, NDArray[np.int64]] = field(default_factory=dict)

    @property
    def episodes(self) -> Sequence[int]:
        """Those with rows."""
        return list(self.rows)

    @property
    def bounds(self) -> Bounds | None:
        """Those of the view before were for other steps."""
        return None

    def episode(self, index: int) -> Episode:
        """The chosen rows, delta actions formed anew."""
        return select(self.parent.episode(index), self.rows[index], self.parent.deltas)


def select(
    episode: Episode, rows: NDArray[np.int64], deltas: DeltaJoints | None, action_rows: NDArray[np.int64] | None = None
) -> Episode:
    """Some rows of an episode, with delta actions formed anew so that they connect the states that are left.

    Args:
        episode: the steps before.
        rows: (K,) ascending rows to keep.
        deltas: what the actions are; None for absolute ones, which do not depend on their neighbours.
        action_rows: (K,) where each step's command is taken from; by default its own row.
    """
    chosen = episode.at(rows)
    if ACTION not in episode.columns or (deltas is None and action_rows is None):
        return chosen
    commanded = episode.columns[ACTION] if deltas is None else absolute_action(episode.columns, deltas)
    chosen = chosen.with_columns({ACTION: commanded[rows if action_rows is None else action_rows]})
    if deltas is None:
        return chosen
    return chosen.with_columns({ACTION: _in_dtype(delta_action(chosen.columns, deltas), episode)})


def _in_dtype(values: NDArray[Any], episode: Episode) -> NDArray[Any]:
    """Actions in the dtype of the episode's own; raises DataError where whole numbers of that size cannot hold them."""
    dtype = episode.columns[ACTION].dtype
    if np.issubdtype(dtype, np.integer):
        room = np.iinfo(dtype)
        frames = np.flatnonzero(((values < room.min) | (values > room.max)).any(axis=1))
        if len(frames):
            raise DataError(
                f"Episode {episode.index}, step {int(frames[0])}: an action formed anew does not fit into {dtype}; make"
                " the actions absolute first, in a dataset of floats: cqn-data delta --to=absolute."
            )
        values = np.rint(values)
    return values.astype(dtype)


def filtered_view(
    view: View, rule: Rule, min_steps: int, *, skip: bool, rules: Mapping[int, Rule] = MappingProxyType({})
) -> tuple[Selected, list[EpisodeReport]]:
    """Apply ``rule`` to all episodes but those that have one of their own in ``rules``.

    Args:
        view: the view before.
        rule: what a pause is.
        rules: the same by episode.
        min_steps: an episode that keeps fewer steps, and had as many, is refused.
        skip: leave such episodes out instead.

    Raises:
        DataError: naming the episodes of which too little would be left.
    """
    after, reports, short = Selected(view), [], []
    for index in view.episodes:
        episode = view.episode(index)
        state, action = episode.columns[STATE], episode.columns[ACTION]
        own = rules.get(index, rule)
        mask = keep_mask(state, action, own, carries_reward(episode.columns, len(episode)))
        report = report_episode(index, state, action, mask, own, commanded_joints(view, episode))
        reports.append(report)
        if report.kept < min(min_steps, report.steps):
            short.append(report)
        else:
            after.rows[index] = np.flatnonzero(mask)
    if short and (not skip or not after.rows):
        named = ", ".join(f"{r.episode} ({r.kept} of {r.steps})" for r in short[:5])
        more = f" and {len(short) - 5} more" if len(short) > 5 else ""
        raise DataError(
            f"Too little would be left of episode {named}{more}; expected at least --min_steps={min_steps}."
            " Lower --threshold, raise --min_pause, or leave these episodes out with --skip_short."
        )
    if short:
        after.entry["left_out"] = {r.episode: f"{r.kept} of {r.steps} steps would be left" for r in short}
    return after, reports


def commanded_joints(view: View, episode: Episode) -> NDArray[Any] | None:
    """(T, J) commanded joint positions, where the actions are joints; None where they cannot be matched."""
    if view.deltas is not None:
        return absolute_action(episode.columns, view.deltas)[:, list(view.deltas.action_dims)]
    try:
        actions = match_joints(view.features).action_dims
    except DataError:
        return None
    commanded: NDArray[Any] = episode.columns[ACTION][:, list(actions)]
    return commanded
