"""Whether action sequences help: what T actions tell about the return that one does not, and how noisy actions are.

The observation that CQN-AS rests on (Seo and Abbeel 2024): where people demonstrate, the return is told better by the
next T actions than by one. Small regressions (`regression`) predict it from the state and T actions, each from the same
steps: those that T = 16 actions follow, so that the episode's end is not given away by how many are left.

Shapes: M steps of an episode, S state dimensions, A action dimensions.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.schema import ACTION

from .finding import Finding
from .regression import Courses, residuals

__all__ = ["LENGTHS", "Sequences", "noise_share", "sequence_finding", "sequences_of"]

LENGTHS = (1, 4, 8, 16)
DISCOUNT = 0.99  # of the policies' presets
NEEDED = 0.85  # what sequences must leave of one action's unexplained part to be worth their cost
FLOOR = 0.01  # share of the variance below which a difference is rounding
TOLD = 0.9  # unexplained by all: nothing is told by any, and nothing can be compared
SURE = 1.96  # standard errors over episodes
ROWS = 100  # steps to compare on, at least
MANY = 12  # different values from which on a dimension counts as moving

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sequences:
    """What actions tell about the return.

    Attributes:
        unexplained: share of its variance that is left on held-out episodes, by T.
        gain: by how much less T actions leave than one, at least, with a certainty of 97.5 % over episodes.
        noise: share of the variance of each moving action dimension that is noise from step to step, by name.
        steps: that were compared.
    """

    unexplained: Mapping[int, float]
    gain: Mapping[int, float]
    noise: Mapping[str, float]
    steps: int

    @property
    def advised(self) -> int:
        """T that the recording is best learned from, the shortest that plainly tells more than one; 1 is CQN."""
        one = self.unexplained[1] + FLOOR
        plain = (n for n in LENGTHS[1:] if self.gain[n] > 0 and self.unexplained[n] + FLOOR <= NEEDED * one)
        return next(plain, 1) if self.told else 1

    @property
    def told(self) -> bool:
        """Whether anything of the return is told at all, on episodes that were not seen."""
        return min(self.unexplained.values()) <= TOLD

    @property
    def noisy(self) -> float:
        """Mean of the dimensions' noise; 0 where none moves."""
        return float(np.mean(list(self.noise.values()))) if self.noise else 0.0

    def sentence(self) -> str:
        """The figures, and which policy they speak for, in a sentence."""
        shares = ", ".join(f"{self.unexplained[length]:.0%}" for length in LENGTHS)
        said = "This speaks for --policy.type=cqn."
        if self.advised > 1:
            said = f"This speaks for --policy.type=cqn_as --policy.action_sequence={self.advised}."
        elif not self.told:
            said = "Nobody can tell from so few episodes whether sequences help."
        return (
            f"Of the return's variance the state and the next {', '.join(map(str, LENGTHS))} actions leave {shares}"
            f" unexplained; {self.noisy:.0%} of the actions' variance is noise from step to step. {said}"
        )


def sequences_of(look: Courses) -> Sequences | None:
    """Compare sequences; None where there are too few steps, or every episode is as long and ends alike."""
    longest = max(LENGTHS)
    kept = [i for i, states in enumerate(look.states) if len(states) > longest]
    starts = {i: len(look.states[i]) - longest + 1 for i in kept}
    returns: list[Array] = []
    for i in kept:
        left = len(look.states[i]) - 1 - np.arange(starts[i])
        worth = np.asarray(DISCOUNT ** left[:, None], np.float64)
        returns.append(worth if look.episodes[i].success is not False else 0 * worth)
    if sum(starts.values()) < ROWS or not np.ptp(np.concatenate(returns)) > 0:
        return None
    squares = {}
    for length in LENGTHS:
        inputs = [
            np.concatenate([look.states[i][: starts[i]], following(look.actions[i], length, starts[i])], axis=1)
            for i in kept
        ]
        squares[length] = residuals(inputs, returns)[:, 0]
    ends = np.cumsum([starts[i] for i in kept])[:-1]
    gain = {}
    for length in LENGTHS[1:]:  # episodes are independent of one another, their steps are not
        each = (
            np.array([part.sum() for part in np.split(squares[1] - squares[length], ends)])
            * len(kept)
            / len(squares[1])
        )
        gain[length] = float(each.mean() - SURE * each.std(ddof=1) / np.sqrt(len(kept)))
    left_over = {length: float(values.mean()) for length, values in squares.items()}
    return Sequences(left_over, gain, noise_share(look.actions, look.names), sum(starts.values()))


def following(actions: Array, length: int, starts: int) -> Array:
    """(starts, length * A) the actions from each of the first steps on, from (M, A)."""
    return np.concatenate([actions[t : starts + t] for t in range(length)], axis=1)


def noise_share(actions: Sequence[Array], names: Sequence[str]) -> dict[str, float]:
    """Share of each moving dimension's variance that no smooth movement explains, 0 to 1.

    What a step differs from the mean of its two neighbours has 1.5 times the variance of independent noise; a movement
    that changes fast adds to it, so this is the most that the noise can be.
    """
    everything = np.concatenate(actions)
    bends = np.concatenate([a[1:-1] - (a[:-2] + a[2:]) / 2 for a in actions if len(a) > 2])
    shares = {}
    for dim, name in enumerate(names):
        if len(np.unique(everything[:, dim])) >= MANY:
            shares[name] = float(min(1.0, np.mean(bends[:, dim] ** 2) / 1.5 / everything[:, dim].var()))
    return shares


def sequence_finding(sequences: Sequences | None) -> Iterator[Finding]:
    """A note where sequences tell more."""
    if sequences is not None and sequences.advised > 1:
        advice = f"Try --policy.type=cqn_as --policy.action_sequence={sequences.advised}."
        yield Finding("note", "sequences", ACTION, sequences.sentence(), advice)
