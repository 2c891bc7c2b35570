"""``cqn-data filter``: a new dataset without the time steps in which nothing moves.

The rule and why it keeps delta and absolute actions valid: see ``pauses``.
"""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .console import load_lerobot, note, progress, result, table
from .options import help_page, option, parse

if TYPE_CHECKING:
    from .pauses import EpisodeReport, Rule
    from .source import Episode, Source

__all__ = ["FilterConfig", "filter_dataset", "help", "main"]

SOURCE_EPISODE, SOURCE_FRAME = "source.episode_index", "source.frame_index"
EXAMPLE = """
cqn-data filter --repo_id=local/click --root=data/click --dry_run=true
cqn-data filter --repo_id=local/click --root=data/click \\
    --new_repo_id=local/click_filtered --new_root=data/click_filtered --threshold=0.005
"""
NOTES = """
A step is a pause when it leads to a state in which no joint differs by its threshold from where the last kept step
led; slow motion adds up and is kept. Gripper changes, rewards and the last step of each episode are always kept.
"""


@dataclasses.dataclass
class FilterConfig:
    """Settings of ``cqn-data filter``; units are those of the dataset (often radians, or degrees)."""

    repo_id: str = option(help="Dataset to read, as user/name.")
    root: str | None = option(None, help="Its folder; by default LeRobot's home and the repo_id.")
    new_repo_id: str | None = option(None, help="Name of the new dataset; by default the old one and _filtered.")
    new_root: str | None = option(
        None, help="Its folder, which must not exist; by default LeRobot's home and the name."
    )
    threshold: float = option(0.005, help="A joint that moved less is still, in the unit of observation.state.")
    joint_thresholds: dict[str, float] = dataclasses.field(
        default_factory=dict,
        metadata={"help": """Other thresholds for single joints, e.g. '{"wrist_roll.pos": 1.5}'."""},
    )
    gripper_threshold: float | None = option(
        None, help="A gripper that changed more is an event; by default --threshold."
    )
    gripper_names: list[str] = dataclasses.field(
        default_factory=list,
        metadata={"help": """Gripper dimensions, e.g. '["right_hand"]'; by default those named *gripper*."""},
    )
    keep_first: int = option(0, help="Steps at the start of each episode that are always kept.")
    keep_last: int = option(1, help="Steps at the end of each episode that are always kept, at least 1.")
    min_pause: int = option(1, help="Pauses of fewer steps are left in.")
    min_steps: int = option(5, help="An episode that would keep fewer steps stops the whole operation.")
    compare: str = option(
        "after", help="Compare the states that steps lead to (after) or start from (before; keeps 'stay' actions)."
    )
    reward: str = option(
        "auto",
        help="last: reward 1, done and success on each last step; keep: as in the source; auto: keep if there.",
    )
    dry_run: bool = option(False, help="Only show what would be dropped; needs no videos.")
    report: str | None = option(None, help="Write the report as JSON to this file.")

    def validate(self) -> None:
        """Check ranges; raises ConfigError naming the option, the range and the value."""
        from lerobot_cqn.errors import ConfigError, one_of

        for name, value in [("threshold", self.threshold), *self.joint_thresholds.items()]:
            if not 0 < value < float("inf"):
                raise ConfigError(f"Expected a positive, finite threshold for '{name}', got {value}.")
        if self.gripper_threshold is not None and not self.gripper_threshold >= 0:
            raise ConfigError(f"Expected --gripper_threshold >= 0, got {self.gripper_threshold}.")
        for name, low in (("keep_first", 0), ("keep_last", 1), ("min_pause", 1), ("min_steps", 1)):
            if getattr(self, name) < low:
                raise ConfigError(f"Expected --{name} >= {low}, got {getattr(self, name)}.")
        for name, valid in (("compare", ("after", "before")), ("reward", ("auto", "last", "keep"))):
            if getattr(self, name) not in valid:
                raise ConfigError(one_of(f"--{name}", getattr(self, name), valid))


def help() -> str:
    """Help page."""
    return help_page("filter", "drop the time steps in which nothing moves", FilterConfig, EXAMPLE, NOTES)


def main(args: list[str]) -> None:
    """Run from the command line; errors as in :func:`filter_dataset`."""
    filter_dataset(parse(FilterConfig, args))


