"""Views with rewards."""

from dataclasses import dataclass, field
from typing import Any

from ..decisions.rewards import REWARD_FEATURES, last_step_rewards
from .episode import Episode
from .view import DerivedView

__all__ = ["Labelled"]


@dataclass
class Labelled(DerivedView):
    """With sparse rewards."""

    successes: dict[int, bool] = field(default_factory=dict)

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """With the reward columns."""
        return {**self.parent.features, **REWARD_FEATURES}

    def episode(self, index: int) -> Episode:
        """The steps with rewards."""
        episode = self.parent.episode(index)
        return episode.with_columns(last_step_rewards(len(episode), success=self.successes[index]))
