"""Which history a recording needs: what earlier states tell about the action that the present one does not.

Small regressions (`regression`) predict the action from F states, `stride` steps apart.

Shapes: T steps of an episode, F frames, S state dimensions, X numbers of a history, A action dimensions.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.schema import ACTION

from .finding import Finding
from .regression import Courses, unexplained

__all__ = ["FRAMES", "STRIDES", "History", "history_finding", "history_of", "stacked"]

FRAMES, STRIDES = (1, 2, 4, 8), (1, 2, 4)
FLOOR = 0.01  # share of an action's variance below which a difference is rounding
NEEDED = 0.9  # what a history must leave of the one frame's unexplained part to be worth its parameters
LEVEL = 1.03  # a shorter history this near to the best one is taken

Array = NDArray[np.float64]


@dataclass(frozen=True)
class History:
    """What histories leave unexplained.

    Attributes:
        shares: share of each action dimension's variance that is left on held-out episodes, (A,) by (frames, stride);
            0 is all explained, 1 none, more than 1 worse than the mean.
        names: of the A action dimensions, those that never change left out.
        columns: what was looked at.
    """

    shares: Mapping[tuple[int, int], Array]
    names: Sequence[str]
    columns: Sequence[str]

    def mean(self, frames: int, stride: int = 1) -> float:
        """Share left unexplained, mean of the dimensions."""
        return float(self.shares[frames, stride].mean())

    def ratio(self, frames: int, stride: int = 1) -> float:
        """What is left, over what one frame leaves: geometric mean of the dimensions, so that each counts alike."""
        own, one = (np.log(self.shares[key] + FLOOR) for key in ((frames, stride), (1, 1)))
        return float(np.exp((own - one).mean()))

    def advised(self) -> int:
        """Frames in a row that the recording is best learned from; 1 where a history tells little."""
        best = min(self.ratio(f) for f in FRAMES)
        return next(f for f in FRAMES if self.ratio(f) <= LEVEL * best) if best <= NEEDED else 1

    def most_helped(self, frames: int) -> int:
        """Index of the action dimension that the history tells most about."""
        return int(np.argmin((self.shares[frames, 1] + FLOOR) / (self.shares[1, 1] + FLOOR)))

    def sentence(self) -> str:
        """The figures in a sentence."""
        shares = ", ".join(f"{self.mean(f):.0%}" for f in FRAMES)
        return f"Of the actions' variance {', '.join(map(str, FRAMES))} frames of the state leave {shares} unexplained."


def history_of(look: Courses) -> History:
    """Compare histories."""
    shares = {
        (frames, stride): unexplained([stacked(s, frames, stride) for s in look.states], look.actions)
        for frames in FRAMES
        for stride in (STRIDES if frames > 1 else (1,))
    }
    return History(shares, look.names, look.columns)


def stacked(states: Array, frames: int, stride: int) -> Array:
    """(T, X) the state of a step and those before it, from (T, S); before the first one the first, as in the policy."""
    steps = np.arange(len(states))
    return np.concatenate([states[np.maximum(steps - k * stride, 0)] for k in range(frames)], axis=1)


def history_finding(history: History | None) -> Iterator[Finding]:
    """A note where earlier states tell of the actions what the present one does not."""
    if history is None or history.advised() == 1:
        return
    frames = history.advised()
    most = history.most_helped(frames)
    one, several = (float(history.shares[f, 1][most]) for f in (1, frames))
    text = (
        f"{history.sentence()} Most for '{history.names[most]}': {one:.0%} from one frame, {several:.0%} from {frames}:"
        " states that are alike are followed by different actions."
    )
    advice = f"Try --policy.frame_stack={frames}; it costs where demonstrations are few."
    yield Finding("note", "history", ACTION, text, advice)
