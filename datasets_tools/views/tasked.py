"""Views with other task sentences."""

from dataclasses import dataclass, field, replace

from .episode import Episode
from .view import DerivedView

__all__ = ["Tasked"]


@dataclass
class Tasked(DerivedView):
    """Episodes under other names; those that are not named keep theirs."""

    named: dict[int, str] = field(default_factory=dict)

    def episode(self, index: int) -> Episode:
        """The steps, each with the episode's task."""
        episode = self.parent.episode(index)
        return replace(episode, tasks=[self.named[index]] * len(episode)) if index in self.named else episode
