"""Views with delta or absolute actions."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_cqn.schema import ACTION, STATE, dimension_names

from ..decisions.deltas import Deltas, absolute_action, delta_action
from .episode import Bounds, Episode
from .view import DerivedView, View

__all__ = ["AbsoluteView", "DeltaView", "described"]


@dataclass
class DeltaView(DerivedView):
    """With some action dimensions as differences; where there were no actions, they are made from the states."""

    made: Deltas | None = None

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """With an action, if there was none."""
        features = self.parent.features
        return features if ACTION in features else {**features, ACTION: dict(features[STATE])}

    @property
    def deltas(self) -> Deltas | None:
        """What the actions are now."""
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
    def deltas(self) -> Deltas | None:
        """None."""
        return None

    @property
    def bounds(self) -> Bounds | None:
        """Those of the view before were for other actions."""
        return None

    def episode(self, index: int) -> Episode:
        """The steps with absolute actions."""
        episode, deltas = self.parent.episode(index), self.parent.deltas
        return episode if deltas is None else episode.with_columns({ACTION: absolute_action(episode.columns, deltas)})


def described(view: View, deltas: Deltas) -> dict[str, Any]:
    """Deltas by the names of their dimensions, as the history keeps them."""
    states = dimension_names(view.features[STATE])
    actions = dimension_names(view.features.get(ACTION, view.features[STATE]))
    return {
        "kind": deltas.kind,
        "action": [actions[i] for i in deltas.action_dims],
        "state": [states[i] for i in deltas.state_dims],
    }
