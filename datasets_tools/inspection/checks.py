"""Judgements of ``cqn-data inspect`` on its numbers: findings with a level, a place and an advice."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_cqn.schema import ACTION, NEXT_REWARD, STATE

from .cameras import CameraLook
from .finding import (
    NAMED,
    Finding,
    Level,
    advice_to_drop,
    by_level,
    count,
    episodes_text,
    more,
    names_text,
    places_text,
)
from .meaning import meaning
from .numbers import Dimension, Numbers

__all__ = ["Dataset", "Memory", "findings", "memory"]

SHORT = 5  # steps
JITTER = 0.05  # of a time step
DENSE = 0.5  # share of an episode's steps with a reward, beyond which it is not one for success
STILL = 0.25  # share of still steps that is worth removing
LAG_S = 0.3
FAR_SHARE, FAR_STEPS = 0.1, 3.0  # of a joint's range, and times the step, by which commands lie from the arm
CHATTER = 1.0  # openings and closings of a gripper in a second that no hand makes for long
SQUEEZE = 4.0  # how much wider the whole range of an action is than 98 % of its values
PAPER_SIZE = 84  # pixels, the side of the paper's pictures
GIB = 2**30


@dataclass(frozen=True)
class Dataset:
    """Metadata: frames a second, columns, whether its history calls the actions differences."""

    repo_id: str
    fps: float
    columns: Sequence[str]
    episodes: int
    deltas: bool


@dataclass(frozen=True)
class Memory:
    """Bytes of a replay that holds every step: vectors, and pictures as uint8 at their own size and at 84 x 84."""

    vectors: int
    pictures: int
    pictures_84: int


def memory(numbers: Numbers, cameras: Sequence[CameraLook]) -> Memory:
    """Memory that the replay will need, in bytes; an episode of T steps has T + 1 observations there."""
    observed = numbers.steps + len(numbers.episodes)
    state, action = len(numbers.of(STATE)), len(numbers.of(ACTION))
    return Memory(
        vectors=4 * (observed * state + numbers.steps * (action + 1)),
        pictures=observed * sum(3 * c.height * c.width for c in cameras),
        pictures_84=observed * len(cameras) * 3 * PAPER_SIZE**2,
    )


def findings(
    dataset: Dataset, numbers: Numbers, cameras: Sequence[CameraLook], missing: Mapping[str, Sequence[int]]
) -> list[Finding]:
    """All findings, errors first."""
    found = [
        *_readable(dataset, numbers),
        *_videos(cameras, missing),
        *_times(dataset, numbers),
        *_pauses(dataset, numbers),
        *_rewards(numbers),
        *_ranges(dataset, numbers),
        *_jumps(numbers),
        *_grippers(numbers, dataset.fps),
        *meaning(numbers),
        *_following(dataset, numbers),
        *_duplicates(numbers),
        *_tasks(numbers),
        *_size(numbers, cameras),
    ]
    return sorted(found, key=by_level)


def _readable(dataset: Dataset, numbers: Numbers) -> Iterator[Finding]:
    for index, reason in numbers.bad.items():
        advice = "Leave it out with --skip_bad_episodes of the other operations, or record it again."
        yield Finding("error", "bad_episode", f"episode {index}", reason, advice)
    if not numbers.episodes:
        advice = "Mend the recording first."
        yield Finding("error", "no_episodes", "dataset", "Not one episode can be read.", advice)
    if ACTION not in dataset.columns:
        text = f"There is no '{ACTION}' column; found {', '.join(dataset.columns)}."
        yield Finding(
            "error", "no_action", ACTION, text, _renamed(dataset, ACTION, "the column that holds the commands")
        )
    if STATE not in dataset.columns:
        text = f"There is no '{STATE}' column, so pauses, jumps and lag cannot be looked for."
        yield Finding(
            "warning", "no_state", STATE, text, _renamed(dataset, STATE, "the joint positions, if there are any")
        )
    short = [e.index for e in numbers.episodes if e.steps < SHORT]
    if short:
        yield Finding(
            "warning",
            "short_episode",
            episodes_text(short),
            f"{count(short)} shorter than {SHORT} steps.",
            advice_to_drop(short),
        )


def _renamed(dataset: Dataset, key: str, what: str) -> str:
    """Advice for a column that goes by another name, as in openpi's datasets."""
    other = next((k for k in dataset.columns if k.removesuffix("s") == key.rpartition(".")[2] and k != key), None)
    if other is None:
        return f"Record {what} as '{key}'."
    said = f"'{other}' may be it: rename it to '{key}' in meta/info.json, meta/stats.json and the data files"
    if key == ACTION:
        return said + "."
    return said + f"; lerobot-train renames it for itself: --rename_map='{json.dumps({other: key})}'."


