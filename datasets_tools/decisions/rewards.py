"""Reward columns: where a demonstration ends by them, what must not be lost of them, and those of a label."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from lerobot.utils.constants import TRUNCATED
from numpy.typing import NDArray

from lerobot_cqn.schema import NEXT_DONE, NEXT_REWARD, NEXT_SUCCESS

__all__ = ["REWARD_FEATURES", "carries_reward", "demonstration_end", "last_step_rewards"]

REWARD_FEATURES: dict[str, dict[str, Any]] = {
    NEXT_REWARD: {"dtype": "float32", "shape": (1,), "names": None},
    NEXT_DONE: {"dtype": "bool", "shape": (1,), "names": None},
    NEXT_SUCCESS: {"dtype": "bool", "shape": (1,), "names": None},
}


def demonstration_end(columns: Mapping[str, Any], steps: int) -> tuple[int, bool]:
    """Last step of a demonstration of ``steps`` steps, and whether it succeeded; what comes after is no part of it.

    The first ``next.success``, where the recording has this column. Else the only step with a positive reward; where
    several have one (a dense reward), the first ``next.done``, or without such a column the first positive reward. An
    episode that did not succeed ends with its last step, one without any of these columns succeeds there.

    Args:
        columns: name -> (T,) or (T, 1); only those of rewards are read.
        steps: T, at least 1.
    """
    found = {k: np.flatnonzero(np.asarray(columns[k]).reshape(steps) > 0) for k in REWARD_FEATURES if k in columns}
    if NEXT_SUCCESS in found:
        ends = found[NEXT_SUCCESS]
    elif NEXT_REWARD in found:
        paid, done = found[NEXT_REWARD], found.get(NEXT_DONE, np.zeros(0, int))
        dense = len(paid) > 1 and len(done) > 0
        ends = done[:1] if dense and paid[0] <= done[0] else paid
    else:
        return steps - 1, True
    return (int(ends[0]), True) if len(ends) else (steps - 1, False)


def carries_reward(columns: Mapping[str, Any], steps: int) -> NDArray[np.bool_]:
    """(T,) steps that must not be lost: a reward other than 0, an end, or a change of success."""
    marked = np.zeros(steps, dtype=bool)
    for key in (NEXT_REWARD, NEXT_DONE, TRUNCATED):
        if key in columns:
            marked |= np.asarray(columns[key]).reshape(steps, -1).astype(bool).any(axis=1)
    if NEXT_SUCCESS in columns:
        success: NDArray[np.bool_] = np.asarray(columns[NEXT_SUCCESS], dtype=bool).reshape(steps)
        marked[1:] |= success[1:] != success[:-1]
    return marked


def last_step_rewards(steps: int, *, success: bool = True) -> dict[str, NDArray[Any]]:
    """Done on the last of ``steps`` steps, with reward 1 and success if it was one; 0 and False elsewhere; (T, 1)."""
    last = np.arange(steps)[:, None] == steps - 1
    won = last & success
    return {NEXT_REWARD: won.astype(np.float32), NEXT_DONE: last, NEXT_SUCCESS: won}
