"""Small regressions on a recording: how much of one thing another tells, on episodes that they were not fitted to.

Ridge regression on the numbers and on random Fourier features of them (Rahimi and Recht 2007), in both the same
whatever the inputs, so that only what these tell makes a difference.

Shapes: T steps of an episode, S state dimensions, X inputs, A targets.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE
from numpy.typing import NDArray

from lerobot_cqn.schema import ACTION, STATE

from ..disk.source import Source
from .numbers import EpisodeNumbers, Numbers

__all__ = ["Courses", "courses", "residuals", "unexplained"]

FOLDS = 5  # as many episodes at least
MOST_STEPS = 6000  # of whole episodes; a few seconds for all regressions of a kind together
FEATURES = 384
WIDTHS = (0.5, 1.0)  # of the features, in median distances of two inputs
PENALTIES = (0.01, 0.1, 1.0, 10.0, 100.0, 1000.0)

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Courses:
    """States and actions of whole episodes, up to where each ends as a demonstration.

    Attributes:
        episodes: which.
        states: (T, S) of each.
        actions: (T, A) of each, dimensions that never change left out.
        names: of the A action dimensions.
        columns: what the states are of.
    """

    episodes: Sequence[EpisodeNumbers]
    states: Sequence[Array]
    actions: Sequence[Array]
    names: Sequence[str]
    columns: Sequence[str]


def courses(source: Source, numbers: Numbers) -> Courses | None:
    """Courses of the episodes that can be read; None with fewer than five, or where nothing varies."""
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
    names = [d.name for d, varied in zip(numbers.of(ACTION), varies, strict=True) if varied]
    return Courses(
        episodes=chosen, states=states, actions=[a[:, varies] for a in actions], names=names, columns=columns
    )


def unexplained(inputs: Sequence[Array], targets: Sequence[Array]) -> Array:
    """(A,) share of the variance that the best of the regressions leaves on episodes it was not fitted to.

    Args:
        inputs: (T, X) of each episode.
        targets: (T, A) of each episode, each dimension varying.
    """
    share: Array = residuals(inputs, targets).mean(axis=0)
    return share


def residuals(inputs: Sequence[Array], targets: Sequence[Array]) -> Array:
    """The same step by step: squares (N, A) of what is left of targets of variance 1, all episodes in a row."""
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
    return min(errors, key=lambda squares: float(squares.mean()))


def _left_out(features: Array, y: Array, fold: NDArray[np.int64]) -> Iterator[Array]:
    """(N, A) squared errors, each on the fold left out, for each penalty."""
    parts = [(features[fold == f], y[fold == f]) for f in range(FOLDS)]
    grams, products = [p.T @ p for p, _ in parts], [p.T @ t for p, t in parts]
    others = [
        tuple(sum(s for f, s in enumerate(sums) if f != held) for sums in (grams, products)) for held in range(FOLDS)
    ]
    for penalty in PENALTIES:
        squares = np.zeros_like(y)
        for held, ((part, target), (gram, product)) in enumerate(zip(parts, others, strict=True)):
            weights = np.linalg.solve(gram + penalty * np.eye(features.shape[1]), product)
            squares[fold == held] = (part @ weights - target) ** 2
        yield squares


def _scaled(values: Array) -> Array:
    """Mean 0 and variance 1; what never changes is 0."""
    spread = values.std(axis=0)
    scaled: Array = (values - values.mean(axis=0)) / np.where(spread > 1e-9, spread, np.inf)
    return scaled
