"""Which time steps of a demonstration are pauses. Pure functions on arrays, no files.

Shapes: T time steps of one episode, S state dimensions, A action dimensions. Units are those of the dataset.

Why the rule looks at where a step *leads*. Step t holds the state s[t] and the action a[t] that brings the arm
to s[t+1]. In a pause s[t] stays the same while a[t] keeps it there; the last of those steps has the same state
too, but its action is the one that moves on. Comparing the states a step *starts* from would keep the first
still step (action: stay) and drop that last one (action: go on), which teaches a policy to stay for ever.
Comparing the states it leads to drops the "stay" steps only. For two kept neighbours k < k' every step between
them led to within the threshold of s[k+1], hence s[k'] = s[k+1] up to the threshold: the kept action a[k] still
explains the motion to the next kept step. So delta actions (increments, zero in a pause) stay valid without being
summed, and so do absolute ones (targets), which never depended on the spacing of steps.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

__all__ = ["Compare", "EpisodeReport", "Rule", "keep_mask", "pause_runs", "report_episode"]

type Mask = NDArray[np.bool_]
type Compare = Literal["after", "before"]

NEAR_GRIPPER = 3


@dataclass(frozen=True)
class Rule:
    """Settings of :func:`keep_mask`.

    Attributes:
        joints: (J,) state dimensions that are joints, gripper excluded.
        thresholds: (J,) a joint that moved by less is still; > 0, in the unit of that joint.
        gripper_state: state dimensions of the gripper.
        gripper_action: action dimensions of the gripper.
        gripper_threshold: a gripper that changed by more is an event; >= 0.
        keep_first: steps at the start that are always kept; >= 0.
        keep_last: steps at the end that are always kept; >= 1, for the last one carries the reward.
        min_pause: shorter pauses are left in; >= 1 step.
        compare: "after" compares the states that steps lead to, "before" those that they start from.
    """

    joints: tuple[int, ...]
    thresholds: tuple[float, ...]
    gripper_state: tuple[int, ...] = ()
    gripper_action: tuple[int, ...] = ()
    gripper_threshold: float = 0.005
    keep_first: int = 0
    keep_last: int = 1
    min_pause: int = 1
    compare: Compare = "after"


@dataclass(frozen=True)
class EpisodeReport:
    """What happened to one episode.

    Attributes:
        runs: (first step, length) of the dropped pauses.
        gripper_events: steps at which the gripper changed.
        dropped_near_gripper: dropped steps at most 3 steps from one.
        dropped_while_commanded: dropped steps whose command moved by a threshold while the arm did not.
    """

    episode: int
    steps: int
    kept: int
    runs: tuple[tuple[int, int], ...]
    gripper_events: int
    dropped_near_gripper: int
    dropped_while_commanded: int = 0

    @property
    def dropped(self) -> int:
        """Steps that are left out."""
        return self.steps - self.kept

    @property
    def share(self) -> float:
        """Dropped share in [0, 1]."""
        return self.dropped / self.steps

    def as_json(self) -> dict[str, Any]:
        """Plain types for a report file."""
        return {
            "episode": self.episode,
            "steps": self.steps,
            "kept": self.kept,
            "dropped": self.dropped,
            "share": round(self.share, 4),
            "pauses": [{"start": start, "length": length} for start, length in self.runs],
            "gripper_events": self.gripper_events,
            "dropped_near_gripper": self.dropped_near_gripper,
            "dropped_while_commanded": self.dropped_while_commanded,
        }


def keep_mask(state: NDArray[Any], action: NDArray[Any], rule: Rule, always: Mask | None = None) -> Mask:
    """Mark the steps to keep.

    A step is a pause when no joint differs by its threshold or more from the last kept step. Since the comparison
    is with the last *kept* step, slow motion adds up and is kept as soon as it passes the threshold. Steps at which
    the gripper changes, state or command, are kept; so are ``always``, the first and the last steps asked for.

    Args:
        state: (T, S) measured state.
        action: (T, A) commanded action.
        rule: thresholds and what to keep.
        always: (T,) steps that must stay, e.g. those that carry a reward.

    Returns:
        (T,) bool, True where kept; the last step is always True.

    Raises:
        DataError: no steps, or another number of actions than states.
    """
    steps = len(state)
    if steps == 0 or len(action) != steps:
        raise DataError(f"Expected as many actions as states and at least one; got {len(action)} and {steps}.")
    forced = np.zeros(steps, dtype=bool) if always is None else always.copy()
    forced[: rule.keep_first] = True
    forced[max(0, steps - max(1, rule.keep_last)) :] = True
    keep = forced | _moves(state, action, rule, forced)[0]
    for start, length in pause_runs(keep):
        if length < rule.min_pause:
            keep[start : start + length] = True
    return keep


def pause_runs(keep: Mask) -> tuple[tuple[int, int], ...]:
    """Maximal runs of dropped steps as (first step, length), in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], keep, [True]]).astype(np.int8)))
    return tuple((int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True))


