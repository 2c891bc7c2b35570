"""Reward columns of an operation's output: kept from the source, or written from where episodes end."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from lerobot.utils.constants import TRUNCATED
from numpy.typing import NDArray

from lerobot_cqn.schema import NEXT_DONE, NEXT_REWARD, NEXT_SUCCESS

__all__ = ["REWARD_FEATURES", "carries_reward", "last_step_rewards"]

REWARD_FEATURES: dict[str, dict[str, Any]] = {
    NEXT_REWARD: {"dtype": "float32", "shape": (1,), "names": None},
    NEXT_DONE: {"dtype": "bool", "shape": (1,), "names": None},
    NEXT_SUCCESS: {"dtype": "bool", "shape": (1,), "names": None},
}


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
