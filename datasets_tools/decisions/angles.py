"""Angles that begin anew after a full turn: from pi to -pi, from 180 to -180, from 360 to 0. Pure functions on arrays.

Shapes: T time steps of one episode, J dimensions.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["full_turn", "turned"]

TURNS = (2 * np.pi, 360.0)  # radians and degrees
NEARLY = 0.75  # of a turn; an arm does not go as far within a step

type Array = NDArray[np.float64]


def full_turn(low: Array, high: Array) -> Array:
    """Size of a turn for dimensions that may be angles, by their range: (J,) 2 pi or 360; infinite for all others.

    Args:
        low: (J,) smallest value anywhere in the recording.
        high: (J,) largest one.
    """
    turns = np.full(np.shape(low), np.inf)
    width, farthest = high - low, np.maximum(np.abs(low), np.abs(high))
    for turn in TURNS:
        turns[(width > NEARLY * turn) & (width < 1.01 * turn) & (farthest < 1.01 * turn)] = turn
    return turns


def turned(changes: NDArray[np.floating], turns: Array) -> NDArray[np.bool_]:
    """(T, J) where a change, (T, J), is nearly a full turn, (J,), or more."""
    far: NDArray[np.bool_] = np.abs(changes) > NEARLY * turns
    return far