def report_episode(
    episode: int,
    state: NDArray[Any],
    action: NDArray[Any],
    keep: Mask,
    rule: Rule,
    commanded: NDArray[Any] | None = None,
) -> EpisodeReport:
    """Describe a mask.

    Args:
        episode: number of the episode.
        state: (T, S) as for :func:`keep_mask`.
        action: (T, A) as for :func:`keep_mask`.
        keep: (T,) from :func:`keep_mask`.
        rule: the rule it came from.
        commanded: (T, J) commanded joint positions, where the data has them.
    """
    events = _moves(state, action, rule, keep)[1]
    near = np.zeros_like(keep)
    for step in np.flatnonzero(events):
        near[max(0, step - NEAR_GRIPPER) : step + NEAR_GRIPPER + 1] = True
    return EpisodeReport(
        episode=episode,
        steps=len(keep),
        kept=int(keep.sum()),
        runs=pause_runs(keep),
        gripper_events=int(events.sum()),
        dropped_near_gripper=int((near & ~keep).sum()),
        dropped_while_commanded=0 if commanded is None else _pushing(commanded, keep, rule),
    )


def _pushing(commanded: NDArray[Any], keep: Mask, rule: Rule) -> int:
    """Dropped steps at which a joint's command moved by the smallest threshold or more."""
    changes = np.abs(np.diff(np.asarray(commanded, np.float64), axis=0, prepend=commanded[:1])).max(axis=1, initial=0)
    return int((~keep & (changes >= min(rule.thresholds, default=np.inf))).sum())


def _moves(state: NDArray[Any], action: NDArray[Any], rule: Rule, forced: Mask) -> tuple[Mask, Mask]:
    """(T,) steps at which joints or gripper changed since the last kept step, and those of the gripper alone."""
    states, actions = np.asarray(state, dtype=np.float64), np.asarray(action, dtype=np.float64)
    after = rule.compare == "after"
    seen = np.concatenate([states[1:], states[-1:]]) if after else states
    joints = seen[:, list(rule.joints)]
    grippers = np.concatenate([seen[:, list(rule.gripper_state)], actions[:, list(rule.gripper_action)]], axis=1)
    limits = np.asarray(rule.thresholds, dtype=np.float64)
    last_joints = states[0, list(rule.joints)]
    last_gripper = np.concatenate([states[0, list(rule.gripper_state)], actions[0, list(rule.gripper_action)]])
    moved, events = np.zeros(len(states), dtype=bool), np.zeros(len(states), dtype=bool)
    for t in range(len(states)):
        events[t] = bool((np.abs(grippers[t] - last_gripper) > rule.gripper_threshold).any())
        first = t == 0 and not after
        moved[t] = first or bool(events[t] or (np.abs(joints[t] - last_joints) >= limits).any())
        if moved[t] or forced[t]:
            last_joints, last_gripper = joints[t], grippers[t]
    return moved, events
