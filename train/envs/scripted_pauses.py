"""Pauses of a person in scripted demonstrations: how often they begin, and how long they last."""

from collections.abc import Collection

import numpy as np

from lerobot_cqn.errors import ConfigError

__all__ = ["Pauses"]

_STEPS = (3, 15)  # shortest and longest pause, control steps
_MEAN = sum(_STEPS) / 2


class Pauses:
    """Draw of the steps of an episode that are pauses, about a given share of them.

    A task with natural moments to pause has them first, the start of the episode included; what is then lacking begins
    at random steps. A task without has pauses at random steps only, and at least one step between two.
    """

    def __init__(self, share: float, moments: int = 0, moves: float = 1.0) -> None:
        """Say how often; `reset` begins an episode.

        Args:
            share: expected share of still steps, [0, 0.9].
            moments: natural moments to pause in an episode, the start included; 0: the task has none.
            moves: steps of an episode without pauses, about; unused without moments.

        Raises:
            ConfigError: a share out of range.
        """
        if not 0.0 <= share <= 0.9:
            raise ConfigError(f"pause_share is {share}: expected 0 to 0.9.")
        still_per_move = share / (1.0 - share)
        self._natural = min(1.0, still_per_move)  # probability of a pause at each natural moment
        self._moments = moments
        expected = moments * self._natural * _MEAN / moves
        self._hazard = float(np.clip((still_per_move - expected) / _MEAN, 0.0, 1.0))

    def reset(self, rng: np.random.Generator) -> None:
        """Begin an episode, drawing from `rng` from now on."""
        self._rng = rng
        self._passed: set[object] = set()
        self._moved = True
        self._left = self._length() if self._moments and rng.random() < self._natural else 0

    def next(self, moments: Collection[object] = ()) -> bool:
        """Whether the next step is a pause; `moments` are the natural ones that the task has come to, in any form."""
        if self._left == 0:
            if not self._passed.issuperset(moments):
                self._passed.update(moments)
                self._left = self._length() if self._rng.random() < self._natural else 0
            # Without moments a step lies between two pauses, or the shares would not add up.
            elif (self._moments or self._moved) and self._rng.random() < self._hazard:
                self._left = self._length()
        pausing = self._left > 0
        self._left -= pausing
        self._moved = not pausing
        return pausing

    def _length(self) -> int:
        return int(self._rng.integers(_STEPS[0], _STEPS[1] + 1))
