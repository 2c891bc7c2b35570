"""Relation of actions and states: absolute targets or differences, and how far the arm lags behind.

Shapes: T time steps of one episode, J joints that have an action and a state, L lags. In a dataset, action a[t] leads
to state s[t+1]; a lag of 1 step is the shortest an arm can have.
"""

from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

from ..decisions.joints import Matched, match_joints
from ..decisions.leaps import Leaps
from ..disk.source import Source

__all__ = ["Correlation", "Follow", "FollowKind"]

Array = NDArray[np.float64]
FollowKind = Literal["absolute", "delta", "other"]

MAX_LAG_S, MAX_LAG = 1.0, 20
TRACKS = 0.9  # correlation of commands with positions that makes them positions
ANSWERS = 0.5  # correlation of commands with motion that makes them differences
SOME = 0.3  # below this no lag can be read off


class Correlation:
    """Pearson's correlation of J pairs of variables, from sums."""

    def __init__(self, joints: int) -> None:
        self._count = 0
        self._sums = np.zeros((5, joints))
        self._origin: tuple[Array, Array] | None = None

    def add(self, x: Array, y: Array) -> None:
        """Take in (T, J) values of both."""
        if not len(x):
            return
        if self._origin is None:
            self._origin = x[0].copy(), y[0].copy()  # near the mean, so that the sums do not cancel
        x, y = x - self._origin[0], y - self._origin[1]
        self._count += len(x)
        self._sums += np.stack([x.sum(0), y.sum(0), (x * x).sum(0), (y * y).sum(0), (x * y).sum(0)])

    def value(self) -> Array:
        """(J,) in [-1, 1]; NaN where one of the two is constant."""
        if not self._count:
            return np.full(self._sums.shape[1], np.nan)
        x, y, xx, yy, xy = self._sums / self._count
        own, other = xx - x * x, yy - y * y
        moves = (own > 1e-9 * xx) & (other > 1e-9 * yy)  # less is rounding
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(moves, (xy - x * y) / np.sqrt(own * other), np.nan)


class Follow:
    """Sums over all episodes.

    Attributes:
        action_dims, state_dims: (J,) matching dimensions of action and state, grippers left out.
        fps: steps a second.
        leaps: of the commands, should they be positions.
        remark: what was taken for granted in matching; "" where nothing was.
    """

    def __init__(self, matched: Matched, fps: float) -> None:
        self.action_dims, self.state_dims, self.fps = matched.action_dims, matched.state_dims, fps
        self.remark, self.leaps = matched.remark(), Leaps()
        joints = len(self.action_dims)
        self._lags = range(min(MAX_LAG, round(MAX_LAG_S * fps)) + 1)
        self._level = Correlation(joints)
        self._steps = [Correlation(joints) for _ in self._lags]  # of a change of command and of the state
        self._values = [Correlation(joints) for _ in self._lags]  # of a command itself and a change of the state
        self._gap, self._pace, self._count = np.zeros(joints), np.zeros(joints), 0

    @classmethod
    def of(cls, source: Source) -> Self | None:
        """For a dataset whose actions can be matched with its states by name or number; else None."""
        try:
            matched = match_joints(source.features)
        except DataError:
            return None
        return cls(matched, source.fps) if matched.action_dims else None

    def add(self, number: int, action: Array, state: Array) -> None:
        """Take in one episode: its number, (T, A) and (T, S)."""
        a, s = action[:, list(self.action_dims)], state[:, list(self.state_dims)]
        if len(a) < 3:
            return
        self.leaps.add(number, a, s)
        self._gap += np.abs(a - s).sum(axis=0)
        self._pace += np.abs(np.diff(s, axis=0)).sum(axis=0)
        self._count += len(a)
        self._level.add(a[:-1], s[1:])
        moved = np.diff(s, axis=0, prepend=s[:1])  # row t: s[t] - s[t-1]
        wanted = np.diff(a, axis=0, prepend=a[:1])
        for lag in self._lags:
            stop = len(a) - lag
            if stop < 2:
                break
            self._steps[lag].add(wanted[1:stop], moved[1 + lag :])
            first = max(0, 1 - lag)  # row 0 of `moved` is no motion
            self._values[lag].add(a[first:stop], moved[first + lag :])

    def gap(self) -> Array:
        """(J,) mean absolute difference of command and measurement at the same step."""
        return self._gap / max(1, self._count)

    def pace(self) -> Array:
        """(J,) mean absolute change of the state in a step."""
        return self._pace / max(1, self._count)

    def kind(self) -> FollowKind:
        """Likely kind of the actions: positions, differences, or something else (end-effector poses, rates)."""
        level = _middle(self._level.value())
        answer = max(_middle(c.value()) for c in self._values)
        if level >= TRACKS or (level >= 0.5 and level > answer):
            return "absolute"
        return "delta" if answer >= ANSWERS else "other"

    def lag(self) -> tuple[int, float] | None:
        """Steps after which the motion is most like the commanded one, and its correlation; None if it never is."""
        pairs = self._values if self.kind() == "delta" else self._steps
        likeness = [_middle(c.value()) for c in pairs]
        best = int(np.argmax(likeness))
        return (best, likeness[best]) if likeness[best] >= SOME else None


def _middle(values: Array) -> float:
    """Mean over the joints that move."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else 0.0