def _videos(cameras: Sequence[CameraLook], missing: Mapping[str, Sequence[int]]) -> Iterator[Finding]:
    for path, held in missing.items():
        text = f"The video file is missing; it holds {episodes_text(list(held))}."
        yield Finding("error", "missing_video", path, text, "Copy it back or download the dataset again.")
    for camera in cameras:
        for reason in camera.broken:
            advice = "Encode or download the file again, or leave the episode out."
            yield Finding("error", "broken_video", camera.key, reason, advice)
        for code, places, what in (("black", camera.dark, "black"), ("blank", camera.flat, "of a single colour")):
            if places:
                level: Level = "error" if len(places) == camera.looked else "warning"
                text = f"{len(places)} of {camera.looked} pictures looked at are {what}: {places_text(places)}."
                yield Finding(level, f"{code}_camera", camera.key, text, "Check cable and exposure; record again.")
        if camera.frozen:
            spans = ", ".join(f"episode {e} from frame {a} to {b}" for e, a, b in camera.frozen[:NAMED])
            text = f"The picture does not change while the arm moves: {spans}{more(camera.frozen)}."
            yield Finding(
                "warning", "frozen_camera", camera.key, text, "See whether the arm is in view; else record again."
            )


def _times(dataset: Dataset, numbers: Numbers) -> Iterator[Finding]:
    uneven = [e.index for e in numbers.episodes if e.jitter > JITTER]
    if uneven:
        worst = max(e.jitter for e in numbers.episodes)
        text = f"Steps last up to {worst:.0%} more or less than 1/{dataset.fps} s."
        advice = "Record with a free computer; pictures and joints may not belong together."
        yield Finding("warning", "jitter", episodes_text(uneven), text, advice)


def _pauses(dataset: Dataset, numbers: Numbers) -> Iterator[Finding]:
    found = numbers.threshold
    if found is None or not found.steps:
        return
    if found.unmoved == 1.0:
        text = "No joint ever moves."
        yield Finding("error", "nothing_moves", STATE, text, "Check that the robot's state was recorded.")
        return
    if not found.clear:
        text = f"The pause threshold is uncertain. {found.reason}"
        advice = "Compare the alternatives, and choose with cqn-data filter --threshold=…"
        yield Finding("note", "unclear_threshold", STATE, text, advice)
    if found.share >= STILL:
        text = f"{found.share:.0%} of the steps move no joint by {found.threshold:g} or more."
        advice = f"Remove them: cqn-data filter --threshold={found.threshold:g}"
        yield Finding("warning" if found.clear else "note", "pauses", STATE, text, advice)
    held = [e.index for e in numbers.episodes if e.still_end > dataset.fps]
    if found.clear and held:
        longest = max(e.still_end for e in numbers.episodes) / dataset.fps
        text = f"{count(held)} with more than a second in which nothing moves, up to {longest:.1f} s."
        advice = "Keep part of it with --keep_last if the policy should learn to hold still at the goal."
        yield Finding("note", "still_end", episodes_text(held), text, advice)


def _rewards(numbers: Numbers) -> Iterator[Finding]:
    if not numbers.rewarded:
        text = f"There is no '{NEXT_REWARD}' column; cqn-train takes the last step of every episode for its success."
        yield Finding("note", "no_reward", NEXT_REWARD, text, "If some failed, say which: cqn-data label.")
        return
    judged = numbers.judged and any(e.success for e in numbers.episodes)  # one that is never true says nothing
    succeeded = {e.index: bool(e.success) if judged else e.first_reward is not None for e in numbers.episodes}
    failed = [index for index, success in succeeded.items() if not success]
    if failed and not any(succeeded.values()):
        text = f"No step of any episode has {'next.success' if judged else 'a reward above 0'}."
        advice = "Say which episodes succeeded: cqn-data label; without a success there is nothing to learn from."
        yield Finding("error", "no_success", NEXT_REWARD, text, advice)
    elif failed:
        text = f"{count(failed)} without {'next.success' if judged else 'a reward above 0'}: failures."
        yield Finding("note", "failures", episodes_text(failed), text, "Fine if they did fail.")
    early = [e for e in numbers.episodes if e.end is not None and e.end < e.steps - 1]
    if early:
        gone = sum(e.steps - 1 - e.end for e in early if e.end is not None)
        by = "next.success" if judged else "the reward"
        text = (
            f"{count(early)} going on after the end that {by} gives them; cqn-train leaves out the {gone} of"
            f" {numbers.steps} steps after it."
        )
        level: Level = "warning" if gone > numbers.steps / 2 else "note"
        advice = "If that is too much, say where they end: cqn-data label." if level == "warning" else ""
        yield Finding(level, "early_end", episodes_text([e.index for e in early]), text, advice)
    dense = [e.index for e in numbers.episodes if e.dense > DENSE]
    if dense:
        text = f"{count(dense)} with a reward in most steps, which a filter keeps and a critic adds up."
        advice = "CQN is made for a reward of 1 at the end: cqn-data label --column=next.success (or --all)."
        yield Finding("warning", "dense_reward", NEXT_REWARD, text, advice)
    disagree = [e.index for e in numbers.episodes if e.success not in (None, e.first_reward is not None)]
    if disagree:
        text = f"{count(disagree)} where next.success and {NEXT_REWARD} disagree."
        yield Finding("warning", "reward_mismatch", episodes_text(disagree), text, "Correct one of the two.")