def filter_dataset(config: FilterConfig) -> "list[EpisodeReport]":
    """Filter a dataset and print the table.

    Returns:
        one report for each episode.

    Raises:
        ConfigError: a setting out of range or an unknown joint.
        DataError: the source is missing, damaged, not finite, or an episode would keep too few steps.
        OutputExistsError: the new folder or the report file exists already.
    """
    config.validate()
    load_lerobot()
    from .source import local_root, open_source
    from .target import refuse_existing, refuse_inside

    new_repo_id = config.new_repo_id or f"{config.repo_id}_filtered"
    new_root = local_root(new_repo_id, config.new_root)
    if not config.dry_run:
        refuse_existing(new_root)
        refuse_inside(local_root(config.repo_id, config.root), new_root)
    if config.report:
        refuse_existing(Path(config.report))
    source = open_source(config.repo_id, config.root)
    _refuse_unknown_kinds(source)
    if not config.dry_run:
        source.check_videos()
    rule = _rule(config, source)
    write_rewards = _writes_rewards(config, source)
    masks, reports = _plan(config, source, rule, write_rewards)
    _show(config, reports, write_rewards)
    entry = _history_entry(config, new_repo_id, rule, reports, write_rewards)
    short = [r for r in reports if r.kept < min(config.min_steps, r.steps)]
    if config.report:
        Path(config.report).write_text(json.dumps(entry, indent=2) + "\n")
    _refuse_short(config, short)
    if config.dry_run:
        result("Dry run: nothing was written.")
        return reports
    _write(source, masks, new_repo_id, new_root, entry, write_rewards)
    result(f"Wrote {new_repo_id} to {new_root}")
    return reports


def _refuse_unknown_kinds(source: "Source") -> None:
    from lerobot_cqn.errors import DataError

    for key, feature in source.features.items():
        if feature["dtype"] == "language" or key in source.meta.depth_keys:
            kind = "language" if feature["dtype"] == "language" else "depth"
            raise DataError(f"Feature '{key}' is a {kind} column, which filter cannot rewrite; remove it first.")
    for key in ("observation.state", "action"):
        if key not in source.features:
            raise DataError(f"Expected a feature '{key}', found {', '.join(source.features)}.")


def _rule(config: FilterConfig, source: "Source") -> "Rule":
    from lerobot_cqn.errors import ConfigError, one_of

    from .pauses import Rule
    from .source import dimension_names

    states = dimension_names(source.features["observation.state"])
    actions = dimension_names(source.features["action"])

    def grippers(names: list[str]) -> tuple[int, ...]:
        wanted = config.gripper_names
        return tuple(i for i, n in enumerate(names) if (n in wanted if wanted else "gripper" in n.lower()))

    for name in config.gripper_names:
        if name not in states and name not in actions:
            raise ConfigError(one_of("gripper dimension", name, {*states, *actions}))
    gripper_state, gripper_action = grippers(states), grippers(actions)
    joints = tuple(i for i in range(len(states)) if i not in gripper_state)
    for name in config.joint_thresholds:
        if name not in [states[i] for i in joints]:
            raise ConfigError(one_of("joint", name, [states[i] for i in joints]))
    if not gripper_state and not gripper_action:
        note('No dimension is named "gripper", so gripper changes are not protected; name it with --gripper_names.')
    return Rule(
        joints=joints,
        thresholds=tuple(config.joint_thresholds.get(states[i], config.threshold) for i in joints),
        gripper_state=gripper_state,
        gripper_action=gripper_action,
        gripper_threshold=config.threshold if config.gripper_threshold is None else config.gripper_threshold,
        keep_first=config.keep_first,
        keep_last=config.keep_last,
        min_pause=config.min_pause,
        compare="after" if config.compare == "after" else "before",
    )


def _writes_rewards(config: FilterConfig, source: "Source") -> bool:
    from lerobot_cqn.schema import NEXT_REWARD

    from .rewards import REWARD_FEATURES

    there = [k for k in REWARD_FEATURES if k in source.features]
    write = config.reward == "last" or (config.reward == "auto" and not there)
    if write and there:
        note(f"The source's {', '.join(there)} are replaced (--reward=last).")
    if not write and NEXT_REWARD not in source.features:
        note(f"The source has no {NEXT_REWARD} and none is written; --reward=last would write one.")
    return write


def _plan(
    config: FilterConfig, source: "Source", rule: "Rule", write_rewards: bool
) -> tuple[list[Any], "list[EpisodeReport]"]:
    """(T,) masks and reports of all episodes; reads numbers only, no pictures."""
    import numpy as np

    from .pauses import keep_mask, report_episode
    from .rewards import carries_reward

    masks, reports, moves, carried = [], [], [], 0
    for index in range(source.meta.total_episodes):
        episode = source.episode(index)
        state, action = episode.columns["observation.state"], episode.columns["action"]
        always = np.zeros(len(episode), bool) if write_rewards else carries_reward(episode.columns, len(episode))
        mask = keep_mask(state, action, rule, always)
        masks.append(mask)
        reports.append(report_episode(index, state, action, mask, rule))
        carried += int(always.sum())
        if rule.joints:
            moves.append(np.abs(np.diff(state[:, list(rule.joints)].astype(np.float64), axis=0)).max(axis=1))
    steps = sum(r.steps for r in reports)
    share = sum(r.dropped for r in reports) / steps
    every = np.concatenate(moves) if moves else np.zeros(0)
    if len(every) and (share < 0.02 or share > 0.8):
        quarter, half, most = np.percentile(every, [25, 50, 90])
        note(
            f"--threshold={config.threshold} drops {share:.0%}. For a choice: from step to step the joint that moves"
            f" most moves {quarter:.3g} / {half:.3g} / {most:.3g} (25th / 50th / 90th percentile)."
        )
    if carried > steps // 2:
        note(f"{carried} of {steps} steps carry a reward and are kept; --reward=last replaces the rewards.")
    return masks, reports


