"""Absolute and delta joint actions. Pure functions on arrays.

Shapes: T time steps of one episode, J joints that are differences. a[t] is the commanded position of step t, s[t] the
measured one before it. Three kinds of difference are in use:

- ``command``: a[t] - s[t]. The reference implementation's on RLBench; executed as goal = measured + delta. Holds the
  lead of the command over the arm, hence the force of a contact. Each step stands for itself.
- ``command_steps``: a[t] - a[t-1], the first from s[0]. Executed as goal = last goal + delta; sums to the command.
- ``state``: s[t+1] - s[t], the paper's "joint difference"; the last step has no next state and takes a[t] - s[t].
  What was commanded cannot be had back from it, only where the arm went.
"""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..views.view import Episode

__all__ = ["KINDS", "Deltas", "Kind", "absolute_action", "delta_action", "select", "to_absolute", "to_delta"]

type Array = NDArray[np.float64]
Kind = Literal["command", "command_steps", "state"]
KINDS: tuple[str, ...] = get_args(Kind)
STATE, ACTION = "observation.state", "action"


@dataclass(frozen=True)
class Deltas:
    """Which action dimensions are differences: (J,) of the action, and the (J,) of the state they belong to."""

    kind: Kind
    action_dims: tuple[int, ...]
    state_dims: tuple[int, ...]


def to_delta(absolute: NDArray[Any], state: NDArray[Any], kind: Kind) -> Array:
    """Differences of commanded positions.

    Args:
        absolute: (T, J) commanded positions, T >= 1.
        state: (T, J) measured positions in the same unit.
        kind: see the module.

    Returns:
        (T, J) float64.
    """
    a, s = np.asarray(absolute, np.float64), np.asarray(state, np.float64)
    if kind == "command":
        return a - s
    if kind == "command_steps":
        return np.diff(a, axis=0, prepend=s[:1])
    return np.concatenate([s[1:], a[-1:]]) - s


def to_absolute(delta: NDArray[Any], state: NDArray[Any], kind: Kind) -> Array:
    """Commanded positions from differences; the inverse of :func:`to_delta` (for ``state``: where the arm went)."""
    d, s = np.asarray(delta, np.float64), np.asarray(state, np.float64)
    return s[:1] + np.cumsum(d, axis=0) if kind == "command_steps" else s + d


def delta_action(episode: Episode, deltas: Deltas) -> NDArray[Any]:
    """(T, A) the episode's absolute actions with the chosen dimensions as differences, in their dtype."""
    return _convert(episode, deltas, to_delta)


def absolute_action(episode: Episode, deltas: Deltas) -> NDArray[Any]:
    """(T, A) the episode's delta actions with all dimensions absolute, in their dtype."""
    return _convert(episode, deltas, to_absolute)


def select(
    episode: Episode, rows: NDArray[np.int64], deltas: Deltas | None, action_rows: NDArray[np.int64] | None = None
) -> Episode:
    """Some rows of an episode, with delta actions formed anew so that they connect the states that are left.

    Args:
        episode: the steps before.
        rows: (K,) ascending rows to keep.
        deltas: what the actions are; None for absolute ones, which do not depend on their neighbours.
        action_rows: (K,) where each step's command is taken from; by default its own row.
    """
    chosen = episode.at(rows)
    if ACTION not in episode.columns or (deltas is None and action_rows is None):
        return chosen
    commanded = episode.columns[ACTION] if deltas is None else absolute_action(episode, deltas)
    chosen = chosen.with_columns({ACTION: commanded[rows if action_rows is None else action_rows]})
    return chosen if deltas is None else chosen.with_columns({ACTION: delta_action(chosen, deltas)})


def _convert(episode: Episode, deltas: Deltas, function: Any) -> NDArray[Any]:
    action: NDArray[Any] = np.array(episode.columns[ACTION], copy=True)
    joints, own = list(deltas.action_dims), list(deltas.state_dims)
    action[:, joints] = function(action[:, joints], episode.columns[STATE][:, own], deltas.kind)
    return action
