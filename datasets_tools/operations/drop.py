"""``cqn-data drop``: leave out whole episodes, by number or by rule; the reason is kept in the history."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError, DataError
from lerobot_cqn.history_text import numbered

from ..terminal.console import result, table
from ..terminal.options import option
from .job import Step, settings_of
from .parts import known_episodes

if TYPE_CHECKING:
    from ..views.view import DerivedView, View

__all__ = ["Drop"]


@dataclasses.dataclass
class Drop(Step):
    """Settings of ``cqn-data drop``."""

    name = "drop"
    example = """
cqn-data drop --repo_id=local/click --root=data/click --new_root=data/click_good \\
    --episodes='[3, 7]' --where='steps < 20' --reason='hand in the picture'
"""
    notes = """
Rules: QUANTITY OPERATOR NUMBER. QUANTITY is steps, seconds, return, success, or a column such as
observation.state[gripper.pos], followed by .first, .last, .min, .max, .mean or .range over the episode.
"""

    episodes: list[int] = dataclasses.field(
        default_factory=list, metadata={"help": "Numbers of the episodes to leave out, e.g. '[3, 7]'."}
    )
    where: str | None = option(None, help="Leave out the episodes for which this rule holds, e.g. 'steps < 20'.")
    reason: str | None = option(None, help="Why; kept in the history.")

    def validate(self) -> None:
        """Something must be asked for."""
        if not self.episodes and not self.where:
            raise ConfigError("Nothing to drop: expected --episodes='[…]' or --where='RULE'.")

    def reads_numbers(self) -> bool:
        """What is left out may be infinite."""
        return False

    def on(self, view: "View") -> "DerivedView":
        """Find the episodes; raises ConfigError for a number that is not there."""
        import numpy as np

        from ..decisions.episode_rules import parse_rule
        from ..views.selected import Selected

        known_episodes(view, self.episodes)
        rule = parse_rule(self.where, view.features) if self.where else None
        dropped: dict[int, str] = {}
        after = Selected(view)
        for index in view.episodes:
            episode = view.episode(index)
            if index in self.episodes:
                dropped[index] = self.reason or "named"
            elif rule and rule.holds(episode.columns, len(episode), view.fps):
                quantity = rule.quantity(episode.columns, len(episode), view.fps)
                measured = f"{rule.text} ({quantity:.4g})"
                dropped[index] = f"{self.reason}: {measured}" if self.reason else measured
            else:
                after.rows[index] = np.arange(len(episode))
        if not after.rows:
            raise DataError("Every episode would be dropped; nothing would be left.")
        if dropped:
            rows = [[str(i), str(len(view.episode(i))), why] for i, why in dropped.items()]
            table(["episode", "steps", "dropped because"], rows, [str(len(dropped)), "", f"{len(after.rows)} left"])
        else:
            result("No episode is dropped.")
        after.entry.update(settings=settings_of(self), dropped={str(k): v for k, v in dropped.items()})
        return after

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """The sentence for the history."""
        dropped = entry["dropped"]
        if not dropped:
            return "Dropped no episode."
        groups = {why: [i for i in dropped if dropped[i] == why] for why in dropped.values()}
        reasons = "; ".join(f"{why}: {numbered(episodes)}" for why, episodes in groups.items())
        return f"Dropped {len(dropped)} episode{'s' * (len(dropped) != 1)} ({reasons})."