def _show(config: FilterConfig, reports: "list[EpisodeReport]", write_rewards: bool) -> None:
    def row(name: str, group: "list[EpisodeReport]") -> list[str]:
        steps, dropped = sum(r.steps for r in group), sum(r.dropped for r in group)
        lengths = [length for r in group for _, length in r.runs]
        near = sum(r.dropped_near_gripper for r in group)
        cells = [steps, steps - dropped, dropped, f"{dropped / steps:.0%}", len(lengths), max(lengths, default=0), near]
        return [name, *map(str, cells)]

    heads = ["episode", "steps", "kept", "dropped", "share", "pauses", "longest", "near gripper"]
    table(heads, [row(str(r.episode), [r]) for r in reports], row("total", reports))
    if write_rewards:
        result("The last step of each episode is taken as its success (reward 1, done, success).")


def _refuse_short(config: FilterConfig, short: "list[EpisodeReport]") -> None:
    from lerobot_cqn.errors import DataError

    if short:
        named = ", ".join(f"{r.episode} ({r.kept} of {r.steps})" for r in short[:5])
        more = f" and {len(short) - 5} more" if len(short) > 5 else ""
        raise DataError(
            f"Too little would be left of episode {named}{more}; expected at least --min_steps={config.min_steps}."
            " Lower --threshold, raise --min_pause, or remove the episode."
        )


def _history_entry(
    config: FilterConfig, new_repo_id: str, rule: "Rule", reports: "list[EpisodeReport]", write_rewards: bool
) -> dict[str, Any]:
    local = ("root", "new_root", "new_repo_id", "report", "dry_run", "repo_id")  # folders of one machine stay there
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in local}
    settings |= {"gripper_threshold": rule.gripper_threshold, "reward": "last" if write_rewards else "keep"}
    steps, kept = sum(r.steps for r in reports), sum(r.kept for r in reports)
    return {
        "operation": "filter",
        "source": config.repo_id,
        "target": new_repo_id,
        "settings": settings,
        "total": {"episodes": len(reports), "steps": steps, "kept": kept, "share": round(1 - kept / steps, 4)},
        "episodes": [r.as_json() for r in reports],
    }


def _write(
    source: "Source", masks: list[Any], repo_id: str, root: Path, entry: dict[str, Any], write_rewards: bool
) -> None:
    import numpy as np

    from .rewards import REWARD_FEATURES, last_step_rewards
    from .target import append_history, new_dataset

    index_feature = {"dtype": "int64", "shape": (1,), "names": None}
    traced = SOURCE_EPISODE in source.features  # filtered before: keep pointing at the first recording
    features = {k: {n: v for n, v in f.items() if n != "info"} for k, f in source.features.items()}
    features |= REWARD_FEATURES if write_rewards else {}
    features |= {} if traced else {SOURCE_EPISODE: index_feature, SOURCE_FRAME: index_feature}
    meta = source.meta
    writer = new_dataset(
        repo_id, root, fps=meta.fps, features=features, robot_type=meta.robot_type, encoder=_encoder(source)
    )
    with writer as target, progress() as bar:
        for index in bar.track(range(len(masks)), description="Writing episodes"):
            episode = source.episode(index)
            steps = np.flatnonzero(masks[index])
            extra: dict[str, Any] = {} if traced else _trace(index, steps)
            extra |= last_step_rewards(len(steps)) if write_rewards else {}
            for frame, task in _frames(source, episode, steps, extra):
                target.add(frame, task)
            target.save_episode()
        append_history(target.folder, source.root, entry)


def _trace(index: int, steps: Any) -> dict[str, Any]:
    import numpy as np

    frames = steps.astype(np.int64)[:, None]
    return {SOURCE_EPISODE: np.full_like(frames, index), SOURCE_FRAME: frames}


def _frames(
    source: "Source", episode: "Episode", steps: Any, extra: dict[str, Any]
) -> Iterable[tuple[dict[str, Any], str]]:
    """The kept steps as LeRobot frames, with ``extra`` columns of one row for each kept step."""
    columns = {k: v for k, v in episode.columns.items() if k != "timestamp" and k not in extra}
    for position, pictures in enumerate(source.camera_frames(episode, steps)):
        step = int(steps[position])
        values = {k: v[step] for k, v in columns.items()} | {k: v[position] for k, v in extra.items()}
        yield {**values, **pictures}, episode.tasks[step]


def _encoder(source: "Source") -> Any:
    """The source's video settings, where this machine can encode them; else LeRobot's default."""
    from lerobot.configs import RGBEncoderConfig

    for key in source.meta.video_keys:
        try:
            return RGBEncoderConfig.from_video_info(source.meta.features[key].get("info"))
        except ValueError:
            note("The source's video codec cannot be encoded here; LeRobot's default is used.")
    return None
