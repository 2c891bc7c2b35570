"""Views with delta or absolute actions."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_cqn.delta_actions import DeltaJoints
from lerobot_cqn.schema import ACTION, STATE

from ..decisions.deltas import absolute_action, delta_action, float_dtype
from .episode import Bounds, Episode
from .view import DerivedView

__all__ = ["AbsoluteView", "DeltaView"]


@dataclass
class DeltaView(DerivedView):
    """With some action dimensions as differences; where there were no actions, they are made from the states."""

    made: DeltaJoints | None = None

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """With an action, if there was none, and with one that has room for differences."""
        features = self.parent.features
        return _with_float_action(features if ACTION in features else {**features, ACTION: dict(features[STATE])})

    @property
    def deltas(self) -> DeltaJoints | None:
        """Those that this view has made."""
        return self.made

    @property
    def bounds(self) -> Bounds | None:
        """Those of the view before were for other actions."""
        return None

    def episode(self, index: int) -> Episode:
        """The steps with delta actions."""
        episode = self.parent.episode(index)
        if ACTION not in episode.columns:
            state = episode.columns[STATE]
            episode = episode.with_columns({ACTION: np.concatenate([state[1:], state[-1:]])})
        assert self.made is not None  # noqa: S101  # set by whoever made this view
        return episode.with_columns({ACTION: delta_action(episode.columns, self.made)})


@dataclass
class AbsoluteView(DerivedView):
    """With all action dimensions absolute."""

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """With an action that has room for sums."""
        return _with_float_action(self.parent.features)

    @property
    def deltas(self) -> DeltaJoints | None:
        """None: all actions are absolute."""
        return None

    @property
    def bounds(self) -> Bounds | None:
        """Those of the view before were for other actions."""
        return None

    def episode(self, index: int) -> Episode:
        """The steps with absolute actions."""
        episode, deltas = self.parent.episode(index), self.parent.deltas
        return episode if deltas is None else episode.with_columns({ACTION: absolute_action(episode.columns, deltas)})


def _with_float_action(features: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    action = features[ACTION]
    return {**features, ACTION: {**action, "dtype": float_dtype(action["dtype"])}}
