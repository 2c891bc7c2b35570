"""Which history a recording needs: what earlier states tell about the action that the present one does not.

Small regressions predict the action from F states, `stride` steps apart, on episodes that they were not fitted to:
ridge regression on the states and on random Fourier features of them (Rahimi and Recht 2007), in both the same for
every history, so that only what the history tells makes a difference.

Shapes: N steps of all episodes, F frames, S state dimensions, X numbers of a history, A action dimensions, H features.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE
from numpy.typing import NDArray

from lerobot_cqn.schema import ACTION, STATE

from ..disk.source import Source
from .finding import Finding
from .numbers import Numbers

__all__ = ["FRAMES", "STRIDES", "History", "history_finding", "measure_history", "unexplained"]

FRAMES, STRIDES = (1, 2, 4, 8), (1, 2, 4)
FOLDS = 5  # as many episodes at least
MOST_STEPS = 6000  # of whole episodes; a few seconds for all histories together
FEATURES = 384
WIDTHS = (0.5, 1.0)  # of the features, in median distances of two histories
PENALTIES = (0.01, 0.1, 1.0, 10.0)
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


def measure_history(source: Source, numbers: Numbers) -> History | None:
    """Compare histories on the episodes that can be read; None with fewer than five, or where nothing varies."""
    columns = [c for c in (STATE, OBS_ENV_STATE) if c in source.features]
    if STATE not in columns or ACTION not in source.features or len(numbers.episodes) < FOLDS:
        return None
    each = max(1, -(-numbers.steps // MOST_STEPS))
    chosen = numbers.episodes[::each] if len(numbers.episodes) >= each * FOLDS else numbers.episodes[:FOLDS]
    states, actions = [], []
    for summary in chosen:
        episode = source.episode(summary.index)
        end = (summary.steps if summary.end is None else summary.end + 1, -1)
        rows = [np.asarray(episode.columns[c], np.float64)[: end[0]].reshape(end) for c in columns]
        states.append(np.concatenate(rows, axis=1))
        actions.append(np.asarray(episode.columns[ACTION], np.float64)[: end[0]].reshape(end))
    varies = np.ptp(np.concatenate(actions), axis=0) > 0
    if not varies.any() or not np.isfinite(np.concatenate(states)).all():
        return None
    shares = {
        (frames, stride): unexplained([stacked(s, frames, stride) for s in states], [a[:, varies] for a in actions])
        for frames in FRAMES
        for stride in (STRIDES if frames > 1 else (1,))
    }
    names = [d.name for d, chosen in zip(numbers.of(ACTION), varies, strict=True) if chosen]
    return History(shares, names, columns)


def stacked(states: Array, frames: int, stride: int) -> Array:
    """(T, X) the state of a step and those before it, from (T, S); before the first one the first, as in the policy."""
    steps = np.arange(len(states))
    return np.concatenate([states[np.maximum(steps - k * stride, 0)] for k in range(frames)], axis=1)


def unexplained(inputs: Sequence[Array], targets: Sequence[Array]) -> Array:
    """(A,) share of the variance that the best of the regressions leaves on episodes it was not fitted to.

    Args:
        inputs: (T, X) of each episode.
        targets: (T, A) of each episode, each dimension varying.
    """
    fold = np.concatenate([np.full(len(x), i % FOLDS) for i, x in enumerate(inputs)])
    x, y = _scaled(np.concatenate(inputs)), _scaled(np.concatenate(targets))
    random = np.random.default_rng(0)  # the same features in every run
    pairs = random.integers(len(x), size=(2, 1000))
    distance = float(np.median(np.linalg.norm(x[pairs[0]] - x[pairs[1]], axis=1))) or 1.0
    directions, phases = random.normal(size=(x.shape[1], FEATURES)), random.uniform(0, 2 * np.pi, FEATURES)
    errors: list[Array] = []
    for width in WIDTHS:
        waves = np.cos(x @ directions / (width * distance) + phases)
        errors += _left_out(np.concatenate([waves, x, np.ones((len(x), 1))], axis=1), y, fold)
    return min(errors, key=lambda error: float(error.mean()))


def _left_out(features: Array, y: Array, fold: NDArray[np.int64]) -> Iterator[Array]:
    """(A,) mean squared error on the fold left out, for each penalty."""
    parts = [(features[fold == f], y[fold == f]) for f in range(FOLDS)]
    grams, products = [p.T @ p for p, _ in parts], [p.T @ t for p, t in parts]
    for penalty in PENALTIES:
        squares = np.zeros(y.shape[1])
        for held, (part, target) in enumerate(parts):
            gram = sum(g for f, g in enumerate(grams) if f != held) + penalty * np.eye(features.shape[1])
            product = sum(p for f, p in enumerate(products) if f != held)
            squares += ((part @ np.linalg.solve(gram, product) - target) ** 2).sum(axis=0)
        yield squares / len(y)


def _scaled(values: Array) -> Array:
    """Mean 0 and variance 1; what never changes is 0."""
    spread = values.std(axis=0)
    scaled: Array = (values - values.mean(axis=0)) / np.where(spread > 1e-9, spread, np.inf)
    return scaled


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