def _ranges(dataset: Dataset, numbers: Numbers) -> Iterator[Finding]:
    if not numbers.episodes:
        return
    actions = numbers.of(ACTION)
    if actions and all(d.constant for d in actions):
        text = "No action ever changes; there is nothing to imitate."
        yield Finding("error", "constant_actions", ACTION, text, "Check that commands were recorded, not a default.")
    else:
        yield from _constant(ACTION, actions, "CQN will always command the same there.")
    if numbers.threshold is None or numbers.threshold.unmoved < 1.0:
        yield from _constant(STATE, numbers.of(STATE), "A motor that does not move, or a reading that is missing?")
    wide = [d for d in actions if not d.constant and not d.gripper and _squeezed(d) > SQUEEZE]
    if wide:
        worst = max(wide, key=_squeezed)
        text = (
            f"98 % of the values fill a small part of the range ({names_text(wide)}; worst '{worst.name}':"
            f" {worst.inner_low:.3g} to {worst.inner_high:.3g} of {worst.low:.3g} to {worst.high:.3g})."
        )
        advice = "CQN divides the whole range into bins: narrow it with cqn-data bounds --quantile=0.01."
        yield Finding("warning", "wide_actions", ACTION, text, advice)
    if numbers.follow is None and dataset.columns and actions and numbers.of(STATE):
        text = f"{len(actions)} actions and {len(numbers.of(STATE))} states do not match by name or number."
        yield Finding("note", "unmatched", ACTION, text + " Whether actions are positions cannot be told.")


def _constant(column: str, dimensions: Sequence[Dimension], advice: str) -> Iterator[Finding]:
    still = [d for d in dimensions if d.constant]
    if still:
        text = f"{len(still)} of {len(dimensions)} never change: {names_text(still)}."
        yield Finding("warning", "constant_joint" if column == STATE else "constant_action", column, text, advice)


def _squeezed(dimension: Dimension) -> float:
    return (dimension.high - dimension.low) / max(dimension.inner_high - dimension.inner_low, 1e-12)


def _jumps(numbers: Numbers) -> Iterator[Finding]:
    if numbers.jumps:
        shown = "; ".join(
            f"episode {j.episode}, frame {j.frame}, {j.name} ({'action' if j.column == ACTION else 'state'}):"
            f" {j.change:+.3g} at once{' and back' if j.back else ''}, expected less than {j.limit:.2g}"
            for j in numbers.jumps[:NAMED]
        )
        text = f"{numbers.jump_count} jumps far beyond the usual change: {shown}{more(range(numbers.jump_count))}."
        advice = "A value that comes back was read wrongly; one that stays may be an angle that wraps. Look at them."
        yield Finding("warning", "jump", episodes_text(sorted({j.episode for j in numbers.jumps})), text, advice)


def _grippers(numbers: Numbers, fps: float) -> Iterator[Finding]:
    grippers = [d for d in numbers.dimensions if d.gripper]
    if not grippers:
        if numbers.dimensions:
            text = 'No dimension has "gripper" in its name, so a filter would treat it as a joint.'
            yield Finding("note", "no_gripper", ACTION, text, "Name it with --gripper_names, if there is one.")
        return
    counts = {e.index: e.gripper_events for e in numbers.episodes if e.gripper_events is not None}
    if counts and not any(counts.values()):
        text = "The gripper neither opens nor closes in any episode."
        yield Finding("note", "idle_gripper", names_text(grippers), text, "Fine if the task needs none.")
        return
    usual = float(np.median(list(counts.values()))) if counts else 0
    rates = {e.index: (counts.get(e.index) or 0) * fps / e.steps for e in numbers.episodes}
    busy = [i for i, rate in rates.items() if rate > CHATTER and (counts[i] or 0) > 3]
    if len(busy) > len(rates) / 2:  # else those few are odd among the others
        text = f"The gripper opens and closes up to {max(rates.values()):.1f} times a second: {names_text(grippers)}."
        advice = "A command that flickers is learned as such; look at it, and smooth or record again."
        yield Finding("warning", "gripper_chatter", episodes_text(busy), text, advice)
        return
    odd = {e: n for e, n in counts.items() if n is not None and (n > 3 * max(usual, 1) or (n == 0 and usual >= 1))}
    if odd:
        listed = ", ".join(f"episode {e}: {n}" for e, n in list(odd.items())[:NAMED])
        text = f"The gripper usually moves {usual:g} times; {listed}{more(odd)}."
        yield Finding(
            "note", "gripper_events", episodes_text(list(odd)), text, "See whether they are good demonstrations."
        )


