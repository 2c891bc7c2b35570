"""One episode as the replay stores it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Episode", "spans"]


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode of T steps and T + 1 observations.

    low_dim: float32 [T + 1, P], normalised (None without state); pixels: per view uint8 [T + 1, 3, H, W];
    action: float32 [T, D] in [-1, 1]; reward: float32 [T].
    terminated: the last step really ended the task (success); otherwise time ran out and the last
    observation's value still counts. taught: the steps (first, one past the last) that a person drove; borders: steps
    before which a pause lay.
    """

    low_dim: NDArray[Any] | None
    pixels: tuple[NDArray[Any], ...]
    action: NDArray[Any]
    reward: NDArray[Any]
    terminated: bool
    success: bool
    taught: tuple[tuple[int, int], ...] = ()
    borders: tuple[int, ...] = ()

    def __len__(self) -> int:
        """Steps, T."""
        return len(self.action)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays to store, T + 1 rows each: a row of its own for the last observation keeps one index for all."""
        state = self.low_dim if self.low_dim is not None else np.zeros((len(self) + 1, 0), np.float32)
        rows = {"low_dim": state.astype(np.float32)}
        for name, values in (("action", self.action), ("reward", self.reward)):
            rows[name] = np.concatenate([values, np.zeros_like(values[:1])]).astype(np.float32)
        return rows | {f"view_{i}": view for i, view in enumerate(self.pixels)}


def spans(flags: list[bool]) -> tuple[tuple[int, int], ...]:
    """Runs of True as (first, one past the last)."""
    edges = np.flatnonzero(np.diff([0, *map(int, flags), 0])).tolist()
    return tuple(zip(edges[::2], edges[1::2], strict=True))
