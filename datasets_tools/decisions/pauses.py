"""Pauses among the time steps of a demonstration. Pure functions on arrays, no files.

Shapes: T time steps of one episode, S state dimensions, A action dimensions. Units are those of the dataset.

Why the rule looks at where a step *leads*. Step t holds the state s[t] and the action a[t] that brings the arm
to s[t+1]. In a pause s[t] stays the same while a[t] keeps it there; the last of those steps has the same state
too, but its action is the one that moves on. Looking for the first step with another state than the last kept one
would keep the first still step (action: stay) and drop that last one (action: go on), which teaches a policy to stay
for ever. So the episode is read from its end: a step is kept when its state differs from that of the *next* kept
step, that is, when it leads somewhere. For two kept neighbours k < k' every step between them is within the
threshold of s[k'], and so is what a[k] led to: the kept action explains the motion to the next kept step. Slow
motion adds up. Since only kept steps are compared, doing it again drops nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

__all__ = [
    "DRIVES",
    "Compare",
    "EpisodeReport",
    "Rule",
    "drives",
    "gripper_events",
    "keep_mask",
    "pause_runs",
    "report_episode",
]

type Mask = NDArray[np.bool_]
type Compare = Literal["after", "before"]

NEAR_GRIPPER = 3
DRIVES = 0.05  # of the largest value of a velocity; what is slower is noise of a reading at rest


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
        compare: "after" compares with the next kept step, "before" with the last one.
        rates_state, rates_action: dimensions that are velocities: a step at which one is above its limit is no pause.
        limits_state, limits_action: of those, in their units; >= 0.
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
    rates_state: tuple[int, ...] = ()
    limits_state: tuple[float, ...] = ()
    rates_action: tuple[int, ...] = ()
    limits_action: tuple[float, ...] = ()


@dataclass(frozen=True)
class EpisodeReport:
    """Outcome for one episode.

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

    A step is a pause when no joint differs by its threshold or more from the next kept step (compare="before": from the
    last kept one), and no velocity is above its limit. Steps at which the gripper changes, state or command, are kept;
    so are ``always``, the first and the last steps asked for. The steps that are kept, taken for an episode of their
    own, would all be kept again.

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
    wanted = drives(state, rule.rates_state, rule.limits_state) | drives(action, rule.rates_action, rule.limits_action)
    wanted = wanted if always is None else wanted | always
    rows: NDArray[np.int64] = np.arange(steps)
    while True:  # what goes may bring two gripper positions together that a step between them had kept apart
        mask = _keep_once(state[rows], action[rows], rule, wanted[rows])
        rows = rows[mask]
        if mask.all():
            break
    keep = np.zeros(steps, dtype=bool)
    keep[rows] = True
    return keep


def _keep_once(state: NDArray[Any], action: NDArray[Any], rule: Rule, always: Mask) -> Mask:
    steps = len(state)
    forced = always | gripper_events(state, action, rule)
    forced[: rule.keep_first] = True
    forced[max(0, steps - max(1, rule.keep_last)) :] = True
    keep = _moves(state, rule, forced)
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
    events = gripper_events(state, action, rule)
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


def drives(values: NDArray[Any], rates: Sequence[int], limits: Sequence[float]) -> Mask:
    """(T,) steps of (T, D) ``values`` at which a velocity is above its limit: motion, though its value stays."""
    above = np.abs(np.asarray(values, np.float64)[:, list(rates)]) > np.asarray(limits)
    return np.asarray(above.any(axis=1), bool)


def gripper_events(state: NDArray[Any], action: NDArray[Any], rule: Rule) -> Mask:
    """(T,) steps whose command, or the state that they lead to, has the gripper elsewhere than the last such step."""
    states, actions = np.asarray(state, dtype=np.float64), np.asarray(action, dtype=np.float64)
    seen = np.concatenate([states[1:], states[-1:]]) if rule.compare == "after" else states
    grippers = np.concatenate([seen[:, list(rule.gripper_state)], actions[:, list(rule.gripper_action)]], axis=1)
    last = np.concatenate([states[0, list(rule.gripper_state)], actions[0, list(rule.gripper_action)]])
    events = np.zeros(len(states), dtype=bool)
    for t in range(len(states)):
        if (np.abs(grippers[t] - last) > rule.gripper_threshold).any():
            events[t], last = True, grippers[t]
    return events


def _moves(state: NDArray[Any], rule: Rule, forced: Mask) -> Mask:
    """(T,) steps that are forced, or at which a joint differs from the kept step next to them."""
    joints = np.asarray(state, dtype=np.float64)[:, list(rule.joints)]
    limits = np.asarray(rule.thresholds, dtype=np.float64)
    order = range(len(joints) - 1, -1, -1) if rule.compare == "after" else range(len(joints))
    keep = forced.copy()
    last: NDArray[np.float64] | None = None
    for t in order:
        keep[t] = keep[t] or last is None or bool((np.abs(joints[t] - last) >= limits).any())
        if keep[t]:
            last = joints[t]
    return keep
