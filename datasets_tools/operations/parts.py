"""What several operations check."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from lerobot_cqn.errors import ConfigError

if TYPE_CHECKING:
    from ..views.view import View

__all__ = ["known_episodes"]


def known_episodes(view: "View", asked: Iterable[int]) -> None:
    """Raises ConfigError where an episode is asked for that is not in the view."""
    unknown = sorted(set(asked) - set(view.episodes))
    if unknown:
        raise ConfigError(
            f"No episode {unknown[0]}: expected numbers from {min(view.episodes)} to {max(view.episodes)}."
        )
