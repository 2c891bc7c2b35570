"""Course of an episode: what its states, actions and values say about how it went. Pure functions."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Course", "Shown", "describe", "how_it_failed", "stands"]

# Of normalised state, of which demonstrations span 2: a hundredth of their range.
STILL = 0.02
AT_BOUND = 0.98  # of an action in [-1, 1]: within a hundredth of the range of its end
SWITCH = 0.9  # share of the demonstrated steps at a bound from which on a dimension is a switch, as a gripper is
MOST = 2000  # demonstrated states to measure distances to
STANDS, FAR, PUSHES = 0.5, 0.4, 0.5  # from which on a failure is said to stand, to be elsewhere, to push at a bound


@dataclass(frozen=True, kw_only=True)
class Course:
    """One episode of T steps: states [T or T + 1, P] normalised (None without), actions [T, D] in [-1, 1], values [T].

    values: mean Q of the actions that the policy chose.
    """

    states: NDArray[Any] | None
    actions: NDArray[Any]
    values: NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What demonstrations cover: states [M, P] in normalised units, and the dimensions [D] that are no switches."""

    states: NDArray[Any] = field(default_factory=lambda: np.zeros((0, 0)))
    moves: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, states: NDArray[Any], actions: NDArray[Any]) -> "Shown":
        """That of demonstrated states [M, P], thinned out evenly to `MOST`, and actions [M, D]; M may be 0."""
        thin = np.linspace(0, len(states) - 1, min(MOST, len(states))).astype(int)
        at_end = (np.abs(actions) >= AT_BOUND).mean(axis=0) if len(actions) else None
        return cls(states=states[thin], moves=None if at_end is None else at_end < SWITCH)


def stands(before: NDArray[Any], after: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether nothing moved between two states [..., P] in normalised units: no value changed by `STILL`."""
    still: NDArray[np.bool_] = np.abs(after - before).max(axis=-1) < STILL
    return still


def describe(course: Course, shown: Shown) -> dict[str, float | None]:
    """Columns of an episode (docs/metrics.md): standing, at_bounds, distance, q_begin, q_middle, q_end.

    None where there is nothing to say it by: no state, no demonstrations, only switches.
    """
    states = course.states if course.states is not None and course.states.shape[-1] else None
    moves = course.actions if shown.moves is None else course.actions[:, shown.moves]
    thirds = [part for part in np.array_split(course.values, 3) if len(part)] if len(course.values) >= 3 else []
    begin, middle, end = [float(part.mean()) for part in thirds] or (None, None, None)
    return {
        "standing": None if states is None or len(states) < 2 else float(stands(states[:-1], states[1:]).mean()),
        "at_bounds": float((np.abs(moves) >= AT_BOUND).mean()) if moves.size else None,
        "distance": None if states is None or not len(shown.states) else float(_distances(states, shown.states).mean()),
        "q_begin": begin, "q_middle": middle, "q_end": end,
    }  # fmt: skip


def how_it_failed(said: dict[str, float | None], *, cut_off: bool) -> str:
    """Kind of a failure by its columns, the first that applies: a reader sorts films and rows by it."""
    if (said["standing"] or 0.0) >= STANDS:
        return "stood still"
    if (said["distance"] or 0.0) >= FAR:
        return "went elsewhere"
    if (said["at_bounds"] or 0.0) >= PUSHES:
        return "pushed at bounds"
    return "ran out of time" if cut_off else "ended early"


def _distances(states: NDArray[Any], shown: NDArray[Any]) -> NDArray[Any]:
    """Distance [T] of each state [T, P] to the nearest of the demonstrations [M, P], root mean square over P."""
    squares = (states**2).sum(1)[:, None] - 2.0 * states @ shown.T + (shown**2).sum(1)[None]
    nearest: NDArray[Any] = np.sqrt(squares.min(axis=1).clip(min=0.0) / states.shape[-1])
    return nearest
