"""``cqn-data trim``: cut the heads and tails of episodes, by steps, seconds, leaps, motion, or after the success."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError, DataError
from lerobot_cqn.schema import ACTION, NEXT_REWARD, NEXT_SUCCESS, STATE

from ..terminal.console import table
from ..terminal.options import option
from .job import Step, settings_of
from .parts import known_episodes

if TYPE_CHECKING:
    from ..views.episode import Episode
    from ..views.view import DerivedView, View

__all__ = ["Trim"]


@dataclasses.dataclass
class Trim(Step):
    """Settings of ``cqn-data trim``."""

    name = "trim"
    example = """
cqn-data trim --repo_id=local/click --root=data/click --new_root=data/click_trimmed --leap
cqn-data trim --repo_id=local/click --root=data/click --new_root=data/click_trimmed --motion --auto --keep_still=5
cqn-data trim --repo_id=local/click --root=data/click --head_seconds=0.5 --tail=3 --dry_run
"""
    notes = """
First --after_success, then --leap, then --head and --tail (or the episode's --cuts), then --motion. A part that
carries a reward or an end is only cut off with --cut_rewards.
"""

    head: int = option(0, help="Steps to cut at the start.")
    tail: int = option(0, help="Steps to cut at the end.")
    head_seconds: float = option(0.0, help="Seconds to cut at the start, instead of --head.")
    tail_seconds: float = option(0.0, help="Seconds to cut at the end, instead of --tail.")
    cuts: dict[int, list[int]] = dataclasses.field(
        default_factory=dict,
        metadata={
            "help": """Steps to cut at start and end of single episodes, e.g. '{"3": [12, 5]}', instead of those."""
        },
    )
    cut_rewards: bool = option(False, help="Cut off rewards and ends, too: a label step writes them anew after it.")
    leap: bool = option(
        False, help="Cut the first steps in which the arm is on its way to a leader that stood elsewhere."
    )
    motion: bool = option(False, help="Cut until the first motion and after the last one.")
    keep_still: int = option(0, help="Still steps that --motion leaves at either end; some teach to settle.")
    threshold: float | None = option(None, help="A joint that moved less is still, as in filter; for --motion.")
    auto: bool = option(False, help="Choose the threshold from the data; for --motion.")
    after_success: bool = option(False, help="Cut what comes after the first step with success or reward.")
    min_steps: int = option(2, help="An episode that would keep fewer steps stops the operation.")

    def validate(self) -> None:
        """Check ranges; raises ConfigError naming the option, the range and the value."""
        for name in ("head", "tail", "head_seconds", "tail_seconds", "keep_still"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ConfigError(f"Expected --{name} >= 0, got {getattr(self, name)}.")
        if (self.head and self.head_seconds) or (self.tail and self.tail_seconds):
            raise ConfigError("Expected steps or seconds for an end, got both.")
        for index, cut in self.cuts.items():
            if len(cut) != 2 or min(cut) < 0:
                raise ConfigError(f"Expected --cuts of [start, end], both >= 0, for episode {index}, got {cut}.")
        if self.min_steps < 1:
            raise ConfigError(f"Expected --min_steps >= 1, got {self.min_steps}.")
        asked = (self.head, self.tail, self.head_seconds, self.tail_seconds, self.motion, self.after_success, self.cuts)
        if not any((*asked, self.leap)):
            raise ConfigError(
                "Nothing to trim: give --head, --tail, their seconds, --cuts, --leap, --motion or --after_success."
            )
        self._motion().validate()

    def _motion(self) -> Any:
        from .filter import Filter

        return Filter(threshold=self.threshold, auto=self.auto)

    def reads_numbers(self) -> bool:
        """What is left out may be infinite."""
        return self.motion

    def on(self, view: "View") -> "DerivedView":
        """Find where each episode begins and ends; raises DataError where too little or a reward would be lost."""
        import numpy as np

        from ..decisions.rewards import carries_reward
        from ..views.selected import Selected

        if self.after_success and not {NEXT_REWARD, NEXT_SUCCESS} & set(view.features):
            raise ConfigError(
                f"--after_success needs a column {NEXT_SUCCESS} or {NEXT_REWARD}; label the dataset first."
            )
        rule = self._motion().rule(view)[0] if self.motion else None
        known_episodes(view, self.cuts)
        common = self.head or round(self.head_seconds * view.fps), self.tail or round(self.tail_seconds * view.fps)
        leaps = self._leaps(view) if self.leap else {}
        after, cut = Selected(view), []
        for index in view.episodes:
            episode = view.episode(index)
            start, success = leaps.get(index, 0), self._success(episode)
            stop = len(episode) if success is None else success + 1
            head, tail = self.cuts.get(index, common)
            start, stop = start + head, stop - tail
            if rule is not None and stop - start > 1:
                start, stop = self._moving(episode, start, stop, rule)
            lost = carries_reward(episode.columns, len(episode))
            lost[start : max(start, stop)] = False
            if success is not None:
                lost[success + 1 :] = False
            if stop - start < self.min_steps:
                raise DataError(
                    f"Only {max(0, stop - start)} of {len(episode)} steps would be left of episode {index}; expected at"
                    f" least --min_steps={self.min_steps}. Trim less, or drop it."
                )
            if lost.any() and not self.cut_rewards:
                raise DataError(
                    f"Episode {index}, frame {int(np.flatnonzero(lost)[0])} carries a reward or an end and would be cut"
                    " off; trim less, or --cut_rewards and label the result."
                )
            after.rows[index] = np.arange(start, stop)
            cut.append([index, len(episode), stop - start, start, len(episode) - stop])
        heads = ["episode", "steps", "kept", "cut at start", "cut at end"]
        total = ["total", *(str(sum(row[i] for row in cut)) for i in range(1, 5))]
        table(heads, [[str(v) for v in row] for row in cut], total)
        episodes = [dict(zip(("episode", "steps", "kept", "head", "tail"), row, strict=True)) for row in cut]
        after.entry.update(settings=settings_of(self), episodes=episodes)
        return after

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """The sentence for the history."""
        head, tail = (sum(e[k] for e in entry["episodes"]) for k in ("head", "tail"))
        return f"Cut {head} steps off the starts and {tail} off the ends of {len(entry['episodes'])} episodes."

    def _leaps(self, view: "View") -> dict[int, int]:
        """Steps, by episode, in which the arm is still on its way to the leader; raises DataError for differences."""
        from ..decisions.joints import match_joints
        from ..decisions.leaps import Leaps

        if view.deltas is not None:
            raise DataError("Expected absolute actions for --leap, found differences: trim before delta.")
        matched, leaps = match_joints(view.features), Leaps()
        for index in view.episodes:
            columns = view.episode(index).columns
            action, state = columns[ACTION][:, list(matched.action_dims)], columns[STATE][:, list(matched.state_dims)]
            leaps.add(index, action.astype(float), state.astype(float))
        return {index: steps for index, (steps, *_) in leaps.found().items()}

    def _success(self, episode: "Episode") -> int | None:
        """First successful step, if there is one and it matters."""
        import numpy as np

        if not self.after_success:
            return None
        columns = episode.columns
        found = columns[NEXT_SUCCESS] if NEXT_SUCCESS in columns else columns[NEXT_REWARD] > 0
        steps = np.flatnonzero(np.asarray(found).reshape(len(episode)))
        return int(steps[0]) if len(steps) else None

    def _moving(self, episode: "Episode", start: int, stop: int, rule: Any) -> tuple[int, int]:
        """The part from the first motion to the last, with the still steps asked for around it."""
        import numpy as np

        from ..decisions.pauses import keep_mask

        state, action = (episode.columns[k][start:stop] for k in (STATE, ACTION))
        moves = np.flatnonzero(keep_mask(state, action, rule)[:-1])
        if len(moves) == 0:
            return start, start
        # The step after the last motion holds the state it led to.
        first, last = start + int(moves[0]), start + int(moves[-1]) + 1
        return max(start, first - self.keep_still), min(stop, last + 1 + self.keep_still)
