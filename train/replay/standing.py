"""Standing still, as the states of an episode show it. Pure functions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["share_standing", "stands"]

# Of normalised state, of which demonstrations span 2: a hundredth of their range.
STILL = 0.02


def stands(before: NDArray[Any], after: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether nothing moved between two states [..., P] in normalised units: no value changed by `STILL`."""
    still: NDArray[np.bool_] = np.abs(after - before).max(axis=-1) < STILL
    return still


def share_standing(states: NDArray[Any] | None) -> float | None:
    """Share of the T steps between states [T + 1, P] in which nothing moved; None without state."""
    if states is None or not states.shape[-1]:
        return None
    return float(stands(states[:-1], states[1:]).mean())
