"""Absolute and delta joint actions. Pure functions on arrays.

Shapes: T time steps of one episode, A action dimensions, J joints that are differences. a[t] is the commanded position
of step t, s[t] the measured one before it. Three kinds of difference are in use:

- ``command``: a[t] - s[t]. The reference implementation's on RLBench; executed as goal = measured + delta. Holds the
  lead of the command over the arm, hence the force of a contact. Each step stands for itself.
- ``command_steps``: a[t] - a[t-1], the first from s[0]. Executed as goal = last goal + delta; sums to the command.
- ``state``: s[t+1] - s[t], the paper's "joint difference"; the last step has no next state and takes a[t] - s[t].
  What was commanded cannot be had back from it, only where the arm went.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.delta_actions import DeltaJoints, Kind
from lerobot_cqn.schema import ACTION, STATE

__all__ = ["absolute_action", "delta_action", "float_dtype", "to_absolute", "to_delta"]

type Array = NDArray[np.float64]


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


def delta_action(columns: Mapping[str, Any], deltas: DeltaJoints) -> NDArray[Any]:
    """(T, A) an episode's absolute actions with the chosen dimensions as differences, as :func:`float_dtype` says."""
    return _convert(columns, deltas, to_delta)


def absolute_action(columns: Mapping[str, Any], deltas: DeltaJoints) -> NDArray[Any]:
    """(T, A) an episode's delta actions with all dimensions absolute, as :func:`float_dtype` says."""
    return _convert(columns, deltas, to_absolute)


def float_dtype(dtype: str) -> str:
    """The dtype in which differences of such numbers are kept: itself for floats, else one that holds them exactly."""
    if np.issubdtype(np.dtype(dtype), np.floating):
        return dtype
    return "float32" if np.dtype(dtype).itemsize <= 2 else "float64"


def _convert(columns: Mapping[str, Any], deltas: DeltaJoints, function: Any) -> NDArray[Any]:
    recorded = columns[ACTION]  # unsigned numbers would turn -7 into 65529
    action: NDArray[Any] = np.array(recorded, float_dtype(str(recorded.dtype)))
    joints, own = list(deltas.action_dims), list(deltas.state_dims)
    action[:, joints] = function(action[:, joints], columns[STATE][:, own], deltas.kind)
    return action