def _following(dataset: Dataset, numbers: Numbers) -> Iterator[Finding]:
    follow = numbers.follow
    if follow is None or not numbers.episodes or all(d.constant for d in numbers.of(ACTION)):
        return
    kind, lag = follow.kind(), follow.lag()
    if dataset.deltas and kind == "absolute":
        text = "The dataset's history calls the actions differences, but they look like positions."
        yield Finding("warning", "action_kind", ACTION, text, "Check which they are before training.")
    if kind == "delta" and not dataset.deltas:
        text = "The actions look like joint differences, of which the dataset's history says nothing."
        advice = "Say which to operations that change the steps, e.g. resample --actions=command_steps."
        yield Finding("note", "action_kind", ACTION, text, advice)
    if kind == "other":
        text = "The actions look neither like joint positions nor like their differences."
        yield Finding("note", "action_kind", ACTION, text, "End-effector commands and rates look like that.")
    gap, pace = follow.gap(), follow.pace()
    spans = np.array([d.high - d.low for d in numbers.of(STATE)])[list(follow.state_dims)]
    far = (
        np.flatnonzero((gap > FAR_SHARE * spans) & (gap > FAR_STEPS * pace) & (pace > 0)) if kind == "absolute" else ()
    )
    if len(far):
        worst = max(far, key=lambda j: gap[j] / pace[j])
        names = names_text([numbers.of(ACTION)[follow.action_dims[j]] for j in far])
        text = (
            f"Commands lie far from where the arm is ({names}; worst by {gap[worst]:.3g} on average, where a step moves"
            f" it by {pace[worst]:.3g})."
        )
        advice = "Noise, a limit that cuts them off, or another unit; differences of such commands are as large."
        yield Finding("warning", "far_commands", ACTION, text, advice)
    if kind == "absolute" and (leaps := follow.leaps.found()):
        first, (steps, joint, times) = next(iter(leaps.items()))
        name = numbers.of(ACTION)[follow.action_dims[joint]].name
        text = (
            f"The arm leaps to the leader at the start of {count(list(leaps))} of {len(numbers.episodes)}: in episode"
            f" {first} '{name}' is {times:.1f} times as far from its command as it is later at most, for {steps} of its"
            f" steps. As differences these commands alone set the action bounds."
        )
        yield Finding("warning", "leaps", episodes_text(list(leaps)), text, "Cut them off: cqn-data trim --leap")
    if lag is not None and lag[0] / dataset.fps > LAG_S:
        text = f"The arm follows its command only after {lag[0]} steps ({lag[0] / dataset.fps:.2f} s)."
        yield Finding("warning", "lag", ACTION, text, "Look for a delay in the control loop or in the recording.")


def _duplicates(numbers: Numbers) -> Iterator[Finding]:
    groups: dict[str, list[int]] = {}
    for episode in numbers.episodes:
        groups.setdefault(episode.digest, []).append(episode.index)
    again = [g for g in groups.values() if len(g) > 1]
    if again and numbers.dimensions:
        listed = "; ".join(" = ".join(map(str, g)) for g in again[:NAMED])
        extra = [i for g in again for i in g[1:]]
        text = f"Episodes with the same states and actions: {listed}{more(again)}."
        yield Finding("warning", "duplicates", episodes_text(extra), text, advice_to_drop(extra))


def _tasks(numbers: Numbers) -> Iterator[Finding]:
    if len(numbers.tasks) > 1:
        listed = ", ".join(f"'{t}'" for t in list(numbers.tasks)[:3])
        listed += more(range(len(numbers.tasks)), 3)
        text = f"{len(numbers.tasks)} different tasks ({listed}); CQN is not told which."
        yield Finding("warning", "tasks", "task", text, "Train on one task at a time.")


def _size(numbers: Numbers, cameras: Sequence[CameraLook]) -> Iterator[Finding]:
    needed = memory(numbers, cameras)
    if needed.pictures > GIB:
        text = (
            f"The replay of these steps alone takes {needed.pictures / GIB:.1f} GiB with pictures as they are,"
            f" {needed.pictures_84 / GIB:.2f} GiB at {PAPER_SIZE} x {PAPER_SIZE}."
        )
        yield Finding("note", "memory", "cameras", text, "Make the pictures smaller: cqn-data resize.")
