"""``cqn-data filter``: leave out the time steps in which nothing moves. The rule and why it is safe: see ``pauses``."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_cqn.errors import ConfigError, DataError, one_of
from lerobot_cqn.history_text import numbered, shown
from lerobot_cqn.schema import ACTION, STATE, dimension_names

from ..disk.folders import refuse_existing
from ..terminal.console import note, result, table
from ..terminal.options import option
from .job import Step, settings_of
from .parts import known_episodes

if TYPE_CHECKING:
    from ..decisions.pauses import EpisodeReport, Rule
    from ..views.view import DerivedView, View

__all__ = ["Filter"]


@dataclasses.dataclass
class Filter(Step):
    """Settings of ``cqn-data filter``; units are those of the dataset (often radians, or degrees)."""

    name = "filter"
    example = """
cqn-data filter --repo_id=local/click --root=data/click --auto --dry_run
cqn-data filter --repo_id=local/click --root=data/click \\
    --new_repo_id=local/click_filtered --new_root=data/click_filtered --threshold=0.005
"""
    notes = """
A step is a pause when no joint differs by its threshold from the next step that is kept: it leads nowhere. So the step
that ends a pause stays, and slow motion adds up. Gripper changes, rewards and the last step of each episode are always
kept. Filtering again with the same threshold drops nothing.
Delta actions are formed anew, so that they connect the states that are left.
"""

    threshold: float | None = option(
        None, help="A joint that moved less is still, in the unit of observation.state; by default 0.005."
    )
    auto: bool = option(False, help="Choose the threshold from the data and say why (inspect shows the histogram).")
    joint_thresholds: dict[str, float] = dataclasses.field(
        default_factory=dict,
        metadata={"help": """Other thresholds for single joints, e.g. '{"wrist_roll.pos": 1.5}'."""},
    )
    episode_thresholds: dict[int, float] = dataclasses.field(
        default_factory=dict,
        metadata={"help": """Other thresholds for single episodes, e.g. '{"3": 0.01}'; 0 keeps all of its steps."""},
    )
    gripper_threshold: float | None = option(
        None, help="A gripper that changed more is an event; by default the threshold."
    )
    gripper_names: list[str] = dataclasses.field(
        default_factory=list,
        metadata={"help": """Gripper dimensions, e.g. '["right_hand"]'; by default those named *gripper*."""},
    )
    keep_first: int = option(0, help="Steps at the start of each episode that are always kept.")
    keep_last: int = option(
        1, help="Steps at the end of each episode that are always kept, at least 1; more teach to settle."
    )
    min_pause: int = option(1, help="Pauses of fewer steps are left in.")
    min_steps: int = option(
        5, help="An episode that would keep fewer steps stops the operation, or is skipped if asked."
    )
    skip_short: bool = option(False, help="Leave out episodes that would keep fewer than --min_steps.")
    compare: str = option(
        "after", help="Compare with the next kept step (after) or the last one (before; keeps 'stay' actions)."
    )
    preview: str | None = option(
        None, help="Show what goes: FILE.mp4 (dropped frames in red) or FILE.png (curves of the joints)."
    )

    def validate(self) -> None:
        """Check ranges; raises ConfigError naming the option, the range and the value."""
        thresholds = [("threshold", 1.0 if self.threshold is None else self.threshold), *self.joint_thresholds.items()]
        for name, value in thresholds:
            if not 0 < value < float("inf"):
                raise ConfigError(f"Expected a positive, finite threshold for '{name}', got {value}.")
        for index, value in self.episode_thresholds.items():
            if not 0 <= value < float("inf"):
                raise ConfigError(f"Expected a finite --episode_thresholds >= 0 for episode {index}, got {value}.")
        if self.auto and self.threshold is not None:
            raise ConfigError("--auto chooses the threshold and --threshold gives one: expected only one of them.")
        if self.gripper_threshold is not None and not self.gripper_threshold >= 0:
            raise ConfigError(f"Expected --gripper_threshold >= 0, got {self.gripper_threshold}.")
        for name, low in (("keep_first", 0), ("keep_last", 1), ("min_pause", 1), ("min_steps", 1)):
            if getattr(self, name) < low:
                raise ConfigError(f"Expected --{name} >= {low}, got {getattr(self, name)}.")
        if self.compare not in (valid := ("after", "before")):
            raise ConfigError(one_of("--compare", self.compare, valid))
        if self.preview:
            if not self.preview.endswith((".mp4", ".png")):
                raise ConfigError(f"Expected --preview=FILE.mp4 or FILE.png, got '{self.preview}'.")
            refuse_existing(Path(self.preview))

    def on(self, view: "View") -> "DerivedView":
        """Decide which steps stay; reads numbers only, no pictures but for the preview."""
        from ..views.selected import filtered_view

        rule, why = self.rule(view)
        known_episodes(view, self.episode_thresholds)
        rules = {index: self.rule_with(view, rule, own) for index, own in self.episode_thresholds.items()}
        after, reports = filtered_view(view, rule, self.min_steps, skip=self.skip_short, rules=rules)
        _show(reports)
        self._advise(view, reports)
        if self.preview:
            from .preview import write_preview

            shown = write_preview(self.preview, view, after, rule)
            result(f"Preview: {self.preview}{shown}")
        steps, kept = sum(r.steps for r in reports), sum(r.kept for r in reports)
        settings = settings_of(self) | {"threshold": min(rule.thresholds, default=0.0)} | why
        settings.pop("preview", None)
        after.entry.update(
            settings=settings | {"gripper_threshold": rule.gripper_threshold},
            total={"episodes": len(reports), "steps": steps, "kept": kept, "share": round(1 - kept / steps, 4)},
            episodes=[r.as_json() for r in reports],
        )
        return after

    @staticmethod
    def told(entry: Mapping[str, Any]) -> str:
        """The sentence for the history."""
        total = entry["total"]
        gone, pauses = total["steps"] - total["kept"], sum(len(e["pauses"]) for e in entry["episodes"])
        settings, left = entry["settings"], entry.get("left_out")
        why = f" {settings['why'].rstrip('.')}." if settings.get("why") else ""
        short = f" Left out {numbered(list(left))}, of which too little would be left." if left else ""
        return (
            f"Left out {gone} of {total['steps']} steps ({gone / total['steps']:.0%}), in {pauses} pauses in which"
            f" nothing moves: below {shown(settings['threshold'])} a step.{why}{short}"
        )

    def rule_with(self, view: "View", rule: "Rule", own: float) -> "Rule":
        """The rule with another threshold in place of the common one; joints with one of their own keep it."""
        names = dimension_names(view.features[STATE])
        thresholds = tuple(self.joint_thresholds.get(names[i], own) for i in rule.joints)
        return dataclasses.replace(rule, thresholds=thresholds)

    def rule(self, view: "View") -> "tuple[Rule, dict[str, Any]]":
        """Rule of what a pause is in this dataset, and reasons for an automatic threshold; says what it goes by."""
        from ..decisions.pauses import DRIVES

        why: dict[str, Any] = {}
        rule = self.rule_at(view, 0.005 if self.threshold is None else self.threshold)
        if not rule.gripper_state and not rule.gripper_action:
            note('No dimension is named "gripper", so gripper changes are not protected; name it with --gripper_names.')
        if self.auto:
            threshold, why = _choose(view, rule.joints)
            rule = self.rule_at(view, threshold)
        if rule.rates_state or rule.rates_action:
            states, actions = (dimension_names(view.features[k]) for k in (STATE, ACTION))
            names = [states[i] for i in rule.rates_state] + [actions[i] for i in rule.rates_action]
            named = ", ".join(dict.fromkeys(names))
            note(f"Velocities: {named}; a step at which one is above {DRIVES:.0%} of its largest value is no pause.")
        return rule, why

    def rule_at(self, view: "View", threshold: float) -> "Rule":
        """Rule of what a pause is in this dataset at a threshold.

        Raises:
            ConfigError: a joint or gripper is named that is not there.
            DataError: there are no states or no actions.
        """
        from ..decisions.joints import gripper_dims, rate_dims
        from ..decisions.pauses import Rule

        for key in (STATE, ACTION):
            if key not in view.features:
                raise DataError(f"Expected a feature '{key}', found {', '.join(view.features)}.")
        states, actions = (dimension_names(view.features[k]) for k in (STATE, ACTION))
        for name in self.gripper_names:
            if name not in states and name not in actions:
                raise ConfigError(one_of("gripper dimension", name, {*states, *actions}))
        gripper_state, gripper_action = (
            gripper_dims(states, self.gripper_names),
            gripper_dims(actions, self.gripper_names),
        )
        rates_state = tuple(i for i in rate_dims(states) if i not in gripper_state)
        rates_action = tuple(i for i in rate_dims(actions) if i not in gripper_action)
        joints = tuple(i for i in range(len(states)) if i not in gripper_state and i not in rates_state)
        known = [*(states[i] for i in (*joints, *rates_state)), *(actions[i] for i in rates_action)]
        for name in self.joint_thresholds:
            if name not in known:
                raise ConfigError(one_of("joint", name, known))
        return Rule(
            joints=joints,
            thresholds=tuple(self.joint_thresholds.get(states[i], threshold) for i in joints),
            gripper_state=gripper_state,
            gripper_action=gripper_action,
            gripper_threshold=threshold if self.gripper_threshold is None else self.gripper_threshold,
            keep_first=self.keep_first,
            keep_last=self.keep_last,
            min_pause=self.min_pause,
            compare="after" if self.compare == "after" else "before",
            rates_state=rates_state,
            limits_state=self._limits(view, STATE, rates_state, states),
            rates_action=rates_action,
            limits_action=self._limits(view, ACTION, rates_action, actions),
        )

    def _limits(self, view: "View", column: str, rates: tuple[int, ...], names: list[str]) -> tuple[float, ...]:
        """For each velocity the value above which something moves: as asked for, else a share of the largest one."""
        import numpy as np

        from ..decisions.pauses import DRIVES

        largest = np.zeros(len(names))
        for index in view.episodes if rates else ():
            values = np.abs(np.asarray(view.episode(index).columns[column], np.float64))
            largest = np.maximum(largest, values.reshape(len(values), -1).max(axis=0))
        return tuple(self.joint_thresholds.get(names[i], DRIVES * float(largest[i])) for i in rates)

    def _advise(self, view: "View", reports: "list[EpisodeReport]") -> None:
        """Help with the choice where it looks wrong."""
        steps, dropped = sum(r.steps for r in reports), sum(r.dropped for r in reports)
        if not self.auto and not 0.02 <= dropped / steps <= 0.8:
            note(f"{dropped / steps:.0%} of the steps go; --auto chooses a threshold, inspect shows a histogram.")
        pushing = sum(r.dropped_while_commanded for r in reports)
        if pushing > 0.02 * steps:
            note(
                f"In {pushing} of the dropped steps the command moved while the arm did not: contact, or the start of a"
                " motion. For contact tasks take a smaller --threshold."
            )


def _choose(view: "View", joints: tuple[int, ...]) -> tuple[float, dict[str, Any]]:
    """A threshold from the data, and why; the earlier one where the pauses it would be read from are gone."""
    from ..decisions.pause_threshold import suggest

    if not joints:  # velocities only
        return 0.005, {}
    for entry in reversed(view.history()):
        if entry.get("operation") == "filter" and "threshold" in entry.get("settings", {}):
            reason = "as in the earlier filter, since most pauses to judge by are gone."
            result(f"Threshold {entry['settings']['threshold']:.4g}: {reason}")
            return float(entry["settings"]["threshold"]), {"why": reason}
    found = suggest(view.episode(i).columns[STATE][:, list(joints)] for i in view.episodes)
    result(f"Threshold {found.threshold:.4g}: {found.reason}")
    if not found.clear:
        note("Look at the histogram (cqn-data inspect) and give --threshold where you know better.")
    return found.threshold, {"why": found.reason, "clear": found.clear}


def _show(reports: "list[EpisodeReport]") -> None:
    def row(name: str, group: "list[EpisodeReport]") -> list[str]:
        steps, dropped = sum(r.steps for r in group), sum(r.dropped for r in group)
        lengths = [length for r in group for _, length in r.runs]
        near, pushing = sum(r.dropped_near_gripper for r in group), sum(r.dropped_while_commanded for r in group)
        counts = [steps, steps - dropped, dropped, f"{dropped / steps:.0%}", len(lengths), max(lengths, default=0)]
        return [name, *map(str, [*counts, near, pushing])]

    heads = ["episode", "steps", "kept", "dropped", "share", "pauses", "longest", "near gripper", "commanded"]
    table(heads, [row(str(r.episode), [r]) for r in reports], row("total", reports))
