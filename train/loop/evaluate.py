"""Success rate of the deterministic policy over fresh episodes, with its 95 % interval."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..agent import Agent
from ..interfaces import Scenes

__all__ = ["EVAL_SEED", "Evaluation", "evaluate", "wilson_interval"]

# Far from the seeds of training episodes (seed * 100,000 + episode), and the same for every run: variants are compared
# on equal episodes.
EVAL_SEED = 2_147_000_000


@dataclass(frozen=True)
class Evaluation:
    """Result of evaluation episodes.

    outcomes: success; steps: lengths; returns: sums of rewards; frames: pictures of the first episodes.
    """

    outcomes: list[bool]
    steps: list[int]
    returns: list[float]
    frames: list[list[NDArray[Any]]] = field(default_factory=list)

    @property
    def n(self) -> int:
        """Episodes."""
        return len(self.outcomes)

    @property
    def successes(self) -> int:
        """Successful episodes."""
        return sum(self.outcomes)

    @property
    def success_rate(self) -> float:
        """Share of successful episodes."""
        return self.successes / self.n

    @property
    def mean_return(self) -> float:
        """Mean sum of rewards of an episode."""
        return float(np.mean(self.returns))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval of the success rate."""
        return wilson_interval(self.successes, self.n)

    def __str__(self) -> str:
        """For a person: success rate, n and interval; the return where rewards are more than successes."""
        low, high = self.interval
        success = f"success {self.success_rate:.2f} (n={self.n}, 95 % {low:.2f}-{high:.2f})"
        if abs(self.mean_return - self.success_rate) < 1e-6:
            return success
        returned = f"return {self.mean_return:.3g} (n={self.n})"
        return f"{returned}  {success}" if self.successes else returned


def wilson_interval(successes: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a proportion; honest at 0 and 1 and for small n."""
    p = successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(0.0, centre - half), min(1.0, centre + half)


def evaluate(
    agent: Agent,
    scenes: Scenes,
    episodes: int,
    *,
    seed: int = EVAL_SEED,
    on_step: Callable[[], None] = lambda: None,
    film: int = 0,
) -> Evaluation:
    """Run `episodes` episodes without noise, as lerobot-eval does, as many at a time as there are scenes.

    on_step: called before each control step; what it raises ends the evaluation. film: episodes to take pictures of.
    Episode i has seed + i, however many run at a time.
    """
    outcomes: list[bool] = []
    steps: list[int] = []
    returns: list[float] = []
    films: list[list[NDArray[Any]]] = []
    for first in range(0, episodes, scenes.count):
        numbers = range(first, min(first + scenes.count, episodes))
        success, length, total, pictures = _wave(agent, scenes, seed + first, max(0, film - first), on_step)
        outcomes += success.tolist()[: len(numbers)]
        steps += length.tolist()[: len(numbers)]
        returns += total.tolist()[: len(numbers)]
        films += pictures[: len(numbers)]
    return Evaluation(outcomes, steps, returns, films[:film])


def _wave(
    agent: Agent, scenes: Scenes, seed: int, film: int, on_step: Callable[[], None]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], list[list[NDArray[Any]]]]:
    """One episode in each scene: success, length and return [K], and pictures of the first `film`."""
    agent.reset()
    frame = scenes.reset([seed + k for k in range(scenes.count)])
    running, success = np.ones(scenes.count, dtype=bool), np.zeros(scenes.count, dtype=bool)
    length, total = np.zeros(scenes.count, dtype=int), np.zeros(scenes.count)
    films: list[list[NDArray[Any]]] = [[] for _ in range(min(film, scenes.count))]

    def look() -> None:
        pictures = scenes.render() if running[: len(films)].any() else []
        for k, shown in enumerate(films):
            if running[k]:
                shown.append(pictures[k])

    while running.any() and length.max() < scenes.max_steps:
        on_step()
        look()
        action, _ = agent.act(agent.prepare(frame), explore=False)
        outcome = scenes.step(agent.postprocessor(action))
        frame = outcome.frame
        if outcome.skipped:
            agent.retake(first=not length.any())
        length += running & (not outcome.skipped)
        total += np.where(running, outcome.reward, 0.0)
        success |= running & outcome.success
        running &= ~outcome.ended
    # The last picture of an episode that ends together with the others; one that ended before has begun anew.
    if scenes.count == 1 and films:
        films[0].append(scenes.render()[0])
    return success, length, total, films
