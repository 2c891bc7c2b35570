"""Leaps at the start of episodes: the arm stood elsewhere than the leader, and goes there as fast as it can.

Shapes: T time steps of one episode, J joints.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["Leaps"]

type Array = NDArray[np.float64]

START_SHARE = 0.25  # of an episode, in which it may still come to the leader
LEAP = 2.0  # times the largest distance that is usual later: one command far off, where driving is many small ones
LEAST_SHARE = 0.1  # of the range that is commanded: what is nearer is no leap, however still the joint is later


class Leaps:
    """Distances of commands from the arm, of all episodes of a recording."""

    def __init__(self) -> None:
        self._heads: dict[int, Array] = {}
        self._later: dict[int, Array] = {}
        self._ends: list[Array] = []

    def add(self, number: int, action: Array, state: Array) -> None:
        """Take in an episode: its number, and absolute commands and measured positions of the same joints, (T, J)."""
        if not len(action):
            return
        gap, start = np.abs(action - state), int(START_SHARE * len(action))
        self._heads[number] = gap[: max(1, start)].copy()
        self._later[number] = gap[start:].max(axis=0)
        self._ends += [action.min(axis=0), action.max(axis=0)]

    def limits(self) -> Array:
        """(J,) distances beyond which a command is a leap: the median of the episodes counts, so odd ones do not."""
        usual = np.median(list(self._later.values()), axis=0)
        limits: Array = np.maximum(LEAP * usual, LEAST_SHARE * np.ptp(self._ends, axis=0))
        return limits

    def found(self) -> dict[int, tuple[int, int, float]]:
        """Episodes that begin with leaps, by number.

        Steps from the first on, without a break, with a leap in some joint, farther than it ever is later; the joint of
        these (0 to J - 1) that has the farthest to go, and how far, as a multiple of the largest distance that is usual
        later.
        """
        if not self._heads:
            return {}
        limits, leaps = self.limits(), {}
        for number, head in self._heads.items():
            far = np.any(head > np.maximum(limits, self._later[number]), axis=1)
            steps = len(far) if far.all() else int(np.argmin(far))
            if steps:
                times = head[:steps].max(axis=0) / np.maximum(limits, 1e-12)
                leaps[number] = steps, int(times.argmax()), float(LEAP * times.max())
        return leaps
