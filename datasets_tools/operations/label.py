"""``cqn-data label``: sparse rewards, done and success from a list, a column, a rule, or for all episodes."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError, one_of
from lerobot_cqn.history_text import numbered

from ..terminal.console import note, table
from ..terminal.options import option
from .job import Step, settings_of
from .parts import known_episodes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..views.episode import Episode
    from ..views.view import DerivedView, View

__all__ = ["Label"]


@dataclasses.dataclass
class Label(Step):
    """Settings of ``cqn-data label``."""

    name = "label"
    example = """
cqn-data label --repo_id=local/pick --root=data/pick --new_root=data/pick_labelled --all
cqn-data label --repo_id=local/pick --root=data/pick --new_root=data/pick_labelled --failed='[4, 11]'
cqn-data label --repo_id=local/pick --root=data/pick --new_root=data/pick_labelled \\
    --rule='observation.state[gripper.pos].last < 10'
"""
    notes = """
Each last step has next.done; those of successful episodes have next.reward 1 and next.success. All other steps have 0.
Videos are copied as they are. Rules: QUANTITY OPERATOR NUMBER, see drop --help.
"""

    all: bool = option(False, help="All episodes are successes.")
    episodes: list[int] = dataclasses.field(
        default_factory=list, metadata={"help": "Numbers of the successes, e.g. '[0, 1, 5]'; the others failed."}
    )
    failed: list[int] = dataclasses.field(
        default_factory=list, metadata={"help": "Numbers of the failures; the others are successes."}
    )
    column: str | None = option(None, help="A success has a true or positive value in this column, anywhere.")
    rule: str | None = option(None, help="Successes are the episodes for which this rule holds.")

    def validate(self) -> None:
        """Exactly one way must be given."""
        given = [n for n in ("all", "episodes", "failed", "column", "rule") if getattr(self, n)]
        if len(given) != 1:
            found = ", ".join(f"--{n}" for n in given) or "none"
            raise ConfigError(f"Expected one of --all, --episodes, --failed, --column, --rule; got {found}.")

    def on(self, view: "View") -> "DerivedView":
        """Judge every episode; raises ConfigError for an unknown episode, column or rule."""
        from ..decisions.rewards import REWARD_FEATURES
        from ..views.labelled import Labelled

        judge = self._judge(view)
        successes = {i: judge(view.episode(i)) for i in view.episodes}
        there = [k for k in REWARD_FEATURES if k in view.features]
        if there:
            note(f"The present {', '.join(there)} are replaced.")
        won = [str(i) for i, ok in successes.items() if ok]
        lost = [str(i) for i, ok in successes.items() if not ok]
        if not won:
            note("No episode is a success: CQN has nothing to imitate.")
        rows = [["success", str(len(won)), _short(won)], ["failure", str(len(lost)), _short(lost)]]
        table(["label", "episodes", "numbers"], rows, ["total", str(len(successes)), ""])
        after = Labelled(view, successes=successes)
        after.entry.update(settings=settings_of(self), failures=[i for i, ok in successes.items() if not ok])
        return after

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """The sentence for the history."""
        failed = entry["failures"]
        which = f"every episode but {numbered(failed)}, which failed" if failed else "every episode; all are successes"
        return f"Wrote sparse rewards: 1 on the last step of {which}."

    def _judge(self, view: "View") -> "Callable[[Episode], bool]":
        import numpy as np

        from ..decisions.episode_rules import parse_rule

        if self.rule:
            rule = parse_rule(self.rule, view.features)
            return lambda episode: rule.holds(episode.columns, len(episode), view.fps)
        if self.column is not None:
            column = self.column
            numbers = [k for k, f in view.features.items() if f["dtype"] not in ("string", "image", "video")]
            if column not in numbers:
                raise ConfigError(one_of("column", column, numbers))
            return lambda episode: bool((np.asarray(episode.columns[column]) > 0).any())
        known_episodes(view, [*self.episodes, *self.failed])
        if self.failed:
            return lambda episode: episode.index not in self.failed
        return lambda episode: self.all or episode.index in self.episodes


def _short(numbers: "Sequence[str]") -> str:
    return ", ".join(numbers[:10]) + (", …" if len(numbers) > 10 else "")
